"""Predictors that learn nothing: a model worse than these is called so. And the oracle that checks the yardstick itself.

All work in frame units (dt = 1, velocities in length per frame) and in float64 inside; kinematic particles are set to their prescribed
positions in every frame. They begin from the last positions of ``start.history`` alone, the oracle also from the truth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sim import periodic
from sim.simulator import Kind, SimulationError, Start
from sim.trajectory import KINEMATIC_TYPE, Trajectory


class Baseline:
    """The common part: state from the history, prescribed particles, one float32 frame a call. A baseline is its ``step``.

    position, velocity, acceleration [particles, dim] float64, length, length/frame, length/frame^2: differences of the last 1, 2, 3 known
    positions; velocity and acceleration exist only as far as ``history`` (the frames of a ``Start`` that are needed) reaches. In a periodic
    box positions go on through the faces; the frames handed out are wrapped.
    """

    name: str
    kind: Kind = "trivial"
    history: int = 2

    def __init__(self) -> None:
        self.settings: dict = {}

    def begin(self, start: Start) -> None:
        """Take the state from the last ``history`` positions; ``ValueError`` if the start knows fewer."""
        known = start.history[-self.history :].astype(float)
        if len(known) < self.history:
            raise ValueError(f"{self.name}: history = {len(known)}: needs the last {self.history} frames")
        self.start, self.frame = start, start.present
        self.kinematic = start.particle_type == KINEMATIC_TYPE
        self.position = known[-1]
        if self.history > 1:
            self.velocity = known[-1] - known[-2]
        if self.history > 2:
            self.acceleration = known[-1] - 2 * known[-2] + known[-3]

    def step(self) -> None:
        """Bring ``position`` (and ``velocity``) to the next frame."""
        raise NotImplementedError

    def advance(self) -> np.ndarray:
        """The next frame, [1, particles, dim] float32."""
        self.step()
        self.frame += 1
        if self.start.kinematic is not None:
            self.position[self.kinematic] = self.start.kinematic[self.frame]
        return periodic.wrapped(self.position, self.start.bounds, self.start.period)[None].astype(np.float32)


class Frozen(Baseline):
    """p' = p."""

    name = "frozen"
    history = 1

    def step(self) -> None:
        pass


class ConstantVelocity(Baseline):
    """p' = p + v with the last known v, walls ignored."""

    name = "constant velocity"

    def step(self) -> None:
        self.position = self.position + self.velocity


class Ballistic(Baseline):
    """v' = v + g dt^2, p' = p + v', every particle alone; at a wall it stops: position clamped, normal velocity zero.

    A solver that integrates free fall by v' = v + g h, p' = p + h v' in equal substeps h gives positions whose second difference over
    frames is exactly g dt^2, whatever h is. With v the last difference of two frames this step continues such a fall without error.
    """

    name = "ballistic"

    def begin(self, start: Start) -> None:
        super().begin(start)
        self.fall = start.gravity * start.frame_step**2

    def step(self) -> None:
        velocity = self.velocity + self.fall
        free = self.position + velocity
        self.position = np.clip(free, *self.start.walls.T)
        self.velocity = np.where(free == self.position, velocity, 0.0)


class PersistentAcceleration(Baseline):
    """v' = v + a, p' = p + v' with the last known a for ever, walls ignored: strong in one step, hopeless in a hundred."""

    name = "persistent acceleration"
    history = 3

    def step(self) -> None:
        self.velocity = self.velocity + self.acceleration
        self.position = self.position + self.velocity


class RigidDrop(Baseline):
    """Every body falls as a rigid body without rotation, slides down walls and stops for good where it meets the floor.

    v' = v + g dt^2 with v the mean velocity of the body. A body is a connected component of the moving particles under the connectivity
    radius. A particle stands for a blob one spacing wide, so contact is half a spacing before the inner face. Bodies ignore each other.
    """

    name = "rigid drop"

    def begin(self, start: Start) -> None:
        super().begin(start)
        self.fall = start.gravity * start.frame_step**2
        moving = np.flatnonzero(~self.kinematic)
        pairs = periodic.tree(self.position[moving], start.period).query_pairs(start.radius, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(moving), len(moving)))
        count, label = connected_components(graph, directed=False)
        self.bodies = [moving[label == body] for body in range(count)]
        self.body_velocity = np.array([self.velocity[body].mean(axis=0) for body in self.bodies])
        half = 0.5 * float(start.scene["spacing"])
        low = np.array([self.position[body].min(axis=0) for body in self.bodies])
        high = np.array([self.position[body].max(axis=0) for body in self.bodies])
        # How far each body may still move down and up every axis; one that already sits closer than half a spacing is not pushed away.
        self.room_down = np.minimum(start.walls[:, 0] + half - low, 0.0)
        self.room_up = np.maximum(start.walls[:, 1] - half - high, 0.0)

    def step(self) -> None:
        velocity = self.body_velocity + self.fall
        shift = np.clip(velocity, self.room_down, self.room_up)
        contact = shift != velocity
        landed = (contact & (self.fall != 0) & (np.sign(velocity) == np.sign(self.fall))).any(axis=1)
        self.room_down, self.room_up = self.room_down - shift, self.room_up - shift
        # Landing is for good: no room is left, so gravity cannot move the body again.
        self.room_down[landed], self.room_up[landed] = 0.0, 0.0
        self.body_velocity = np.where(contact, 0.0, velocity)
        self.position = self.position.copy()
        for body, move in zip(self.bodies, shift, strict=True):
            self.position[body] += move


class Oracle(Baseline):
    """True accelerations, integrated as a learned model's would be: v' = v + a, p' = p + v'. It must reproduce the truth.

    What it misses is the fault of the frame loop, the start or the metric, not of a model (LagrangeBench's cheating model). It finds the
    trajectory it is asked about among ``trajectories`` by the start's history.
    """

    name = "oracle"
    kind: Kind = "oracle"

    def __init__(self, trajectories: Sequence[Trajectory]):
        super().__init__()
        self.trajectories = trajectories

    def begin(self, start: Start) -> None:
        super().begin(start)
        first = start.present + 1 - len(start.history)
        for trajectory in self.trajectories:
            known = periodic.unwrapped(trajectory.position[first : start.present + 1], trajectory.period, -1)
            if np.array_equal(known, start.history):
                self.truth = trajectory.position
                return
        raise ValueError(f"oracle: none of its {len(self.trajectories)} trajectories has the start's history at frame {start.present}")

    def step(self) -> None:
        """The true acceleration; ``SimulationError`` where the truth ends."""
        if self.frame + 1 >= len(self.truth):
            raise SimulationError("the truth ends here")
        before, now, after = self.truth[self.frame - 1 : self.frame + 2].astype(float)
        self.velocity = self.velocity + periodic.shortest(after - 2 * now + before, self.start.period)
        self.position = self.position + self.velocity


def trivial_baselines() -> list[Baseline]:
    """One of each trivial contender."""
    return [Frozen(), ConstantVelocity(), Ballistic(), PersistentAcceleration(), RigidDrop()]
