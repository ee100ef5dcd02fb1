"""Teachers that cost nothing or go wrong, in a module of their own because worker processes import them by name."""

import os
import resource
import signal
import time

import numpy as np

from sim.simulator import SimulationError


class FakeTeacher:
    """Particles fall freely and stop at the floor; exact and instant."""

    name, kind, settings, compile_seconds = "fake", "reference", {"cfl": None}, 0.0

    def load(self, scene):
        self.scene = scene
        start = scene.particles(refine=1)
        self.position, self.velocity, self.count = start.position.copy(), start.velocity.copy(), 0

    def frame(self):
        self.count += 1
        self.velocity += np.asarray(self.scene.gravity) * self.scene.frame_step
        self.position += self.velocity * self.scene.frame_step
        lower, upper = np.asarray(self.scene.bounds).T
        self.position = np.clip(self.position, lower + 1e-6, upper - 1e-6)
        return self.position.astype(np.float32)

    def diagnostics(self):
        return {"kinetic_energy": float((self.velocity**2).sum()), "substeps": 1.0}


class SlowTeacher(FakeTeacher):
    """Slow enough to be killed half way."""

    def frame(self):
        time.sleep(0.02)
        return super().frame()


class SometimesFailing(FakeTeacher):
    """Odd seeds cannot go on after frame 3; multiples of four turn to NaN at frame 5."""

    def frame(self):
        position = super().frame()
        if self.count == 4 and self.scene.seed % 2:
            raise SimulationError("time step at its floor")
        if self.count == 5 and self.scene.seed % 4 == 0:
            position[0, 0] = np.nan
        return position


class AlwaysFailing(FakeTeacher):
    def frame(self):
        raise SimulationError("time step at its floor")


class Suicidal(FakeTeacher):
    """Ends its worker as the kernel's out-of-memory killer would."""

    def frame(self):
        os.kill(os.getpid(), signal.SIGKILL)


class FullDisk(FakeTeacher):
    """No file may grow beyond 20 kB, so a shard does not fit."""

    def __init__(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))


class Broken(FakeTeacher):
    def load(self, scene):
        raise KeyError("a fault of ours\nin two lines")


#: What ``poisoned`` does to which trajectories of a training split: field of the solver's kernels, content of one of its particles.
POISONS = {
    1: ("velocity", np.nan),
    2: ("velocity", -np.inf),
    3: ("strain", np.nan),
    5: ("position", np.nan),
    6: ("position", -7.0),
    7: ("position", 1e9),
}
#: The frame before which it happens, and the particle of the field.
POISON_FRAME, POISON_PARTICLE = 4, 17


def poisoned():
    """The real solver, which some bit flip spoils in the middle of the trajectories of ``POISONS``; the strain (b - I) is the sand's."""
    from sim.generate import trajectory_seed
    from sim.mpm.solver import MPMSimulator

    poisons = {trajectory_seed(0, "train", index): poison for index, poison in POISONS.items()}

    class Poisoned(MPMSimulator):
        def load(self, scene):
            super().load(scene)
            self.poison, self.count = poisons.get(scene.seed), 0

        def frame(self):
            self.count += 1
            if self.count == POISON_FRAME and self.poison:
                kernels, (field, value) = self._kernels, self.poison
                sand = [name for name, *_ in kernels.models].index("sand")
                at = kernels.range[sand] if field == "strain" else 0
                field = {"velocity": kernels.v, "position": kernels.x, "strain": kernels.materials[sand].b}[field]
                content = field.to_numpy()
                content[at + POISON_PARTICLE, 0] = value
                field.from_numpy(content)
            return super().frame()

    return Poisoned()
