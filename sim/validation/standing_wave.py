"""Frequency of a standing gravity wave."""

from __future__ import annotations

import numpy as np
from scipy.optimize import curve_fit

from sim.mpm.solver import MPMSimulator
from sim.validation.case import Case, Clock, G, Result, box, scene, set_motion, state


def run(resolution: int) -> Result:
    """Half a wave in a tank as long as two depths, set going by the velocities of the linear mode; three periods.

    phi ~ cosh(k y) cos(k x), k = pi / L; the particles' velocities are projected onto the mode where they started (the amplitude is 1 %
    of the depth), and a damped cosine is fitted.
    """
    length, depth, c = 1.0, 0.5, 30.0
    k = np.pi / length
    omega = np.sqrt(G * k * np.tanh(k * depth))
    period, clock, solver = 2 * np.pi / omega, Clock(), MPMSimulator()
    frames = 240
    solver.load(scene({"model": "water", "sound_speed": c}, [box([0.0, 0.0], [length, depth])], resolution, frame_step=3 * period / frames))
    x = state(solver)[0]
    amplitude = 0.01 * depth * omega / np.sinh(k * depth)
    cosh, sinh, cos, sin = np.cosh(k * x[:, 1]), np.sinh(k * x[:, 1]), np.cos(k * x[:, 0]), np.sin(k * x[:, 0])
    mode = np.stack([-sin * cosh, cos * sinh], 1)
    gradient = k * np.stack([np.stack([-cos * cosh, -sin * sinh], 1), np.stack([-sin * sinh, cos * cosh], 1)], 1)
    set_motion(solver, amplitude * mode, amplitude * gradient)
    norm = amplitude * (mode**2).sum()
    swing = [1.0]
    for _ in clock.frames(solver, frames):
        swing.append(float((state(solver)[1] * mode).sum() / norm))
    t = np.linspace(0, 3 * period, frames + 1)

    def damped(t: np.ndarray, frequency: float, decay: float, size: float) -> np.ndarray:
        return size * np.exp(-decay * t) * np.cos(frequency * t)

    (frequency, decay, _), _ = curve_fit(damped, t, swing, (omega, 0.0, 1.0))
    error = float(abs(frequency / omega - 1))
    return Result(
        resolution, error, f"omega {frequency:.3f} ({omega:.3f}) rad/s, decay {decay:.2f} /s", (t / period, np.array(swing)),
        (t / period, np.cos(omega * t)), clock.seconds,
    )


CASE = Case(
    10, "standing_wave", "Standing gravity wave", "omega^2 = g k tanh(k H) (linear theory)", "frequency, relative", 0.03,
    ("t / T", "amplitude of the mode"), (16, 32, 64), "cells along the tank (depth: half of it)", run,
)
