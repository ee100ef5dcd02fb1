"""``python -m sim.validation``: every case by each of its methods at three resolutions, into docs/validation.md and a figure each.

A case that fails its tolerance is written down as such; the page never leaves one out. Exit code 1 when one does.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import itertools
import textwrap
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from sim.simulator import SimulationError
from sim.trajectory import atomic_path
from sim.validation import CASES, Outcome

HEAD = """# Validation

The solvers against formulae and experiments, each case by every method it applies to (`mpm`; `wcsph` and `dfsph`, smoothed particle
hydrodynamics; `pbf`, position-based) and at three resolutions: error, observed order (slope of log error over log resolution; it
means nothing once an error is all rounding or all model), wall time of the frames on one core. A case holds when every error at its *finest*
resolution is within tolerance. Made by `make validate` ({versions}); a case is one small file of `sim/validation/`, and the tests run each
at a resolution that takes seconds.
"""


def module(case: str):
    """The module of a case."""
    return importlib.import_module(f"sim.validation.{case}")


def methods(case: str) -> tuple[str, ...]:
    """Solvers of a case; MPM alone where it does not say."""
    return getattr(module(case), "METHODS", ("mpm",))


def run(case: str, resolution: int, method: str) -> Outcome:
    """One run of a case by one of its methods."""
    what = module(case)
    return what.run(resolution, method) if hasattr(what, "METHODS") else what.run(resolution)


def _run(case: str, resolution: int, method: str) -> Outcome | str:
    try:
        return run(case, resolution, method)
    except SimulationError as error:
        return str(error)


def order(resolutions: Sequence[int], errors: Sequence[float]) -> float:
    """Observed order of convergence: minus the slope of log |error| over log resolution, by least squares."""
    return float(-np.polyfit(np.log(resolutions), np.log(np.maximum(np.abs(errors), 1e-12)), 1)[0])


def _decades(values: Sequence[float]) -> tuple[float, float]:
    """Whole decades about positive values: a shorter logarithmic axis has its ticks' numbers on top of each other."""
    low, high = (np.log10(each(values)) for each in (min, max))
    return 10.0 ** np.floor(low - 0.1), 10.0 ** np.ceil(high + 0.1)


def figure(title: str, found: dict[str, list[Outcome]], path: Path) -> None:
    """A row a comparison: the reference and ours by each method (a colour) and resolution (a shade); error against wall time with the tolerance."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    names = list(dict.fromkeys(name for outcomes in found.values() for name in outcomes[-1].curves))
    canvas = Figure(figsize=(9, 2.9 * len(names) + 0.5), layout="constrained")
    panels = canvas.subplots(len(names), 2, width_ratios=[1.4, 1], squeeze=False)
    for (left, right), name in zip(panels, names, strict=True):
        times: list[float] = []
        sizes: list[float] = []
        last = next(outcomes[-1].curves[name] for outcomes in reversed(found.values()) if name in outcomes[-1].curves)
        for (method, outcomes), color in zip(found.items(), ("C0", "C1", "C2", "C4"), strict=False):
            if name not in outcomes[-1].curves:
                continue
            curves = [outcome.curves[name] for outcome in outcomes]
            for outcome, curve, shade in zip(outcomes, curves, np.linspace(0.3, 1, len(curves)), strict=True):
                marked = ".-" if len(curve.x) < 300 else "-"
                left.plot(curve.x, curve.ours, marked, ms=3, lw=1, color=color, alpha=shade, label=f"{method} {outcome.resolution}")
            seconds, errors = [max(outcome.seconds, 1e-3) for outcome in outcomes], [abs(curve.error) for curve in curves]
            right.plot(seconds, errors, "o-", color=color)
            for outcome, *place in zip(outcomes, seconds, errors, strict=True):
                right.annotate(f" {outcome.resolution}", place, fontsize=8)
            times, sizes = times + seconds, sizes + errors
        left.plot(last.x, last.reference, "k--", lw=1.2, label="reference")
        left.set(xlabel=last.axes[0], ylabel=last.axes[1], title=name)
        left.legend(fontsize=7)
        right.set(xlabel="wall time [s], one core", ylabel="error", xscale="log", xlim=_decades(times))
        right.xaxis.set_minor_formatter(NullFormatter())
        if min(sizes) > 0:  # zero has no place on a logarithmic axis
            right.set_yscale("log")
            right.set_ylim(_decades([*sizes, last.tolerance or sizes[-1]]))
        right.axhline(last.tolerance, color="C3", lw=1, label="tolerance")
        right.legend(fontsize=7)
    canvas.suptitle("\n".join(textwrap.wrap(title, 100)), fontsize=11)
    with atomic_path(path) as temporary:
        canvas.savefig(temporary, format="svg")


def page(found: dict[str, dict[str, list[Outcome | str]]], folder: Path, versions: str) -> tuple[str, bool]:
    """The page in Markdown of what each method of each case found, and whether every case holds; writes the figures into ``folder``/validation."""
    rows, sections, missed = [], [], []
    for case, by_method in found.items():
        what = module(case)
        title = (what.__doc__ or case).splitlines()[0].rstrip(".")
        lines, drawn = [f'<a id="{case}"></a>', f"## {what.NUMBER}. {title}", "", inspect.getdoc(what.run) or "", ""], {}
        for method, results in by_method.items():
            outcomes = [each for each in results if isinstance(each, Outcome)]
            if len(outcomes) < len(results) or not all(curve.passed for curve in outcomes[-1].curves.values()):
                missed.append(f"{title.split(':')[0]} ({method})")
            seconds = " / ".join(f"{each.seconds:.1f}" if isinstance(each, Outcome) else "-" for each in results)
            for name in outcomes[-1].curves if outcomes else ["-"]:
                curves = [each.curves[name] for each in outcomes]
                errors = " / ".join(f"{each.curves[name].error:.2g}" if isinstance(each, Outcome) else "failed" for each in results)
                whole, last = len(curves) == len(results), results[-1]
                passed = whole and curves[-1].passed
                rate = f"{order(what.RESOLUTIONS, [curve.error for curve in curves]):.1f}" if whole else "-"
                tolerance = f"{last.curves[name].tolerance:g}" if isinstance(last, Outcome) else "-"
                head = [str(what.NUMBER), f"[{title.split(':')[0]}](#{case})", method, name]
                rows.append("| " + " | ".join([*head, errors, tolerance, "yes" if passed else "**no**", rate, seconds]) + " |")
            for resolution, each in zip(what.RESOLUTIONS, results, strict=True):
                said = f"failed: {each}" if isinstance(each, str) else "; ".join(curve.label for curve in each.curves.values())
                lines.append(f"- {method}, {resolution}: {said}")
            if outcomes:
                drawn[method] = outcomes
        if drawn:
            figure(title, drawn, folder / "validation" / f"{case}.svg")
            lines += ["", f"![{title}: ours beside the reference, error over run time](validation/{case}.svg)"]
        sections.append("\n".join(lines))
    count = sum(map(len, found.values()))
    verdict = f"{count - len(missed)} of {count} hold. Missed: {', '.join(missed)}." if missed else f"All {count} hold."
    header = ["| | case | method | what | error, coarse / middle / fine | tolerance | holds | order | seconds |", "|---|" + "---|" * 8]
    return "\n\n".join([HEAD.format(versions=versions).strip(), verdict, "\n".join([*header, *rows]), *sections]) + "\n", not missed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ladder; see the module."""
    parser = argparse.ArgumentParser(prog="python -m sim.validation", description="Run the validation ladder.")
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"these alone: {', '.join(CASES)}")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of validation.md and validation/*.svg (default docs)")
    options = parser.parse_args(arguments)
    unknown = [case for case in options.cases if case not in CASES]
    if unknown:
        parser.error(f"no such case: {unknown[0]}; those are {', '.join(CASES)}")
    chosen = sorted(options.cases or CASES, key=lambda case: module(case).NUMBER)
    found: dict[str, dict[str, list[Outcome | str]]] = {}
    # A process of its own, so that times do not depend on what was compiled before; one, so that they do not share the cores.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for case in chosen:
            found[case] = {}
            for method, resolution in itertools.product(methods(case), module(case).RESOLUTIONS):
                outcome = pool.submit(_run, case, resolution, method).result()
                found[case].setdefault(method, []).append(outcome)
                said = (
                    f"failed: {outcome}"
                    if isinstance(outcome, str)
                    else ", ".join(f"{name} {curve.error:.3g} ({curve.tolerance:g})" for name, curve in outcome.curves.items())
                    + f", {outcome.seconds:.1f} s"
                )
                print(f"{case} {method} {resolution}: {said}", flush=True)
    import taichi

    from sim import __version__

    text, holds = page(found, options.out, f"sluice {__version__}, taichi {'.'.join(map(str, taichi.__version__))}")
    with atomic_path(options.out / "validation.md") as temporary:
        temporary.write_text(text)
    return 0 if holds else 1
