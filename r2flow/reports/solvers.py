"""Error against run time of every solver, on exact problems (smooth, stiff, extreme) and on a trained flow.

A second table judges adaptive solvers where they fail. A failure is an error of more than ten times the tolerance. It
is not silent where the solution is flagged (stiff, not converged, no estimate) or where its global estimate is within a
factor of five of the true error.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import SOLVERS, TORCHDIFFEQ, Solution, Velocity, method_of, solve, usual_grid
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.inversion import metres_apart, rms
from r2flow.lidar.encoding import Encoding
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import shown, table
from r2flow.reports.timing import timed

Row = Mapping[str, Any]

METHODS = (*SOLVERS, f"{TORCHDIFFEQ}dopri5")
MOST_EVALUATIONS = 1000  # of an adaptive method for a scan; one that needs more is of no use here
PATIENCE = 0.5  # seconds after which a configuration is not timed again
TRUST = 3.0  # an error can be measured when it is this many times the reference's own
ROUNDING = 1e-9  # the least error that is told apart from rounding in float64
WANTED = (0.2, 0.05, 0.01)  # RMS errors of the range, m

PRECISIONS: dict[str, tuple[torch.dtype, torch.dtype | None]] = {  # of the state, of the network where it differs
    "float64": (torch.float64, None),
    "float32": (torch.float32, None),
    "bfloat16 network": (torch.float32, torch.bfloat16),
    "float16 network": (torch.float32, torch.float16),
}
FAILS_AT = 10.0  # times the tolerance
HONEST_WITHIN = 5.0  # of the true error
JET = "narrow_jet"  # the known exception: nothing evaluated on either side of it shows it


@dataclass(frozen=True)
class Configuration:
    """A solver at a number of steps, or at a tolerance."""

    method: str
    steps: int | None = None
    tolerance: float | None = None

    @property
    def label(self) -> str:
        """'midpoint, 8 steps', 'dopri5, 1e-03'."""
        if self.steps is None:
            return f"{self.method}, {self.tolerance:.0e}"
        return f"{self.method}, {self.steps} step{'s' * (self.steps > 1)}"

    @property
    def options(self) -> str:
        """As options of `r2flow sample`."""
        if self.steps is None:
            return f"--sampler {self.method} --tolerance {self.tolerance:g}"
        return f"--sampler {self.method} --steps {self.steps} --grid {usual_grid(self.method)}"

    def solve(self, velocity: Velocity, x_0: Tensor, **options: Any) -> Solution:
        """x_1 from x_0."""
        if self.steps is None:
            assert self.tolerance is not None
            return solve(velocity, x_0, method=self.method, tolerance=self.tolerance, **options)
        return solve(velocity, x_0, method=self.method, steps=self.steps, grid=usual_grid(self.method), **options)


def configurations(methods: Sequence[str], budgets: Sequence[int], tolerances: Sequence[float]) -> list[Configuration]:
    """Every fixed-step method at the numbers of steps that fit the budgets, every adaptive one at the tolerances."""
    chosen: list[Configuration] = []
    for method in methods:
        how = method_of(method)
        if how.adapts:
            chosen += [Configuration(method, tolerance=tolerance) for tolerance in tolerances]
            continue
        start, per_step = getattr(how, "start", 0), getattr(how, "evaluations", 1)
        steps = sorted({(budget - start) // per_step for budget in budgets if budget >= start + per_step})
        chosen += [Configuration(method, steps=count) for count in steps]
    return chosen


@dataclass(frozen=True)
class Subject:
    """A velocity with known ends.

    Attributes:
        x_0: Starts of the scans, (N, ...), on the velocity's device.
        x_1: Their ends, (N, ...), float64.
        floor: The least root mean square error that can be measured against `x_1`.
        encoding: None for a problem without metres.
    """

    name: str
    velocity: Velocity
    x_0: Tensor
    x_1: Tensor
    batch_size: int
    floor: float = ROUNDING
    encoding: Encoding | None = None


def problem_subjects(names: Sequence[str], scans: int = 16, elements: int = 64) -> list[Subject]:
    """Exact problems of `r2flow.flow.problems` on Gaussian starts, in float64."""
    x_0 = Draws(0, range(scans)).start((elements,)).double()
    problems = {name: PROBLEMS[name]() for name in names}
    return [Subject(name, problem, x_0, problem.solution(x_0, 1.0), scans) for name, problem in problems.items()]


def checkpoint_subject(
    checkpoint: Checkpoint,
    name: str,
    num: int = 4,
    seed: int = 0,
    batch_size: int = 1,
    steps: int = 128,
    tolerance: float = 1e-7,
    progress: Progress = None,
) -> Subject:
    """A trained flow and its reference solution: rk4 in many steps with a float64 state.

    `floor` is three times the largest distance from dopri5 at a tight tolerance, inf where either did not converge.
    """
    flow = as_flow(checkpoint.generator, "this report")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    ends, apart = [], []
    with torch.inference_mode():
        for scan in x_0.double().split(1):
            rk4 = solve(flow.velocity, scan, method="rk4", steps=steps, progress=progress)
            dopri5 = solve(flow.velocity, scan, method="dopri5", tolerance=tolerance)
            ends.append(rk4.x)
            solved = bool(rk4.converged.all() and dopri5.converged.all())
            apart.append(rms(rk4.x - dopri5.x).item() if solved else math.inf)
    return Subject(name, flow.velocity, x_0, torch.cat(ends), batch_size, TRUST * max(apart), checkpoint.encoding)


def measure(
    subjects: Sequence[Subject], chosen: Sequence[Configuration], repeats: int = 5, progress: Progress = None
) -> list[dict[str, Any]]:
    """Error, evaluations and seconds of every configuration on every subject, a row each.

    The configurations take turns, so that whatever else the machine does slows all of them alike.

    Args:
        repeats: The most timed solutions of a scan; the error is that of the first.
        progress: Called for every subject and configuration.
    """
    rows = []
    for subject in subjects:
        seconds: list[list[float]] = [[] for _ in chosen]
        found: list[list[Solution]] = [[] for _ in chosen]
        with torch.inference_mode():
            subject.velocity(torch.zeros((), device=subject.x_0.device), subject.x_0[:1])  # warm up
            for repeat, (i, one) in product(range(repeats), enumerate(chosen)):
                for x_0 in subject.x_0.split(subject.batch_size) if repeat == 0 or sum(seconds[i]) < PATIENCE else ():
                    call = partial(one.solve, subject.velocity, x_0, max_evaluations=MOST_EVALUATIONS)
                    solution, taken = timed(call, x_0.device)
                    seconds[i].append(taken / len(x_0))
                    if repeat == 0:
                        found[i].append(solution)
                if progress is not None and repeat == 0:
                    progress()
        rows += [_row(subject, *one) for one in zip(chosen, seconds, found, strict=True)]
    return rows


def _row(subject: Subject, one: Configuration, seconds: list[float], found: Sequence[Solution]) -> dict[str, Any]:
    x_1 = torch.cat([solution.x for solution in found])
    errors = rms(x_1 - subject.x_1)
    row = {
        "problem": subject.name, "method": one.method, "steps": one.steps, "tolerance": one.tolerance,
        "label": one.label, "options": one.options, "scans": len(errors),
        "evaluations": float(torch.cat([solution.evaluations for solution in found]).double().mean()),
        "seconds": float(np.median(seconds)), "error": float(errors.median()), "error_worst": float(errors.max()),
        "floor": subject.floor, "length": float(rms(subject.x_1 - subject.x_0).median()),
        "converged": int(sum(solution.converged.sum() for solution in found)),
        "stiff": int(sum(solution.stiff.sum() for solution in found)),
    }  # fmt: skip
    if subject.encoding is not None:
        _, metres, dropped = metres_apart(*(subject.encoding.decode(x.float()) for x in (x_1, subject.x_1)))
        row |= {"range_rms_m": float(metres.nanmedian()), "drop_differs": float(dropped.median())}
    return row


def reached(row: Row) -> float:
    """The error of a row: not below what can be measured.

    Infinite where a scan was not solved, and where x_0 itself is no farther from the end.
    """
    if row["converged"] < row["scans"] or not row["error"] < row["length"]:
        return math.inf
    return float(max(row["error"], row["floor"]))


def best_within(rows: Sequence[Row], budget: float, work: str = "evaluations") -> Row | None:
    """The row of least error whose work is within a budget; of equals, the one of least work."""
    within = [row for row in rows if row[work] <= budget and math.isfinite(reached(row))]
    return min(within, key=lambda row: (reached(row), row[work]), default=None)


def cheapest(rows: Sequence[Row], metres: float) -> Row | None:
    """The row of fewest evaluations whose range is within so many metres (RMS, the median over scans)."""
    near = [row for row in rows if math.isfinite(reached(row)) and row["range_rms_m"] <= metres]
    return min(near, key=lambda row: (row["evaluations"], reached(row)), default=None)


def judge(
    problems: Sequence[str],
    methods: Sequence[str],
    tolerances: Sequence[float] = (1e-3, 1e-5),
    scans: int = 8,
    elements: int = 64,
    max_evaluations: int = 5000,
    progress: Progress = None,
) -> list[dict[str, Any]]:
    """Whether adaptive solvers admit their failures: every problem, precision, solver and tolerance, a row each.

    Returns:
        `error` is the root mean square over the elements of the worst scan, `estimate` that scan's global estimate
        (None: none), `verdict` one of accurate, flagged, owned up and silent.
    """
    start, rows = Draws(0, range(scans)).start((elements,)), []
    adaptive = [method for method in methods if method in SOLVERS and SOLVERS[method].adapts]
    for name, precision, method, tolerance in product(problems, PRECISIONS, adaptive, tolerances):
        problem, (state, network) = PROBLEMS[name](), PRECISIONS[precision]
        x_0 = start.to(state)
        solver = Configuration(method, tolerance=tolerance)
        solution = solver.solve(_rounded(problem, network), x_0, global_error=True, max_evaluations=max_evaluations)
        assert solution.global_error is not None
        assert solution.estimate_evaluations is not None
        difference = (solution.x.double() - problem.solution(x_0, 1.0).double()).flatten(1)
        largest = difference.abs().amax(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
        errors = largest[:, 0] * rms(difference / largest)  # squares of stiff problems' errors overflow
        worst = int(errors.argmax())
        estimate = solution.global_error[worst].item()
        rows.append({
            "problem": name, "precision": precision, "solver": method, "tolerance": tolerance,
            "error": errors[worst].item(), "estimate": estimate if math.isfinite(estimate) else None,
            "evaluations": (solution.evaluations - solution.estimate_evaluations).double().mean().item(),
            "stiff": solution.stiff.double().mean().item(), "converged": solution.converged.double().mean().item(),
            "verdict": _verdict(solution, errors, tolerance),
        })  # fmt: skip
        if progress is not None:
            progress()
    return rows


def _rounded(velocity: Velocity, dtype: torch.dtype | None) -> Velocity:
    """A velocity as a network in half precision gives it: x rounded before it, v after it; t stays in float32."""
    if dtype is None:
        return velocity
    return lambda t, x: velocity(t, x.to(dtype).to(x.dtype)).to(dtype)


def _verdict(solution: Solution, errors: Tensor, tolerance: float) -> str:
    estimate = solution.global_error
    assert estimate is not None
    failed = errors > FAILS_AT * tolerance
    flagged = solution.stiff | ~solution.converged | ~estimate.isfinite()
    honest = (estimate >= errors / HONEST_WITHIN) & (estimate <= errors * HONEST_WITHIN)
    if not failed.any():
        return "accurate"
    if (failed & ~flagged & ~honest).any():
        return "silent"
    return "flagged" if (failed & flagged).any() else "owned up"


def solvers_page(
    rows: Sequence[Row],
    verdicts: Sequence[Row],
    subject: Subject | None,
    budgets: Sequence[int],
    seeds: Mapping[str, int],
    command: str,
    device: str = "cpu",
) -> Page:
    """The report.

    Args:
        rows: From `measure`.
        verdicts: From `judge`.
        subject: The trained flow among the subjects.
        budgets: Evaluations within which the most accurate solver is named.
    """
    text: list[str] = []
    figures: dict[str, Figure] = {}
    exact = [row for row in rows if subject is None or row["problem"] != subject.name]
    if subject is not None:
        own = [row for row in rows if row["problem"] == subject.name]
        text += flow_text(own, subject, budgets)
        figures["solvers"] = error_figure(own, PANELS)
    if exact:
        scans = exact[0]["scans"]
        text += [
            "## Exact problems",
            f"{scans} scans each, in float64: the most accurate solver within a number of evaluations and its median "
            "RMS error; none where x_0 is as near.",
            problems_table(exact, budgets),
        ]
        figures["solvers_problems"] = problems_figure(exact)
    if verdicts:
        text += ["## Failures of adaptive solvers", verdicts_text(verdicts), table(verdicts, VERDICTS)]
        figures["solvers_estimates"] = estimates_figure(verdicts)
    text += ["## All configurations", table(rows, COLUMNS)]
    more = {"verdicts": verdicts}
    return Page("solvers", "Solvers: error against run time", text, rows, figures, command, seeds, device, more)


COLUMNS = {
    "problem": "problem", "label": "solver", "evaluations": "evaluations", "seconds": "s a scan", "error": "RMS error",
    "error_worst": "worst scan", "range_rms_m": "range, RMS m", "drop_differs": "ray-drop differs",
    "converged": "solved", "stiff": "stiff",
}  # fmt: skip
VERDICTS = {key: key for key in ("problem", "precision", "solver", "tolerance", "error", "estimate", "verdict")}


def flow_text(rows: Sequence[Row], subject: Subject, budgets: Sequence[int]) -> list[str]:
    """Which solver for which budget and which error on a trained flow."""
    best = [best_within(rows, budget) or {"label": "none"} for budget in sorted(budgets)]
    by_budget = [{"budget": budget, **row} for budget, row in zip(sorted(budgets), best, strict=True)]
    by_error: list[tuple[Any, ...]] = []
    for metres in WANTED:
        row = cheapest(rows, metres)
        how = ("none", None, None) if row is None else (
            f"`r2flow sample {subject.name} {row['options']}`", row["evaluations"], row["seconds"]
        )  # fmt: skip
        by_error.append((f"{metres:g} m", *how))
    return [
        f"**{subject.name}**, {len(subject.x_0)} scans, against its own tight solution. Errors above "
        f"{shown(subject.floor)} can be measured.",
        "The sampler of fewest evaluations that reaches an RMS error of the range:",
        table(by_error, ("error", "sampler", "evaluations", "s a scan")),
        "The most accurate solver within a number of evaluations:",
        table(
            by_budget, {"budget": "evaluations", "label": "solver", "error": "RMS error", "range_rms_m": "range, RMS m"}
        ),
    ]


def problems_table(rows: Sequence[Row], budgets: Sequence[int]) -> str:
    """The most accurate solver of every exact problem within every budget."""
    lines = []
    for name, own in _by(rows, "problem").items():
        best = [best_within(own, budget) for budget in sorted(budgets)]
        lines.append([name, *("none" if one is None else f"{one['method']} {shown(reached(one))}" for one in best)])
    return table(lines, ["problem", *(f"within {budget}" for budget in sorted(budgets))])


def verdicts_text(rows: Sequence[Row]) -> str:
    """How many cells fail, and how many of these do so silently, the jet apart."""
    failed = [row for row in rows if row["verdict"] != "accurate"]
    silent = [row for row in failed if row["verdict"] == "silent"]
    jets = sum(row["problem"] == JET for row in silent)
    names = "; ".join(
        f"{row['problem']} / {row['precision']} / {row['solver']}" for row in silent if row["problem"] != JET
    )
    return (
        f"{len(failed)} of {len(rows)} cells have an error of more than {FAILS_AT:g} times the tolerance in the worst "
        f"scan; {len(silent) - jets} of these are silent: neither flagged, nor with a global estimate within a factor "
        f"of {HONEST_WITHIN:g} of the error{f' ({names})' if names else ''}. The narrow jet is the known exception: "
        f"{jets} of its cells are silent."
    )


PANELS = (
    ("evaluations", "evaluations a scan", "error", "RMS error, model space"),
    ("seconds", "seconds a scan", "error", "RMS error, model space"),
    ("evaluations", "evaluations a scan", "range_rms_m", "RMS range error, m"),
    ("evaluations", "evaluations a scan", "drop_differs", "share of rays that differ in ray-drop"),
)


def error_figure(rows: Sequence[Row], panels: Sequence[tuple[str, str, str, str]]) -> Figure:
    """Error of a flow's solutions against evaluations and time."""
    figure = blank_figure(10.5, 8.2)
    for place, (x, x_label, y, y_label) in enumerate(panels):
        axes = figure.add_subplot(2, 2, place + 1)
        _draw(axes, rows, x, y)
        axes.set(xlabel=x_label, ylabel=y_label)
        if y == "error" and math.isfinite(rows[0]["floor"]):
            axes.axhline(rows[0]["floor"], color="0.6", ls=":", lw=1)
    _legend(figure, rows)
    return figure


def problems_figure(rows: Sequence[Row]) -> Figure:
    """Error on every exact problem against evaluations."""
    problems = _by(rows, "problem")
    columns = min(4, len(problems))
    lines = math.ceil(len(problems) / columns)
    figure = blank_figure(3.2 * columns + 0.4, 2.7 * lines + 0.9)
    for place, (name, own) in enumerate(problems.items()):
        axes = figure.add_subplot(lines, columns, place + 1)
        _draw(axes, own, "evaluations", "error")
        axes.set_title(name.replace("_", " "), fontsize=9)
        axes.set(ylabel="RMS error" if place % columns == 0 else "")
    _legend(figure, rows)
    return figure


def _draw(axes: Any, rows: Sequence[Row], x: str, y: str) -> None:
    """A line for each method through the rows that solve the problem."""
    for method, own in _by([row for row in rows if math.isfinite(reached(row))], "method").items():
        points = sorted((row[x], max(row[y], ROUNDING / 10)) for row in own if math.isfinite(row[y]))
        if points:
            axes.plot(*np.array(points).T, **_style(method), ms=4.5, lw=1.1)
    axes.set(xscale="log", yscale="log")
    axes.grid(True, which="major", color="0.88", lw=0.6)
    axes.tick_params(labelsize=8)


def _legend(figure: Figure, rows: Sequence[Row]) -> None:
    handles = [Line2D([], [], **_style(method), ms=5, lw=1.1, label=method) for method in _by(rows, "method")]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)


def _style(method: str) -> dict[str, Any]:
    return STYLES[METHODS.index(method) % len(STYLES)] if method in METHODS else STYLES[-1]


def estimates_figure(rows: Sequence[Row]) -> Figure:
    """Global estimate against true error, a marker for each verdict; grey within a factor of five."""
    figure = blank_figure(6, 5)
    axes, ends = figure.subplots(), np.array([1e-9, 1e2])
    axes.plot(ends, ends, color="black", lw=0.8)
    axes.fill_between(ends, ends / HONEST_WITHIN, ends * HONEST_WITHIN, color="0.9")
    for style, (verdict, own) in zip(STYLES, _by(rows, "verdict").items(), strict=False):
        known = [row for row in own if row["estimate"] is not None]
        x, y = ([max(row[key], ends[0]) for row in known] for key in ("error", "estimate"))
        axes.scatter(x, y, s=24, marker=style["marker"], color=style["color"], label=f"{verdict} ({len(own)})")
    axes.set(xscale="log", yscale="log", xlabel="true error", ylabel="global estimate")
    axes.legend(fontsize=8)
    return figure


def _by(rows: Sequence[Row], key: str) -> dict[str, list[Row]]:
    """The rows of each value of a key."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return groups
