"""The contract that every simulator obeys, solver or learned model, and the one frame loop that drives them all.

A simulator begins from a ``Start`` and advances by whole frames. Metrics, timing, pictures and stability studies are
written once against this contract; a coarser solver, a GNS and "constant velocity" are entries in one list of contenders.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from sim import periodic
from sim.trajectory import KINEMATIC_TYPE, Trajectory

Kind = Literal["reference", "solver", "learned", "trivial", "oracle", "floor"]


@dataclass(frozen=True)
class Start:
    """What a simulator may know before it predicts.

    history [h, particles, dim] float32: the last h known frames, the present last, in a periodic box going on through its faces,
    the present within it (as is what a simulator returns); particle_type [particles] int8;
    present: frame index of ``history[-1]``; frame_step [s]; radius; bounds [dim, 2]; scene: the resolved scene (what a
    solver starts from; a learned model may read its gravity and bounds, never its future); context [frames, c] or None:
    prescribed for all frames; kinematic [frames, k, dim] or None: prescribed positions of the kinematic particles.
    """

    history: np.ndarray
    particle_type: np.ndarray
    present: int
    frame_step: float
    radius: float
    bounds: np.ndarray
    scene: dict
    context: np.ndarray | None = None
    kinematic: np.ndarray | None = None

    @property
    def gravity(self) -> np.ndarray:
        """[dim], length / s^2."""
        return np.asarray(self.scene["gravity"], float)

    @property
    def period(self) -> np.ndarray | None:
        """[dim]: see ``sim.periodic``."""
        return periodic.period(self.scene, self.bounds)

    @property
    def walls(self) -> np.ndarray:
        """[dim, 2]: the bounds, infinitely far away along periodic axes."""
        return periodic.walls(self.bounds, self.period)


def start_from(trajectory: Trajectory, history: int = 6, present: int | None = None) -> Start:
    """The start that hands a simulator ``history`` frames of a trajectory, the last of them ``present`` (None: the first ones)."""
    kinematic, period = ~trajectory.moving, trajectory.period
    present = history - 1 if present is None else present
    return Start(
        history=periodic.unwrapped(trajectory.position[max(present + 1 - history, 0) : present + 1], period, -1),
        particle_type=trajectory.particle_type,
        present=present,
        frame_step=trajectory.frame_step,
        radius=trajectory.radius,
        bounds=trajectory.bounds,
        scene=trajectory.scene,
        context=trajectory.context,
        kinematic=periodic.unwrapped(trajectory.position[:, kinematic], period, present) if kinematic.any() else None,
    )


class Simulator(Protocol):
    """Anything that turns a start into frames."""

    name: str
    kind: Kind
    settings: dict

    def begin(self, start: Start) -> None:
        """Compile, allocate and load the state of ``start.history[-1]``. Never timed as run time."""

    def advance(self) -> np.ndarray:
        """The next k >= 1 frames, [k, particles, dim] float32 (a model that predicts m frames at once returns m)."""


@runtime_checkable
class ManySimulator(Simulator, Protocol):
    """A simulator that takes several starts of one box at once."""

    def begin_many(self, starts: Sequence[Start]) -> None:
        """``begin`` for all."""

    def advance_many(self, which: Sequence[int]) -> list[np.ndarray | SimulationError]:
        """``advance`` of these starts: frames of each, or why there are none."""


@dataclass(frozen=True)
class Rollout:
    """position [frames, particles, dim] float32, NaN after a failure; seconds: run time without ``begin``; status as in ``Trajectory``; escaped: the
    first frame in which a particle that moves is further than the radius outside the bounds, None if none is."""

    position: np.ndarray
    seconds: float
    begin_seconds: float
    status: str
    escaped: int | None = None


class SimulationError(RuntimeError):
    """A simulator cannot go on (time step at its floor, particle outside the grid); the message is the trajectory's status."""


class _Run:
    """A rollout on its way."""

    def __init__(self, start: Start, frames: int):
        self.start, self.frames, self.done, self.seconds, self.status = start, frames, 0, 0.0, "ok"
        self.escaped: int | None = None
        self.position = np.full((frames, *start.history.shape[1:]), np.nan, np.float32)
        self._moving, (self._lower, self._upper) = start.particle_type != KINEMATIC_TYPE, np.asarray(start.walls, float).T

    @property
    def going(self) -> bool:
        return self.done < self.frames and self.status == "ok"

    def take(self, block: np.ndarray | SimulationError) -> None:
        """The next frames, or why there are none."""
        start = self.start
        if isinstance(block, SimulationError):
            self.status = f"failed: {block} (frame {start.present + 1 + self.done})"
            return
        finite = np.isfinite(block).all(axis=(1, 2))
        usable = len(block) if finite.all() else int(np.argmin(finite))
        count = min(usable, self.frames - self.done)
        self.position[self.done : self.done + count] = block[:count]
        if self.escaped is None:
            shown = block[:count, self._moving]
            away = ((shown < self._lower - start.radius) | (shown > self._upper + start.radius)).any(axis=(1, 2))
            self.escaped = start.present + 1 + self.done + int(np.argmax(away)) if away.any() else None
        self.done += count
        if usable < len(block) and self.done < self.frames:
            self.status = f"failed: non-finite position (frame {start.present + 1 + self.done})"

    def end(self, begin_seconds: float) -> Rollout:
        return Rollout(position=self.position, seconds=self.seconds, begin_seconds=begin_seconds, status=self.status, escaped=self.escaped)


def rollout(simulator: Simulator, start: Start, frames: int) -> Rollout:
    """Drive a simulator for ``frames`` frames after ``start.history[-1]``; a non-finite frame ends it with a status.

    Simulators return host arrays, so a device is synchronised by the time a frame arrives here.
    """
    clock = time.perf_counter
    begun = clock()
    simulator.begin(start)
    begin_seconds, run = clock() - begun, _Run(start, frames)
    while run.going:
        begun = clock()
        try:
            block: np.ndarray | SimulationError = simulator.advance()
        except SimulationError as error:
            block = error
        run.seconds += clock() - begun
        run.take(block)
    return run.end(begin_seconds)


def rollouts(simulator: Simulator, starts: Sequence[Start], frames: Sequence[int]) -> list[Rollout]:
    """``rollout`` from several starts of one box: together where the simulator has ``begin_many`` and ``advance_many`` (``learn.gns``), each then
    with its share of the seconds; else one after the other."""
    if not isinstance(simulator, ManySimulator):
        return [rollout(simulator, start, count) for start, count in zip(starts, frames, strict=True)]
    clock = time.perf_counter
    begun = clock()
    simulator.begin_many(starts)
    begin_seconds, runs = (clock() - begun) / len(starts), [_Run(start, count) for start, count in zip(starts, frames, strict=True)]
    while going := [number for number, run in enumerate(runs) if run.going]:
        begun = clock()
        blocks = simulator.advance_many(going)
        share = (clock() - begun) / len(going)
        for number, block in zip(going, blocks, strict=True):
            runs[number].seconds += share
            runs[number].take(block)
    return [run.end(begin_seconds) for run in runs]
