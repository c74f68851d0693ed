"""Where solvers fail, and whether they say so: every solver on every exact problem in every precision.

A failure is an error of more than ten times the tolerance. It is not silent where the solution is flagged (stiff, not
converged, no estimate) or its global estimate is within a factor of five of the true error.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.flow.problems import PROBLEMS, Mixed, NarrowJet
from r2flow.flow.solvers import SOLVERS, EmbeddedMethod, Solution, Velocity, adapts
from r2flow.generators import Field, Sampler
from r2flow.generators.base import Progress
from r2flow.noise import Draws, generator
from r2flow.reports.pages import Page, blank_figure
from r2flow.reports.tables import table

Row = dict[str, Any]

PRECISIONS: dict[str, tuple[torch.dtype, torch.dtype | None]] = {  # of the state, of the network where it differs
    "float64": (torch.float64, None),
    "float32": (torch.float32, None),
    "bfloat16 network": (torch.float32, torch.bfloat16),
    "float16 network": (torch.float32, torch.float16),
}
FAILS_AT = 10.0  # times the tolerance
HONEST_WITHIN = 5.0  # of the true error
JET = "narrow_jet"  # the known exception: nothing evaluated on either side of it shows it
COMPARED = tuple(name for name in SOLVERS if name != "exprb43")  # auto takes it where it is needed
FINISHED = ("point_mass", "narrow_gaussian", "ray_drop")


class Trial(NamedTuple):
    """A solver on a problem; `tolerance` is None for one of fixed steps, `finish` is left to a last Euler step."""

    problem: str
    finish: float
    precision: str
    solver: str
    tolerance: float | None


def cells(
    problems: Iterable[str] = tuple(PROBLEMS),
    solvers: Iterable[str] = COMPARED,
    tolerances: Sequence[float] = (1e-3, 1e-5),
) -> list[Trial]:
    """Every problem, precision, solver and, of adaptive solvers, tolerance; those of `FINISHED` also with a last Euler
    step of 1e-3."""
    return [
        Trial(problem, finish, precision, solver, tolerance)
        for problem, precision, solver in itertools.product(problems, PRECISIONS, solvers)
        for finish in ((0.0, 1e-3) if problem in FINISHED else (0.0,))
        for tolerance in (tolerances if adapts(solver) else (None,))
    ]


def stability(
    chosen: Sequence[Trial],
    steps: int = 32,
    scans: int = 8,
    elements: int = 64,
    seed: int = 0,
    max_evaluations: int = 5000,
    progress: Progress = None,
) -> list[Row]:
    """One row of plain values for each cell.

    Args:
        steps: Of the fixed-step solvers.
        max_evaluations: Of an adaptive solver for a scan.
        progress: Called after every row.

    Returns:
        `error` is the root mean square over the elements of the worst scan, `estimate` that scan's global estimate
        (None: none), `verdict` one of accurate, flagged, owned up, silent and no estimate.
    """
    x_0 = Draws(seed, range(scans)).start((elements,))
    rows = []
    for cell in chosen:
        rows.append(_row(cell, steps, x_0, max_evaluations))
        if progress is not None:
            progress()
    return rows


def _row(cell: Trial, steps: int, x_0: Tensor, max_evaluations: int) -> Row:
    problem, tolerance = PROBLEMS[cell.problem](), cell.tolerance
    state, network = PRECISIONS[cell.precision]
    flow = Field(_in_precision(problem, network), x_0.shape[1:])
    x_0, sampler = x_0.to(state), Sampler(cell.solver, steps).changed(tolerance=tolerance)
    limits: dict[str, Any] = {"finish": cell.finish, "max_evaluations": max_evaluations}
    solution = flow.solve(x_0, sampler=sampler, global_error=tolerance is not None, **limits)
    extra = 0.0 if solution.estimate_evaluations is None else _mean(solution.estimate_evaluations)
    errors = _rms(solution.x.double() - problem.solution(x_0, 1.0))
    worst, estimates = int(errors.argmax()), solution.global_error
    estimate = math.nan if estimates is None else estimates[worst].item()
    verdict, unestimated = _verdict(solution, errors, tolerance)
    return {
        **cell._asdict(),
        "steps": None if tolerance is not None else steps,
        "error": errors[worst].item(),
        "estimate": estimate if math.isfinite(estimate) else None,
        "evaluations": _mean(solution.evaluations) - extra,
        "estimate_evaluations": extra,
        "stiff": _mean(solution.stiff),
        "converged": _mean(solution.converged),
        "estimated": 0.0 if estimates is None else _mean(estimates.isfinite()),
        "verdict": verdict,
        "by_missing_estimate": unestimated,
    }


def _verdict(solution: Solution, errors: Tensor, tolerance: float | None) -> tuple[str, bool]:
    """The verdict, and whether a scan's failure shows by nothing but that the tighter solution did not converge."""
    estimate = solution.global_error
    if tolerance is None or estimate is None:
        return "no estimate", False
    failed, missing = errors > FAILS_AT * tolerance, ~estimate.isfinite()
    if not failed.any():
        return "accurate", False
    known = solution.stiff | ~solution.converged
    honest = (estimate >= errors / HONEST_WITHIN) & (estimate <= errors * HONEST_WITHIN)
    silent, flagged = failed & ~known & ~missing & ~honest, failed & (known | missing)
    verdict = "silent" if silent.any() else "flagged" if flagged.any() else "owned up"
    return verdict, bool((failed & ~known & missing).any())


def jet_probe(
    shares: Sequence[float] = (1.0, 1 / 8, 1 / 16, 1 / 32, 1 / 64, 1 / 128), scans: int = 64, seed: int = 0
) -> list[Row]:
    """How many narrow jets at random times a limit on the longest step finds, and what it costs."""
    tolerance = 1e-3
    draws = generator(seed, "evaluation", 0)
    jets = Mixed([NarrowJet(at=float(at)) for at in draws.uniform(0.1, 0.9, scans)])
    x_0 = torch.from_numpy(draws.standard_normal((scans, 16)))
    exact = jets.solution(x_0, 1.0)
    rows = []
    explicit = [name for name in SOLVERS if isinstance(SOLVERS[name], EmbeddedMethod)]
    for solver, share in itertools.product(explicit, shares):
        solution = Field(jets, (16,)).solve(x_0, sampler=Sampler(solver, tolerance=tolerance), max_step=share)
        found = _mean(_rms(solution.x - exact) <= FAILS_AT * tolerance)
        row: Row = {"solver": solver, "tolerance": tolerance, "longest_step": share, "found": found}
        rows.append({**row, "evaluations": _mean(solution.evaluations)})
    return rows


def _in_precision(velocity: Velocity, dtype: torch.dtype | None) -> Velocity:
    """A velocity as a network in half precision gives it: x rounded before it, v after it; t stays in float32."""
    if dtype is None:
        return velocity
    return lambda t, x: velocity(t, x.to(dtype).to(x.dtype)).to(dtype)


def _rms(difference: Tensor) -> Tensor:
    """Root mean square over the elements of each scan, (B,); of differences whose squares overflow, too."""
    flat = difference.double().flatten(1)
    largest = flat.abs().amax(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    return largest[:, 0] * (flat / largest).square().mean(1).sqrt()


def _mean(values: Tensor) -> float:
    return values.double().mean().item()


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """How many cells of adaptive solvers fail, how many of these say so, and which do not, the jet apart."""
    adaptive = [row for row in rows if row["tolerance"] is not None and row["problem"] != JET]
    failed = [row for row in adaptive if row["verdict"] != "accurate"]
    silent = [row for row in failed if row["verdict"] == "silent"]
    covered = [row for row in failed if row["verdict"] != "silent"]
    return {
        "cells": len(rows),
        "failed": len(failed),
        "covered": len(covered),
        "by_missing_estimate": sum(row["by_missing_estimate"] for row in covered),
        "share": len(covered) / len(failed) if failed else 1.0,
        "silent": [" / ".join(_line(row)[:4]) for row in silent],
        "silent_jets": sum(row["problem"] == JET and row["verdict"] == "silent" for row in rows),
    }


COLUMNS = ("problem", "precision", "solver", "tolerance", "error", "estimate", "evaluations", "flags", "verdict")


def stability_page(rows: Sequence[Row], probe: Sequence[Row] = (), seed: int = 0, command: str = "") -> Page:
    """The report: how many failures say so, the probe of the jet, every cell."""
    total = summary(rows)
    silent = f" Silent: {'; '.join(total['silent'])}." if total["silent"] else ""
    share = (
        f"**{total['covered']} of these ({total['share']:.0%}) say so**" if total["failed"] else "those that do say so"
    )
    text = [
        f"Of {total['cells']} cells, {total['failed']} of an adaptive solver have an error of more than {FAILS_AT:g} "
        f"times the tolerance (the narrow jet apart); {share}: "
        f"they are flagged, or their global estimate is within a factor of {HONEST_WITHIN:g} of the true error. "
        f"{total['by_missing_estimate']} of them count only because the tighter solution did not converge, so that "
        f"there is no estimate.{silent} The narrow jet is the known exception: {total['silent_jets']} of its cells "
        "fail in silence. Fixed-step solvers give no estimate.",
    ]
    if probe:
        lines = [
            (row["solver"], f"{row['tolerance']:.0e}",
             f"1/{1 / row['longest_step']:.0f}" if row["longest_step"] < 1 else "any",
             f"{row['found']:.0%}", f"{row['evaluations']:.0f}")
            for row in probe
        ]  # fmt: skip
        headings = ("solver", "tolerance", "longest step", "jets found", "evaluations")
        text += ["A limit on the longest step finds narrow jets (width 2e-3, at random times):", table(lines, headings)]
    text += [
        "Error: root mean square over the worst scan's elements. Evaluations: mean over scans, the estimate's own in "
        "brackets. Flags: s stiff, n not converged, e no estimate.",
        table([_line(row) for row in rows], COLUMNS),
    ]
    return Page(
        "stability", "Where solvers fail, and whether they say so", text, rows, {"stability": stability_figure(rows)},
        command, {"scenes": seed}, more={"jet_probe": probe},
    )  # fmt: skip


def _line(row: Row) -> list[str]:
    """The cells of a row in the table."""
    adaptive = row["tolerance"] is not None
    flags = {"s": row["stiff"] > 0, "n": row["converged"] < 1, "e": adaptive and row["estimated"] < 1}
    return [
        row["problem"] + (f", finish {row['finish']:g}" if row["finish"] else ""),
        row["precision"],
        row["solver"],
        f"{row['tolerance']:.0e}" if adaptive else f"{row['steps']} steps",
        f"{row['error']:.1e}",
        "-" if row["estimate"] is None else f"{row['estimate']:.1e}",
        f"{row['evaluations']:.0f}" + (f" (+{row['estimate_evaluations']:.0f})" if adaptive else ""),
        "".join(letter for letter, up in flags.items() if up) or "-",
        f"**{row['verdict']}**" if row["verdict"] == "silent" else row["verdict"],
    ]


SILENT_JET = "silent, the jet"
# Marker and its face; shade and hatch of the bar: told apart without colour.
VERDICTS = {
    "accurate": ("o", "none", "1.0", ""),
    "owned up": ("s", "0.6", "0.85", "//"),
    "flagged": ("^", "none", "0.95", ".."),
    "silent": ("X", "black", "0.5", "xx"),
    SILENT_JET: ("P", "0.3", "0.7", "\\\\"),
    "no estimate": ("", "", "1.0", "--"),
}


def stability_figure(rows: Sequence[Row]) -> Figure:
    """Left: estimated against true error, the band of a factor of five. Right: verdicts by precision."""
    figure = blank_figure(12, 5.2)
    left, right = figure.subplots(1, 2)
    ends = np.array([1e-9, 1e2])
    left.plot(ends, ends, color="black", linewidth=0.8)
    left.fill_between(ends, ends / HONEST_WITHIN, ends * HONEST_WITHIN, color="0.9")
    by_verdict: dict[str, list[Row]] = {verdict: [] for verdict in VERDICTS}
    for row in rows:
        jet = row["problem"] == JET and row["verdict"] == "silent"
        by_verdict[SILENT_JET if jet else row["verdict"]].append(row)
    names = list(dict.fromkeys(row["precision"] for row in rows))
    start = np.zeros(len(names))
    for verdict, (marker, face, shade, hatch) in VERDICTS.items():
        own = by_verdict[verdict]
        if marker:
            known = [row for row in own if row["estimate"] is not None]
            points = [[max(row[key], ends[0]) for row in known] for key in ("error", "estimate")]
            label = f"{verdict} ({len(known)})"
            left.scatter(*points, marker=marker, facecolors=face, edgecolors="black", s=26, label=label)
        counts = [sum(row["precision"] == name for row in own) for name in names]
        right.barh(names, counts, left=start, color=shade, hatch=hatch, edgecolor="black", label=verdict)
        start += counts
    left.set(xscale="log", yscale="log", xlabel="true error", ylabel="global estimate")
    left.set_title("Global estimate against true error (grey: within a factor of five)", fontsize=10)
    left.legend(fontsize=8)
    right.invert_yaxis()
    right.set(xlabel="cells")
    right.set_title("Verdicts", fontsize=10)
    right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=6, frameon=False)
    return figure
