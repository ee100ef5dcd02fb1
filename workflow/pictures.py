"""What pictures are drawn from: trajectory files alone, so that drawing loads neither Taichi nor torch."""

from __future__ import annotations

import dataclasses

import numpy as np

from sim.trajectory import ShardReader, Trajectory
from workflow.names import REFERENCE


def whole(shard: str) -> Trajectory:
    """The one trajectory of a shard, NaN from the frame on that a failed rollout did not reach."""
    with ShardReader(shard) as reader:
        trajectory = reader.read(reader.indices()[0])
    position = np.full((trajectory.scene["frames"], *trajectory.position.shape[1:]), np.nan, np.float32)
    position[: len(trajectory.position)] = trajectory.position
    return dataclasses.replace(trajectory, position=position)


def speed_note(timings: list[dict], model: str) -> str:
    """How the model's run time compares with the reference's, for the footer of a film; empty if one was not timed."""
    seconds = {timing["contender"]: float(np.median(timing["per_frame"])) for timing in timings if timing["per_frame"]}
    if not {REFERENCE, model} <= seconds.keys():
        return ""
    ratio = seconds[REFERENCE] / seconds[model]
    return f"{ratio:.2g}x as fast as the {REFERENCE}" if ratio >= 1 else f"{1 / ratio:.2g}x slower than the {REFERENCE}"
