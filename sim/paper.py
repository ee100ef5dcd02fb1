"""How far a data set of ours is from the domain of Sanchez-Gonzalez et al. (2020) that its scene reproduces."""

from __future__ import annotations

from pathlib import Path

from sim.domains import DOMAINS, reproduced
from sim.errors import InputError
from sim.generate import read_content

#: What a data set of ours must keep to: factor of the moments; share of the neighbours and of the particles.
MOMENTS, NEIGHBOURS = 1.5, 0.15


def against_paper(path: str | Path) -> str:
    """A table of a data set folder beside the published domain its scene reproduces. Raises ``InputError``."""
    content = read_content(Path(path))
    name = reproduced(content["scene"])
    if name is None:
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
