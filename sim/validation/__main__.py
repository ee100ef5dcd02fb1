"""``python -m sim.validation``: every case at three resolutions, into docs/validation.md and a figure each.

A case that fails its tolerance is written down as such; the page never leaves one out. Exit code 1 when one does.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import sim.validation
from sim.simulator import SimulationError
from sim.trajectory import atomic_path
from sim.validation.case import Case, Result, order

HEAD = """# Validation

Each solver case of the ladder against a formula or an experiment, at three resolutions: error, observed order (slope of log error over log
resolution; meaningless once an error is all rounding or all model), wall time of the frames on one core. A case holds when its *finest* resolution is
within tolerance. Made by `make validate` ({versions}); the cases are in `sim/validation/`, one file each, and the fast ones run in every `make test`.

{verdict}

"""


def cases() -> list[Case]:
    """All cases, by their number in the ladder."""
    modules = [importlib.import_module(f"sim.validation.{module.name}") for module in pkgutil.iter_modules(sim.validation.__path__)
               if module.name not in ("__main__", "case")]
    return sorted((module.CASE for module in modules), key=lambda case: (case.number, case.name))


def _run(name: str, resolution: int) -> Result | str:
    case = next(case for case in cases() if case.name == name)
    try:
        return case.run(resolution)
    except SimulationError as error:
        return str(error)


def figure(case: Case, results: list[Result], path: Path) -> None:
    """Left the reference and ours at each resolution, right error against wall time with the tolerance."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(9, 3.4), layout="constrained")
    left, right = canvas.subplots(1, 2, width_ratios=[1.4, 1])
    for result, shade in zip(results, (0.3, 0.6, 1.0), strict=False):
        left.plot(*result.ours, ".-", ms=3, lw=1, color="C0", alpha=shade, label=f"{result.resolution} cells")
    left.plot(*results[-1].reference, "k--", lw=1.2, label="reference")
    left.set(xlabel=case.axes[0], ylabel=case.axes[1])
    left.legend(fontsize=8)
    right.loglog([each.seconds for each in results], [max(each.error, 1e-9) for each in results], "o-", color="C0")
    for each in results:
        right.annotate(f" {each.resolution}", (each.seconds, max(each.error, 1e-9)), fontsize=8)
    right.axhline(case.tolerance, color="C3", lw=1, label="tolerance")
    right.set(xlabel="wall time [s], one core", ylabel="error")
    right.legend(fontsize=8)
    canvas.suptitle(case.title, fontsize=11)
    with atomic_path(path) as temporary:
        canvas.savefig(temporary, format="svg")


def page(found: dict[str, list[Result | str]], folder: Path, versions: str) -> tuple[str, bool]:
    """The page in Markdown, and whether every case holds; writes the figures into ``folder``/validation."""
    rows, sections, missed = [], [], []
    for case in cases():
        if case.name not in found:
            continue
        results = [each for each in found[case.name] if isinstance(each, Result)]
        broken = [each for each in found[case.name] if not isinstance(each, Result)]
        holds = bool(results) and not broken and results[-1].error <= case.tolerance
        if not holds:
            missed.append(case.title)
        errors = " / ".join(f"{each.error:.2g}" if isinstance(each, Result) else "failed" for each in found[case.name])
        seconds = " / ".join(f"{each.seconds:.1f}" if isinstance(each, Result) else "-" for each in found[case.name])
        rate = f"{order(results):.1f}" if len(results) == 3 else "-"
        cells = [f"[{case.title}](#{case.name})", case.reference, errors, f"{case.tolerance:g}", "yes" if holds else "**no**", rate, seconds]
        rows.append(f"| {case.number} | " + " | ".join(cells) + " |")
        lines = [f'<a id="{case.name}"></a>', f"## {case.number}. {case.title}", ""]
        lines += [f"Reference: {case.reference}. Error: {case.quantity}. Resolution: {case.unit}.", ""]
        lines += [f"- {each.resolution}: {each.found}" if isinstance(each, Result) else f"- failed: {each}" for each in found[case.name]]
        if results:
            figure(case, results, folder / "validation" / f"{case.name}.svg")
            lines += ["", f"![{case.title}: ours beside the reference, and error over run time](validation/{case.name}.svg)"]
        sections.append("\n".join(lines))
    verdict = f"All {len(rows)} cases hold." if not missed else f"{len(rows) - len(missed)} of {len(rows)} cases hold. Missed: {', '.join(missed)}."
    table = "\n".join(["| | case | reference | error, coarse / middle / fine | tolerance | holds | order | seconds |", "|---|" + "---|" * 7, *rows])
    return "\n\n".join([HEAD.format(versions=versions, verdict=verdict).strip(), table, *sections]) + "\n", not missed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ladder; see the module."""
    import taichi

    from sim import __version__

    known = [case.name for case in cases()]
    parser = argparse.ArgumentParser(prog="python -m sim.validation", description="Run the validation ladder.")
    parser.add_argument("names", nargs="*", metavar="CASE", help=f"these cases only: {', '.join(known)}")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of validation.md and validation/*.svg (default docs)")
    parser.add_argument("--jobs", type=int, default=1, help="processes; more than the cores would spoil the times (default 1)")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in known]
    if unknown:
        parser.error(f"no such case: {unknown[0]}; those are {', '.join(known)}")
    chosen = [case for case in cases() if not options.names or case.name in options.names]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        runs = {(case.name, resolution): pool.submit(_run, case.name, resolution) for case in chosen for resolution in case.resolutions}
        for (name, resolution), run in runs.items():
            result = run.result()
            said = f"error {result.error:.3g}, {result.found}, {result.seconds:.1f} s" if isinstance(result, Result) else f"failed: {result}"
            print(f"{name} {resolution}: {said}", flush=True)
    found = {case.name: [runs[case.name, resolution].result() for resolution in case.resolutions] for case in chosen}
    text, holds = page(found, options.out, f"sluice {__version__}, taichi {'.'.join(map(str, taichi.__version__))}")
    with atomic_path(options.out / "validation.md") as temporary:
        temporary.write_text(text)
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
