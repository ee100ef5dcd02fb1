"""``python -m sim.gallery``: docs/gallery.md, a film strip of one test trajectory of every domain that has a scene."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from sim.domains import DOMAINS
from sim.errors import InputError
from sim.generate import Teacher, scene_teacher, simulate, trajectory_seed
from sim.render import render_strip
from sim.scene import SceneFamily
from sim.trajectory import Trajectory, atomic_path

HEAD = """# Gallery

One test trajectory of each domain of Sanchez-Gonzalez et al. (2020), and of our FLUIDSHAKE with a floating box,
six moments from start to end. Made by `make gallery`; the scenes are in `configs/scenes/`, and [domains.md](domains.md) sets their numbers
beside the published ones. Colour is speed, or the kind of matter where several meet.
"""
#: Shown beside the paper's.
OURS = ("fluidshake_box",)


def caption(path: Path, trajectory: Trajectory) -> str:
    """The first line of a scene file's head, the numbers of the trajectory, its status if it failed."""
    said = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ").split(": ", 1)[-1]
    said = said[:1].upper() + said[1:]
    frames, particles, dim = trajectory.position.shape
    fixed = int((~trajectory.moving).sum())
    counted = f"{particles - fixed} particles" + (f" and {fixed} of the boundary" if fixed else "")
    return f"{said} {counted}, {frames - 1} steps of {trajectory.frame_step:g} s, {dim}D." + ("" if trajectory.ok else f" **{trajectory.status}**")


def shrink(path: Path) -> None:
    """To a palette of 256 colours, a third of the bytes: strips are kept with the documents."""
    with Image.open(path) as picture, atomic_path(path) as temporary:
        picture.convert("RGB").quantize(256).save(temporary, optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the gallery; see the module."""
    parser = argparse.ArgumentParser(prog="python -m sim.gallery", description="A film strip of every domain.")
    parser.add_argument("--scenes", type=Path, default=Path("configs/scenes"), help="folder of scene files (default configs/scenes)")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of gallery.md and gallery/*.png (default docs)")
    parser.add_argument("--width", type=int, default=180, help="pixels of a moment (default 180)")
    options = parser.parse_args(arguments)
    paths = [path for name in (*DOMAINS, *OURS) if (path := options.scenes / f"{name}.yaml").exists()]
    if not paths:
        print(InputError("sluice gallery", "scenes", str(options.scenes), "holds no scene of a domain"), file=sys.stderr)
        return 2
    teachers: dict[str, Teacher] = {}
    sections = []
    for path in sorted(paths):
        scene = SceneFamily.load(path).sample(trajectory_seed(0, "test", 0), "test")
        method = scene.solver.method
        teacher = teachers[method] = teachers.get(method) or scene_teacher(method)
        trajectory = simulate(teacher, scene)
        name = path.stem
        picture = options.out / "gallery" / f"{name}.png"
        render_strip(picture, trajectory, width=options.width)
        shrink(picture)
        sections.append(f"## {name.upper().replace('_', '-')}\n{caption(path, trajectory)}\n\n![{name}: six moments](gallery/{name}.png)")
        print(f"{name}: {trajectory.status}", flush=True)
    with atomic_path(options.out / "gallery.md") as temporary:
        temporary.write_text("\n\n".join([HEAD.strip(), *sections]) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
