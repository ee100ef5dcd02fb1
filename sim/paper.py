"""The domains of Sanchez-Gonzalez et al. (ICML 2020, arXiv 2002.09405), and how far a data set of ours is from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sim.errors import InputError
from sim.generate import read_content


@dataclass(frozen=True)
class Domain:
    """particles, steps and edges (directed, with the self edges) of an example, all about; frame_step [s];
    radius; rollout_mse: table 1; velocity_std, acceleration_std: the released metadata's, length / frame and length / frame^2, where known."""

    particles: int
    steps: int
    frame_step: float
    radius: float
    edges: int
    rollout_mse: float
    velocity_std: tuple[float, ...] | None = None
    acceleration_std: tuple[float, ...] | None = None


#: By the name of our scene. The container's edge is about 1 in the MPM domains' files, and about 10 in the paper's discussion of errors.
DOMAINS = {
    "water_3d": Domain(13000, 800, 0.005, 0.035, 230_000, 10.1e-3),
    "sand_3d": Domain(20000, 350, 0.0025, 0.025, 320_000, 0.554e-3),
    "goop_3d": Domain(14000, 300, 0.0025, 0.025, 230_000, 0.618e-3),
    "water_3d_s": Domain(5800, 800, 0.005, 0.045, 100_000, 9.52e-3),
    "boxbath": Domain(1000, 150, 0.0167, 0.08, 17_000, 4.2e-3),
    "water": Domain(1900, 1000, 0.0025, 0.015, 31_000, 17.4e-3),
    "sand": Domain(2000, 320, 0.0025, 0.015, 21_000, 2.37e-3, (2.198e-3, 2.665e-3), (2.583e-4, 2.955e-4)),
    "goop": Domain(1900, 400, 0.0025, 0.015, 19_000, 1.89e-3),
    "multimaterial": Domain(2000, 1000, 0.0025, 0.015, 25_000, 16.9e-3),
    "fluidshake": Domain(1300, 2000, 0.0025, 0.015, 20_000, 20.1e-3),
    "waterdrop": Domain(1000, 1000, 0.0025, 0.015, 12_000, 7.01e-3, (1.372e-3, 1.312e-3), (6.74e-5, 8.70e-5)),
    "waterdrop_xl": Domain(7100, 1000, 0.0025, 0.01, 210_000, 14.9e-3),
    "waterramps": Domain(2300, 600, 0.0025, 0.015, 26_000, 11.6e-3),
    "sandramps": Domain(3300, 400, 0.0025, 0.015, 32_000, 2.07e-3),
    "randomfloor": Domain(3400, 600, 0.0025, 0.015, 44_000, 6.72e-3),
    "continuous": Domain(4300, 400, 0.0025, 0.015, 47_000, 1.06e-3),
}

#: What a data set of ours must keep to: factor of the moments; share of the neighbours and of the particles.
MOMENTS, NEIGHBOURS = 1.5, 0.15


def against_paper(path: str | Path) -> str:
    """A table of a data set folder beside the published domain its scene reproduces. Raises ``InputError``."""
    content = read_content(Path(path))
    name = content["scene"].split("-")[0]  # a variant is named after a hyphen
    if name not in DOMAINS:
        raise InputError(path, "scene", content["scene"], f"reproduces no domain of the paper; those are {', '.join(sorted(DOMAINS))}")
    found, family, domain = content.get("statistics"), content["family"], DOMAINS[name]
    if not found:
        raise InputError(path, "statistics", None, "there are none before the training split is finished; generate it")
    rows = [("", "paper", "ours", "ratio", "asked")]

    def row(what: str, paper: float, ours: float, low: float, high: float, asked: str) -> None:
        ratio = ours / paper
        rows.append((what, f"{paper:.4g}", f"{ours:.4g}", f"{ratio:.2f}", asked + ("" if low <= ratio <= high else "  MISSED")))

    lowest, mean, most = found["particles"]
    rows.append(("particles", f"{domain.particles}", f"{mean:.0f} ({lowest:.0f} to {most:.0f})", f"{mean / domain.particles:.2f}", ""))
    row("steps", domain.steps, found["frames"] - 1, 1, 1, "equal")
    row("frame step [s]", domain.frame_step, family["frame_step"], 0.99, 1.01, "equal")
    row("radius", domain.radius, family["radius"], 1, 1, "equal")
    edges = domain.edges / domain.particles
    row("neighbours, itself included", edges, found["neighbours"], 1 - NEIGHBOURS, 1 + NEIGHBOURS, f"within {NEIGHBOURS:.0%}")
    for label, key in (("velocity std", "velocity_std"), ("acceleration std", "acceleration_std")):
        published = getattr(domain, key)
        for axis, ours in enumerate(found[key]):
            if published is None:
                rows.append((f"{label} {'xyz'[axis]}", "not published", f"{ours:.3g}", "", ""))
            else:
                row(f"{label} {'xyz'[axis]}", published[axis], ours, 1 / MOMENTS, MOMENTS, f"within a factor {MOMENTS:g}")
    widths = [max(len(cells[k]) for cells in rows) for k in range(5)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip() for cells in rows]
    return "\n".join([f"data set {path} beside {name.upper().replace('_', '-')} of Sanchez-Gonzalez et al. (2020)", *lines])
