"""The sixteen domains of Sanchez-Gonzalez et al. (ICML 2020, arXiv 2002.09405): their sizes, their Table 1, the model behind it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Domain:
    """particles, steps and edges (directed, with the self edges) of an example, all about; frame_step [s]; radius; trajectories to train on;
    one_step_mse, rollout_mse: table 1, over all particles, rigid and static ones included; velocity_std, acceleration_std: the released
    metadata's, length / frame and length / frame^2, where known."""

    particles: int
    steps: int
    frame_step: float
    radius: float
    edges: int
    trajectories: int
    one_step_mse: float
    rollout_mse: float
    velocity_std: tuple[float, ...] | None = None
    acceleration_std: tuple[float, ...] | None = None
    dim: int = 2


#: By the name of our scene. The container's edge is about 1 in the MPM domains' files, and about 10 in the paper's discussion of errors.
DOMAINS = {
    "water_3d": Domain(13000, 800, 0.005, 0.035, 230_000, 1000, 8.66e-9, 10.1e-3, dim=3),
    "sand_3d": Domain(20000, 350, 0.0025, 0.025, 320_000, 1000, 1.42e-9, 0.554e-3, dim=3),
    "goop_3d": Domain(14000, 300, 0.0025, 0.025, 230_000, 1000, 1.32e-9, 0.618e-3, dim=3),
    "water_3d_s": Domain(5800, 800, 0.005, 0.045, 100_000, 1000, 9.66e-9, 9.52e-3, dim=3),
    "boxbath": Domain(1000, 150, 0.0167, 0.08, 17_000, 2700, 54.5e-9, 4.2e-3, dim=3),
    "water": Domain(1900, 1000, 0.0025, 0.015, 31_000, 1000, 2.82e-9, 17.4e-3),
    "sand": Domain(2000, 320, 0.0025, 0.015, 21_000, 1000, 6.23e-9, 2.37e-3, (2.198e-3, 2.665e-3), (2.583e-4, 2.955e-4)),
    "goop": Domain(1900, 400, 0.0025, 0.015, 19_000, 1000, 2.91e-9, 1.89e-3),
    "multimaterial": Domain(2000, 1000, 0.0025, 0.015, 25_000, 1000, 1.81e-9, 16.9e-3),
    "fluidshake": Domain(1300, 2000, 0.0025, 0.015, 20_000, 1000, 2.1e-9, 20.1e-3),
    "waterdrop": Domain(1000, 1000, 0.0025, 0.015, 12_000, 1000, 1.52e-9, 7.01e-3, (1.372e-3, 1.312e-3), (6.74e-5, 8.70e-5)),
    "waterdrop_xl": Domain(7100, 1000, 0.0025, 0.01, 210_000, 1000, 1.23e-9, 14.9e-3),
    "waterramps": Domain(2300, 600, 0.0025, 0.015, 26_000, 1000, 4.91e-9, 11.6e-3),
    "sandramps": Domain(3300, 400, 0.0025, 0.015, 32_000, 1000, 2.77e-9, 2.07e-3),
    "randomfloor": Domain(3400, 600, 0.0025, 0.015, 44_000, 1000, 2.77e-9, 6.72e-3),
    "continuous": Domain(4300, 400, 0.0025, 0.015, 47_000, 1000, 2.06e-9, 1.06e-3),
}

#: The GNS of Table 1: parameters by dimension, and at most how many training steps of two examples each.
PARAMETERS, TRAINING_STEPS = {2: 1_591_826, 3: 1_592_979}, 20_000_000


def reproduced(scene: str) -> str | None:
    """The domain that a scene of ours, or a variant of it (named after a hyphen), reproduces; None if none of the sixteen."""
    name = scene.split("-")[0]
    return name if name in DOMAINS else None
