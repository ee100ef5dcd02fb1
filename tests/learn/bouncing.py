"""Trajectories of particles that bounce off walls, each by itself: what many tests of the learners need, in no time."""

from __future__ import annotations

import numpy as np

from sim.trajectory import Trajectory

GRAVITY = (0.0, -9.81)
FRAME_STEP = 0.01


def bounce(seed: int, particles: int = 24, frames: int = 40) -> Trajectory:
    """Independent particles under gravity in the box [0.1, 0.9]^2, reflected by its walls with restitution 0.6."""
    generator = np.random.default_rng(seed)
    lower, upper = 0.1, 0.9
    position = generator.uniform(0.3, 0.8, (particles, 2))
    velocity = generator.normal(0, 0.5, (particles, 2))
    path = []
    for _ in range(frames):
        path.append(position.astype(np.float32))
        velocity = velocity + FRAME_STEP * np.asarray(GRAVITY)
        position = position + FRAME_STEP * velocity
        low, high = position < lower, position > upper
        position = np.where(low, 2 * lower - position, np.where(high, 2 * upper - position, position))
        velocity = np.where(low | high, -0.6 * velocity, velocity)
    scene = {
        "name": "bounce",
        "dim": 2,
        "bounds": [[lower, upper]] * 2,
        "gravity": list(GRAVITY),
        "frame_step": FRAME_STEP,
        "frames": frames,
        "radius": 0.1,
        "spacing": 0.05,
        "grid_spacing": 0.1,
        "refine": 1,
        "materials": {},
        "bodies": [],
    }
    return Trajectory(
        position=np.stack(path),
        particle_type=np.full(particles, 5, np.int8),
        frame_step=FRAME_STEP,
        radius=0.1,
        bounds=np.array([[lower, upper]] * 2),
        scene=scene,
        seed=seed,
        simulator={"name": "bounce"},
    )
