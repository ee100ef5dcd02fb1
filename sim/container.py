"""A container that is shaken: its acceleration as a sum of sines, and the family of such motions."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from sim.fields import Finite, Positive, Range, Strict, check_range, check_vectors, mistake, sample


class Sine(Strict):
    """amplitude [dim, m/s^2], frequency [Hz], phase [degrees]."""

    amplitude: list[Finite]
    frequency: Positive
    phase: Finite


class Container(Strict):
    """The box is accelerated by a(t) = sum of amplitude sin(2 pi frequency t + phase); scenes are solved, and recorded, in its frame."""

    sines: list[Sine]

    def acceleration(self, frames: int, frame_step: float) -> np.ndarray:
        """[frames, dim] float64, m/s^2: the mean of a(t) over the step from frame k to k + 1.

        Decision: the solver holds this mean over the frame. The velocity gained in a frame is exact, and what the learned models
        read as context is all there is to know; with a(t) a substep, the truth would depend on what no frame tells.
        """
        t = frame_step * np.arange(frames + 1)
        total = np.zeros((frames, 1))
        for sine in self.sines:
            w = 2 * np.pi * sine.frequency
            integral = -np.cos(w * t + np.radians(sine.phase)) / w
            total = total + np.diff(integral)[:, None] / frame_step * np.array(sine.amplitude)
        return total


class ContainerFamily(Strict):
    """``sines`` [low, high]: how many; the rest is drawn for each."""

    sines: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1, le=64)]] = (1, 1)
    amplitude: list[Range]
    frequency: Range
    phase: Range | Literal["any"] = "any"

    def check(self, dim: int) -> None:
        """Raise the first fault of a family in ``dim`` dimensions."""
        if self.sines[0] > self.sines[1]:
            raise mistake("container.sines", list(self.sines), "low must not exceed high")
        check_vectors("container", {"amplitude": self.amplitude}, dim)
        check_range("container.frequency", self.frequency, 1e-6, "must be positive [Hz]")
        if self.phase != "any":
            check_range("container.phase", self.phase)

    def draw(self, rng: np.random.Generator) -> Container:
        """One shaking, its numbers fixed."""
        phase = (0.0, 360.0) if self.phase == "any" else self.phase
        return Container(
            sines=[
                Sine(amplitude=[sample(value, rng) for value in self.amplitude], frequency=sample(self.frequency, rng), phase=sample(phase, rng))
                for _ in range(int(rng.integers(self.sines[0], self.sines[1] + 1)))
            ]
        )
