"""``sluice-sim``: generate, plan, info, validate, render. Exit codes: 0 done, 1 failed while running, 2 bad input, 130 interrupted.

Everything heavy is imported by the command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from sim.errors import InputError, RunError, reason


def _at_least(low: int):
    def whole_number(text: str) -> int:
        value = int(text)
        if value < low:
            raise argparse.ArgumentTypeError(f"{value} is below {low}")
        return value

    return whole_number


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sluice-sim", description="Ground truth for particle physics: scenes in, trajectory files out.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def scene_options(command: argparse.ArgumentParser) -> None:
        command.add_argument("--variant", help="a named variant of the scene file")
        command.add_argument("--frames", type=_at_least(2), help="frames of a trajectory, the first included (default: the scene's)")

    command = commands.add_parser("generate", help="make trajectories of a scene family; continues where an earlier run stopped")
    command.set_defaults(run=_generate)
    command.add_argument("scene", type=Path, help="a scene file (configs/scenes/*.yaml)")
    scene_options(command)
    command.add_argument("--split", choices=("train", "valid", "test"), help="make this split (default: all three)")
    command.add_argument("--count", type=_at_least(1), help="trajectories in the split (default: the scene's own number)")
    command.add_argument("--out", type=Path, required=True, help="the data set's folder")
    command.add_argument("--jobs", type=_at_least(1), default=1, help="processes, each on one thread (default 1)")
    command.add_argument("--seed", type=_at_least(0), default=0, help="base seed of the data set (default 0)")
    command.add_argument("--shard-size", type=_at_least(1), default=8, help="trajectories in a file (default 8)")
    help_ = "refuse what is estimated to need more hours of one core (default 100)"
    command.add_argument("--budget", type=float, default=100.0, metavar="HOURS", help=help_)

    command = commands.add_parser("plan", help="what a scene compiles and allocates, what it leaves out, memory and time; runs nothing")
    command.set_defaults(run=_plan)
    command.add_argument("scene", type=Path, help="a scene file")
    scene_options(command)
    command.add_argument("--jobs", type=_at_least(1), default=1, help="processes to estimate the time for (default 1)")

    command = commands.add_parser("info", help="summary of a data set folder, a shard or a scene file")
    command.set_defaults(run=_info)
    command.add_argument("path", type=Path)
    command.add_argument("--against-paper", action="store_true", help="a data set beside the published domain that its scene reproduces")

    command = commands.add_parser("validate", help="check every trajectory of a data set folder or a shard; one line for each fault")
    command.set_defaults(run=_validate)
    command.add_argument("path", type=Path)

    command = commands.add_parser("render", help="a film (.mp4) or a still (.png) of one trajectory")
    command.set_defaults(run=_render)
    command.add_argument("shard", type=Path)
    command.add_argument("--index", type=_at_least(0), help="trajectory index (default: the shard's first)")
    command.add_argument("--out", type=Path, required=True, help="the picture's file")

    command = commands.add_parser("export", help="trajectories in the formats of viewers (ParaView, ...) and of other learners")
    command.set_defaults(run=_export)
    command.add_argument("source", type=Path, help="a data set folder or, for viewers, a shard")
    command.add_argument("--format", choices=("vtkhdf", "ply", "vtu", "geoelements", "deepmind", "lagrangebench"), required=True)
    command.add_argument("--out", type=Path, required=True, help="a new folder")
    command.add_argument("--split", choices=("train", "valid", "test"), help="export this split (default: all)")
    command.add_argument("--index", type=_at_least(0), help="viewers: only the trajectory with this index")
    command.add_argument("--frames", metavar="START:STOP:STEP", help="viewers: only these frames; each part is optional, --frames=-1 is the last one")
    return parser


def _family(options: argparse.Namespace):
    from sim.scene import SceneFamily

    family = SceneFamily.load(options.scene, options.variant)
    if options.frames is not None:
        family = SceneFamily(family.to_dict() | {"frames": options.frames}, options.scene)
    return family


def _generate(options: argparse.Namespace) -> int:
    from sim.generate import SPLITS, generate
    from sim.plan import check_budget, check_time_step

    family = _family(options)
    if options.count is not None and options.split is None:
        raise InputError("sluice-sim generate", "--count", options.count, "name the --split it counts")
    counts = {split: getattr(family.model.splits, split) for split in ([options.split] if options.split else SPLITS)}
    if options.count is not None:
        counts[options.split] = options.count
    counts = {split: count for split, count in counts.items() if count}
    check_time_step(family, counts, options.seed)
    check_budget(family, sum(counts.values()), options.budget)
    content = generate(family, counts, options.out, jobs=options.jobs, seed=options.seed, shard_size=options.shard_size)
    for split in counts:
        entry = content["splits"][split]
        lost = len(entry["failed"])
        print(
            f"{options.out}/{split}: {entry['ok']} trajectories, {lost} failed ({lost / entry['trajectories']:.1%}), "
            f"solver {entry['cost']['wall_seconds']:.1f} s + set-up and compilation {entry['cost']['compile_seconds']:.1f} s"
        )
    return 0


def _plan(options: argparse.Namespace) -> int:
    from sim.plan import plan_text

    print(plan_text(_family(options), options.jobs))
    return 0


def _info(options: argparse.Namespace) -> int:
    from sim.info import info_text
    from sim.paper import against_paper

    print((against_paper if options.against_paper else info_text)(options.path))
    return 0


def _validate(options: argparse.Namespace) -> int:
    from sim.info import faults

    count = 0
    for fault in faults(options.path):
        count += 1
        print(fault)
    if count:
        print(f"{options.path}: {count} fault{'s' if count > 1 else ''}", file=sys.stderr)
        return 2
    print(f"{options.path}: sound")
    return 0


def _render(options: argparse.Namespace) -> int:
    from sim.trajectory import ShardReader

    with ShardReader(options.shard) as reader:
        if not (indices := reader.indices()):
            raise InputError(options.shard, "groups", [], "holds no trajectory; give another shard")
        trajectory = reader.read(options.index if options.index is not None else indices[0])
    from sim.render import render_trajectory

    render_trajectory(options.out, trajectory)
    return 0


def _export(options: argparse.Namespace) -> int:
    from sim.export import export

    done = export(options.source, options.out, options.format, split=options.split, index=options.index, frames=options.frames)
    for split, index, status in done.failed:
        print(f"left out: {split} {index:06d}: {status}")
    if done.left_out:
        other = "deepmind" if options.format in ("geoelements", "lagrangebench") else "vtkhdf"
        print(f"sluice-sim: {options.out}: context = {', '.join(done.left_out)}: left out, {options.format} has no place for it; {other} has",
              file=sys.stderr)  # fmt: skip
    counts = ", ".join(f"{split or 'shard'} {count}" for split, count in done.trajectories.items())
    print(f"{options.out}: trajectories as {options.format}: {counts}; {len(done.failed)} failed left out")
    return 0


class _Stopped(KeyboardInterrupt):
    """SIGTERM, unwound like Ctrl-C so that workers end and temporary files go."""


def _stop(*_: object) -> None:
    raise _Stopped


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, _stop)
    try:
        return options.run(options)
    except InputError as error:
        print(f"sluice-sim: {error}", file=sys.stderr)
        return 2
    except (RunError, OSError) as error:
        print(f"sluice-sim: {reason(error) if isinstance(error, OSError) else error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as interrupt:
        hint = "; finished shards are kept, the same command continues" if options.command == "generate" else ""
        print(f"sluice-sim: interrupted{hint}", file=sys.stderr)
        return 143 if isinstance(interrupt, _Stopped) else 130
