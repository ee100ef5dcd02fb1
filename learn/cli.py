"""``sluice-learn``: turn others' data into ours, train a model, roll one out, look into a checkpoint, exchange one with the PyTorch port of GNS.

Exit codes: 0 done; 1 failed while running (training diverged or was stopped; resume by the same command); 2 bad input, nothing written;
130 interrupted.
torch is imported by the commands, not here, so that ``--help`` is quick.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys

from sim.errors import InputError, RunError, reason


def _import(arguments: argparse.Namespace) -> None:
    from sim.importing import TOLERANCE, import_data

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # unwound like Ctrl-C, so that what is half written goes
    done = import_data(
        arguments.source, arguments.out, arguments.format, gravity=arguments.gravity, spacing=arguments.spacing, trust_pickle=arguments.trust_pickle
    )
    counts = ", ".join(f"{split} {count}" for split, count in done.trajectories.items())
    print(f"{arguments.out}: trajectories: {counts}; particle spacing {done.spacing:.4g} ({done.spacing_from})")
    if done.statistics:
        print("statistics of the training split, length per frame: found | stated by metadata.json")
    for entry in done.statistics:
        found, stated = (", ".join(f"{value:.4g}" for value in values or []) or "-" for values in (entry.found, entry.stated))
        print(f"  {entry.name}: {found} | {stated}")
    if done.doubtful:
        worst = max(entry.deviation for entry in done.doubtful)
        names = ", ".join(entry.name for entry in done.doubtful)
        print(f"sluice-learn: {arguments.source}/metadata.json: {names}: up to {worst:.2g} standard deviations from those found "
              f"({TOLERANCE:g} allowed); those found are used", file=sys.stderr)  # fmt: skip


def _train(arguments: argparse.Namespace) -> None:
    from learn.train import load_config, train

    names = ("seed", "device", "threads", "minutes", "steps")
    overrides = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    config = load_config(arguments.config, overrides, arguments.variant)
    found = train(config, arguments.data, arguments.out, arguments.config)
    if found:
        print(json.dumps(found, indent=1, sort_keys=True))


def _rollout(arguments: argparse.Namespace) -> None:
    from learn.rollout import rollout_dataset, rollout_scene
    from learn.train import resolve_device

    if (arguments.scene is None) == (arguments.data is None):
        raise InputError("command line", "--data", arguments.data, "give a SCENE file or --data DIR, one of the two")
    common = {name: getattr(arguments, name) for name in ("batch", "frames", "threads")}
    common["device"] = resolve_device(arguments.device, "command line")
    if arguments.scene is None:
        for option in ("seed", "variant"):
            if getattr(arguments, option) is not None:
                raise InputError("command line", f"--{option}", getattr(arguments, option), "is for a SCENE file; a data set has its own")
        cost = rollout_dataset(arguments.checkpoint, arguments.data, arguments.split or "test", arguments.out, count=arguments.count, **common)
    else:
        if arguments.split is not None:
            raise InputError("command line", "--split", arguments.split, "is for --data; draws of a SCENE file are those of its test split")
        cost = rollout_scene(arguments.checkpoint, arguments.scene, arguments.out, variant=arguments.variant, seed=arguments.seed or 0,
                             count=arguments.count or 1, **common)  # fmt: skip
    rollouts = cost["trajectories"].values()
    escaped = [entry["escaped"] for entry in rollouts if entry["escaped"] is not None]
    remarks = [f"{len(cost['failed'])} failed: {next(iter(cost['failed'].values()))}"] if cost["failed"] else []
    remarks += [f"{len(escaped)} left the box, the first at frame {min(escaped)}"] if escaped else []
    frames = sum(entry["frames"] for entry in rollouts)
    print("; ".join([f"{arguments.out}: {len(rollouts)} rollouts, {frames} frames, {cost['wall_seconds']:.2f} s", *remarks]))


def _info(arguments: argparse.Namespace) -> None:
    from learn.checkpoint import file_hash, load_model, read_model_file

    content, model = read_model_file(arguments.checkpoint), load_model(arguments.checkpoint)
    shown = {name: content[name] for name in ("model", "settings", "spec", "provenance")}
    shown["parameters"] = sum(parameter.numel() for parameter in model.parameters())
    shown["sha256"] = file_hash(arguments.checkpoint)
    print(json.dumps(shown, indent=1, sort_keys=True))


def _import_model(arguments: argparse.Namespace) -> None:
    from pathlib import Path

    from learn.checkpoint import file_hash, save_model
    from learn.exchange import import_model

    if Path(arguments.out).exists():
        raise InputError(arguments.out, "--out", arguments.out, "exists; give another name, or delete it")
    model = import_model(
        arguments.model,
        arguments.metadata,
        edges=arguments.edges,
        noise_std=arguments.noise_std,
        spacing=arguments.spacing,
        gravity=arguments.gravity,
        particle_types=arguments.types,
    )
    save_model(arguments.out, model, {"source": "geoelements/gns", "file": arguments.model, "sha256": file_hash(arguments.model)})
    print(f"{arguments.out}: {model.options.message_passing} blocks of width {model.options.latent}, {model.velocities} velocities")


def _export_model(arguments: argparse.Namespace) -> None:
    from learn.checkpoint import load_model
    from learn.exchange import export_model

    metadata = export_model(load_model(arguments.checkpoint), arguments.out)
    sizes = ", ".join(f"{name} {metadata[name]}" for name in ("latent_dim", "nmlp_layers", "nmessage_passing_steps", "input_sequence_length"))
    version = "of 11 December 2024 or later" if metadata["edges"] == "updated" else "of before 11 December 2024"
    print(f"{arguments.out}: for geoelements/gns {version} with --noise_std={metadata['noise_std']:.9g}; {sizes} (its train.py: 128, 2, 10, 6)")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise ValueError
    return value


def _whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise ValueError
    return value


_whole.__name__ = "integer >= 0"
_positive.__name__ = "integer >= 1"  # what argparse names in its message


def parser() -> argparse.ArgumentParser:
    """The command line of ``sluice-learn``."""
    top = argparse.ArgumentParser(prog="sluice-learn", description="Train learned particle simulators and roll them out.")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    text = "Turn a data set of another learner into one of ours: a folder with metadata.json and a file a split."
    foreign = commands.add_parser("import", help="turn a data set of another learner into one of ours", description=text)
    foreign.add_argument("source", metavar="SOURCE", help="its folder")
    help_ = "whose files it holds: train.npz, train.tfrecord, train.h5"
    foreign.add_argument("--format", choices=("geoelements", "deepmind", "lagrangebench"), required=True, help=help_)
    foreign.add_argument("--out", required=True, metavar="DIR", help="a new folder")
    help_ = "one number an axis, length / s^2; no format says it; zeros for none"
    foreign.add_argument("--gravity", type=float, nargs="+", required=True, metavar="G", help=help_)
    foreign.add_argument("--spacing", type=float, help="of the particles, length; default: dx of lagrangebench, or measured in the first frame")
    help_ = "read the pickles of geoelements; arrays and numbers alone are let through"
    foreign.add_argument("--trust-pickle", action="store_true", help=help_)
    foreign.set_defaults(act=_import)

    train = commands.add_parser("train", help="train a model, or resume the run in --out", description="Train a model, or resume the run in --out.")
    train.add_argument("config", metavar="CONFIG", help="a file of configs/models/")
    train.add_argument("--data", required=True, metavar="DIR", help="data set with the splits train and valid")
    train.add_argument("--out", required=True, metavar="RUN", help="run folder")
    train.add_argument("--variant", help="one of those that the file names")
    train.add_argument("--seed", type=int, help="instead of training.seed")
    train.add_argument("--device", choices=("auto", "cpu", "cuda"), help="instead of training.device")
    train.add_argument("--threads", type=int, help="instead of training.threads")
    budget = train.add_mutually_exclusive_group()
    budget.add_argument("--minutes", type=float, help="budget in minutes, instead of the configuration's")
    budget.add_argument("--steps", type=int, help="budget in steps, instead of the configuration's")
    train.set_defaults(act=_train)

    text = "Roll a checkpoint out over the trajectories of a data set, or from the first frames of a scene, into a trajectory file like the solver's."
    rollout = commands.add_parser("rollout", help="roll a checkpoint out over a data set or from a scene", description=text)
    rollout.add_argument("checkpoint", metavar="CHECKPOINT", help="a best.pt")
    rollout.add_argument("scene", metavar="SCENE", nargs="?", help="a scene file, whose first frames the solver makes")
    rollout.add_argument("--data", metavar="DIR", help="instead of SCENE: a data set")
    rollout.add_argument("--split", help="of the data set, default: test")
    rollout.add_argument("--variant", help="a named variant of the scene file")
    rollout.add_argument("--seed", type=_whole, help="of the scene's draws, default: 0")
    rollout.add_argument("--count", type=_positive, help="trajectories, default: all of the split, one of a scene")
    rollout.add_argument("--batch", type=_positive, default=1, help="trajectories to roll out together (a GNS can), default: %(default)s")
    rollout.add_argument("--frames", type=_positive, help="predicted frames, default: to the end of the true trajectory or the scene")
    rollout.add_argument("--out", required=True, metavar="FILE", help="shard to write; run times go to FILE.cost.json")
    rollout.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="default: %(default)s")
    rollout.add_argument("--threads", type=_positive, default=1, help="CPU threads, default: %(default)s")
    rollout.set_defaults(act=_rollout)

    info = commands.add_parser("info", help="what a checkpoint holds, as JSON", description="What a checkpoint holds, as JSON.")
    info.add_argument("checkpoint", metavar="CHECKPOINT", help="a best.pt")
    info.set_defaults(act=_info)

    text = "Turn a model of the PyTorch port geoelements/gns into a checkpoint of equal outputs. Options override the metadata."
    taken = commands.add_parser("import-model", help="make a checkpoint of a model of geoelements/gns", description=text)
    taken.add_argument("model", metavar="MODEL", help="a model-<step>.pt")
    taken.add_argument("--metadata", required=True, metavar="FILE", help="the metadata.json of its data")
    taken.add_argument(
        "--edges",
        choices=("updated", "doubled"),
        help="what its version did to them after a block: updated since 11 December 2024, doubled before (v1.1.1, say)",
    )
    taken.add_argument("--noise-std", type=float, metavar="S", help="as given to its train.py, default: 6.7e-4")
    taken.add_argument("--spacing", type=float, metavar="H", help="of the particles")
    taken.add_argument("--gravity", type=float, nargs="+", metavar="G", help="one number an axis, length / s^2")
    taken.add_argument("--types", type=int, nargs="+", metavar="ID", help="particle types that it was trained on")
    taken.add_argument("--out", required=True, metavar="FILE", help="checkpoint to write")
    taken.set_defaults(act=_import_model)

    text = "Write a GNS checkpoint as model-0.pt and metadata.json of the PyTorch port geoelements/gns, of equal outputs."
    given = commands.add_parser("export-model", help="write a checkpoint for geoelements/gns", description=text)
    given.add_argument("checkpoint", metavar="CHECKPOINT", help="a best.pt")
    given.add_argument("--out", required=True, metavar="DIR", help="new folder")
    given.set_defaults(act=_export_model)
    return top


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    parsed = parser().parse_args(arguments)
    try:
        parsed.act(parsed)
    except InputError as error:
        print(f"sluice-learn: {error}", file=sys.stderr)
        return 2
    except (RunError, OSError) as error:
        print(f"sluice-learn: {reason(error) if isinstance(error, OSError) else error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("sluice-learn: interrupted", file=sys.stderr)
        return 130
    return 0
