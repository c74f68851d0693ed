"""Where solvers fail, and whether they say so: every solver on every exact problem in every precision.

A failure is an error of more than ten times the tolerance. It is not silent where the solution is flagged (stiff, not
converged, no estimate to be had) or owns up to it by a global estimate within a factor of five of the true error.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.flow.problems import PROBLEMS, Mixed, NarrowJet
from r2flow.flow.solvers import SOLVERS, Solution, Velocity, adapts
from r2flow.generators import Field, Sampler
from r2flow.noise import generator, standard_normal
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
KNOWN_EXCEPTION = "narrow_jet"
FINISHED = ("point_mass", "narrow_gaussian", "ray_drop")


def stability(
    problems: Iterable[str] = tuple(PROBLEMS),
    solvers: Iterable[str] = tuple(SOLVERS),
    precisions: Iterable[str] = tuple(PRECISIONS),
    tolerances: Sequence[float] = (1e-3, 1e-5),
    steps: int = 32,
    scenes: int = 8,
    elements: int = 64,
    seed: int = 0,
    max_evaluations: int = 5000,
    progress: Callable[[], None] | None = None,
) -> list[Row]:
    """One row for each problem, solver, precision and, of adaptive solvers, tolerance; the point mass also with the
    last 1e-3 left to an Euler step, and so the narrow Gaussian and the ray-drop.

    Args:
        steps: Of the fixed-step solvers.
        scenes: A row tells of its worst scene.
        max_evaluations: An adaptive solver's budget for a scene.
        progress: Called after every row.

    Returns:
        Rows of plain values: `error` is the root mean square over the elements of the worst scene, `estimate` that
        scene's global estimate (None: none), `verdict` one of accurate, flagged, owned up, silent and no estimate.
    """
    x_0 = torch.stack([standard_normal((elements,), seed, "evaluation", scene) for scene in range(scenes)])
    rows = []
    for name, precision, solver in itertools.product(problems, precisions, solvers):
        for finish in (0.0, 1e-3) if name in FINISHED else (0.0,):
            for tolerance in tolerances if adapts(solver) else (None,):
                rows.append(_cell(name, precision, solver, tolerance, steps, finish, x_0, max_evaluations))
                if progress is not None:
                    progress()
    return rows


def jet_probe(
    tolerance: float = 1e-3,
    shares: Sequence[float] = (1.0, 1 / 8, 1 / 16, 1 / 32, 1 / 64, 1 / 128),
    scenes: int = 64,
    seed: int = 0,
) -> list[Row]:
    """What a limit on the longest step buys against narrow jets, at random times, and what it costs."""
    draws = generator(seed, "evaluation", 0)
    jets = Mixed([NarrowJet(at=float(at)) for at in draws.uniform(0.1, 0.9, scenes)])
    x_0 = torch.from_numpy(draws.standard_normal((scenes, 16)))
    exact = jets.solution(x_0, 1.0)
    rows = []
    for solver, share in itertools.product([name for name, _ in SOLVERS.items() if adapts(name)], shares):
        solution = Field(jets, (16,)).solve(x_0, sampler=Sampler(solver, tolerance=tolerance), max_step=share)
        found = _rms(solution.x - exact) <= FAILS_AT * tolerance
        rows.append(
            {
                "solver": solver,
                "tolerance": tolerance,
                "longest_step": share,
                "found": found.double().mean().item(),
                "evaluations": solution.evaluations.double().mean().item(),
            }
        )
    return rows


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """How many cells of adaptive solvers fail, how many of these say so, and which do not, the jet apart."""
    failed = [row for row in rows if row["tolerance"] is not None and row["verdict"] != "accurate"]
    failed = [row for row in failed if row["problem"] != KNOWN_EXCEPTION]
    silent = [_name(row) for row in failed if row["verdict"] == "silent"]
    covered = len(failed) - len(silent)
    unestimated = [row for row in failed if row["by_missing_estimate"] and row["verdict"] != "silent"]
    return {
        "cells": len(rows),
        "failed": len(failed),
        "covered": covered,
        "by_missing_estimate": len(unestimated),
        "share": covered / len(failed) if failed else 1.0,
        "silent": silent,
        "silent_jets": sum(row["problem"] == KNOWN_EXCEPTION and row["verdict"] == "silent" for row in rows),
    }


def markdown(rows: Sequence[Row], probe: Sequence[Row] = ()) -> str:
    """The table with what it says in words."""
    total = summary(rows)
    lines = [
        f"Of {total['cells']} cells, {total['failed']} of an adaptive solver err by more than {FAILS_AT:g} times the "
        f"tolerance (the narrow jet apart); **{total['covered']} of these ({total['share']:.0%}) say so**: they are "
        f"flagged, or their global estimate is within a factor of {HONEST_WITHIN:g} of the true error. "
        f"{total['by_missing_estimate']} of them count only because the tighter solution did not converge, so that "
        "there is no estimate.",
        "Fixed-step solvers give no estimate: they have no tolerance to fail.",
        f"The narrow jet is the known exception: {total['silent_jets']} of its cells fail in silence, since nothing "
        "that is evaluated on either side of it shows it.",
        "",
    ]
    if total["silent"]:
        lines += ["Silent: " + "; ".join(total["silent"]) + ".", ""]
    if probe:
        lines += _probe_table(probe)
    lines += [
        "Error: root mean square over the worst scene's elements. Evaluations: mean over scenes, the estimate's own in "
        "brackets. Flags: s stiff, n not converged, e no estimate to be had.",
        "",
        table([_line(row) for row in rows], HEADINGS),
    ]
    return "\n".join(lines) + "\n"


HEADINGS = (
    "problem", "precision", "solver", "tolerance", "error", "estimate", "evaluations", "flags", "verdict",
)  # fmt: skip


def figure(rows: Sequence[Row]) -> Figure:
    """Left: estimated against true error, the band of a factor of five. Right: verdicts by precision."""
    drawn = Figure(figsize=(12, 5.2), layout="constrained")
    FigureCanvasAgg(drawn)
    left, right = drawn.subplots(1, 2)
    _draw_estimates(left, [row for row in rows if row["tolerance"] is not None])
    _draw_verdicts(right, rows)
    return drawn


class HalfPrecision:
    """A velocity as a network in half precision gives it: x rounded before it, v after it; t stays in float32."""

    def __init__(self, velocity: Velocity, dtype: torch.dtype) -> None:
        self.velocity, self.dtype = velocity, dtype

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        return self.velocity(t, x.to(self.dtype).to(x.dtype)).to(self.dtype)


def _cell(
    name: str,
    precision: str,
    solver: str,
    tolerance: float | None,
    steps: int,
    finish: float,
    x_0: Tensor,
    max_evaluations: int,
) -> Row:
    problem = PROBLEMS[name]()
    state, network = PRECISIONS[precision]
    velocity = HalfPrecision(problem, network) if network else problem
    x_0 = x_0.to(state)
    sampler = Sampler(solver, steps).changed(tolerance=tolerance)
    solution = Field(velocity, x_0.shape[1:]).solve(
        x_0, sampler=sampler, finish=finish, max_evaluations=max_evaluations, global_error=tolerance is not None
    )
    extra = 0.0 if solution.estimate_evaluations is None else solution.estimate_evaluations.double().mean().item()
    errors = _rms(solution.x.double() - problem.solution(x_0, 1.0))
    worst = int(errors.argmax())
    estimate = None if solution.global_error is None else solution.global_error[worst].item()
    return {
        "problem": name,
        "finish": finish,
        "precision": precision,
        "solver": solver,
        "tolerance": tolerance,
        "steps": None if tolerance is not None else steps,
        "error": errors[worst].item(),
        "estimate": estimate if estimate is not None and math.isfinite(estimate) else None,
        "evaluations": solution.evaluations.double().mean().item() - extra,
        "estimate_evaluations": extra,
        "stiff": solution.stiff.double().mean().item(),
        "converged": solution.converged.double().mean().item(),
        "estimated": 0.0 if estimate is None else solution.global_error.isfinite().double().mean().item(),  # type: ignore[union-attr]
        "verdict": _verdict(solution, errors, tolerance),
        "by_missing_estimate": _by_missing_estimate(solution, errors, tolerance),
    }


def _verdict(solution: Solution, errors: Tensor, tolerance: float | None) -> str:
    if tolerance is None or solution.global_error is None:
        return "no estimate"
    failed = errors > FAILS_AT * tolerance
    if not failed.any():
        return "accurate"
    estimate = solution.global_error
    flagged = solution.stiff | ~solution.converged | ~estimate.isfinite()
    honest = (estimate >= errors / HONEST_WITHIN) & (estimate <= errors * HONEST_WITHIN)
    if (failed & ~flagged & ~honest).any():
        return "silent"
    return "flagged" if (failed & flagged).any() else "owned up"


def _by_missing_estimate(solution: Solution, errors: Tensor, tolerance: float | None) -> bool:
    """Whether some scene's failure shows by nothing but that the tighter solution did not converge."""
    if tolerance is None or solution.global_error is None:
        return False
    failed = errors > FAILS_AT * tolerance
    return bool((failed & ~solution.stiff & solution.converged & ~solution.global_error.isfinite()).any())


def _rms(difference: Tensor) -> Tensor:
    """Root mean square over the elements of each scene, (B,); of differences whose squares overflow, too."""
    flat = difference.double().flatten(1)
    largest = flat.abs().amax(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    return largest[:, 0] * (flat / largest).square().mean(1).sqrt()


def _name(row: Row) -> str:
    finish = f", finish {row['finish']:g}" if row["finish"] else ""
    return f"{row['problem']}{finish} / {row['precision']} / {row['solver']} / {row['tolerance']:g}"


def _line(row: Row) -> tuple[str, ...]:
    problem = row["problem"] + (f", finish {row['finish']:g}" if row["finish"] else "")
    held = f"{row['steps']} steps" if row["tolerance"] is None else f"{row['tolerance']:.0e}"
    estimate = "-" if row["estimate"] is None else f"{row['estimate']:.1e}"
    extra = f" (+{row['estimate_evaluations']:.0f})" if row["tolerance"] is not None else ""
    unestimated = row["tolerance"] is not None and row["estimated"] < 1
    raised = [("s", row["stiff"] > 0), ("n", row["converged"] < 1), ("e", unestimated)]
    flags = "".join(letter for letter, up in raised if up) or "-"
    verdict = f"**{row['verdict']}**" if row["verdict"] == "silent" else row["verdict"]
    return (
        problem, row["precision"], row["solver"], held, f"{row['error']:.1e}", estimate,
        f"{row['evaluations']:.0f}{extra}", flags, verdict,
    )  # fmt: skip


def _probe_table(probe: Sequence[Row]) -> list[str]:
    lines = []
    for row in probe:
        share = f"1/{1 / row['longest_step']:.0f}" if row["longest_step"] < 1 else "any"
        lines.append(
            (row["solver"], f"{row['tolerance']:.0e}", share, f"{row['found']:.0%}", f"{row['evaluations']:.0f}")
        )
    said = "A limit on the longest step looks for narrow jets (width 2e-3, at random times) at a price:"
    return [said, "", table(lines, ("solver", "tolerance", "longest step", "jets found", "evaluations")), ""]


MARKERS = {"accurate": ("o", "none"), "owned up": ("s", "0.6"), "flagged": ("^", "none"), "silent": ("X", "black")}
JET = "silent, the jet"
HATCHES = {"accurate": "", "owned up": "//", "flagged": "..", "silent": "xx", JET: "\\\\", "no estimate": "--"}
SHADES = ("1.0", "0.85", "0.95", "0.5", "0.7", "1.0")


def _draw_estimates(axes: Any, rows: Sequence[Row]) -> None:
    ends = [1e-9, 1e2]
    axes.plot(ends, ends, color="black", linewidth=0.8)
    axes.fill_between(ends, [e / HONEST_WITHIN for e in ends], [e * HONEST_WITHIN for e in ends], color="0.9")
    for verdict, (marker, face) in MARKERS.items():
        told = [row for row in rows if row["verdict"] == verdict and row["estimate"] is not None]
        points = [(max(row["error"], ends[0]), max(row["estimate"], ends[0])) for row in told]
        x, y = zip(*points, strict=True) if points else ((), ())
        axes.scatter(x, y, marker=marker, facecolors=face, edgecolors="black", s=26, label=f"{verdict} ({len(told)})")
    axes.set(xscale="log", yscale="log", xlabel="true error", ylabel="global estimate")
    axes.set_title("Does the estimate own up? (grey: within a factor of five)", fontsize=10)
    axes.legend(fontsize=8)


def _draw_verdicts(axes: Any, rows: Sequence[Row]) -> None:
    names = list(dict.fromkeys(row["precision"] for row in rows))
    start = [0] * len(names)
    for shade, (verdict, hatch) in zip(SHADES, HATCHES.items(), strict=True):
        counts = [sum(row["precision"] == name and _shown_as(row) == verdict for row in rows) for name in names]
        axes.barh(names, counts, left=start, color=shade, hatch=hatch, edgecolor="black", label=verdict)
        start = [before + count for before, count in zip(start, counts, strict=True)]
    axes.invert_yaxis()
    axes.set(xlabel="cells")
    axes.set_title("What became of the cells", fontsize=10)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=6, frameon=False)


def _shown_as(row: Row) -> str:
    return JET if row["problem"] == KNOWN_EXCEPTION and row["verdict"] == "silent" else row["verdict"]
