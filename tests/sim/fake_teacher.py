"""Teachers that cost nothing, in a module of their own because worker processes import them by name."""

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
