"""Error against run time of every solver, on exact problems (smooth, stiff, extreme) and on a trained flow."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, product
from operator import itemgetter
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
from r2flow.plugins import loaded_plugins
from r2flow.reports.backbones import timed
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import Row, shown, table

METHODS = (*SOLVERS, f"{TORCHDIFFEQ}dopri5")
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)  # of adaptive methods
REPEATS, PATIENCE = 5, 0.5  # maximum timed solutions per scan; seconds after which timing stops
ROUNDING = 1e-9  # smallest error distinguishable from rounding in float64


def configurations(
    methods: Sequence[str], budgets: Sequence[int], tolerances: Sequence[float] = TOLERANCES
) -> dict[str, dict[str, Any]]:
    """Options of `solve` by label.

    All fixed-step methods at numbers of steps that fit the budgets, all adaptive methods at the tolerances.
    """
    chosen: dict[str, dict[str, Any]] = {}
    for method in methods:
        how = method_of(method)
        if how.adapts:
            chosen |= {f"{method}, {tol:.0e}": {"method": method, "tolerance": tol} for tol in tolerances}
            continue
        start, per_step = getattr(how, "start", 0), getattr(how, "evaluations", 1)
        for count in sorted({(budget - start) // per_step for budget in budgets if budget >= start + per_step}):
            label = f"{method}, {count} step{'s' * (count > 1)}"
            chosen[label] = {"method": method, "steps": count, "grid": usual_grid(method)}
    return chosen


@dataclass(frozen=True)
class Subject:
    """A velocity with known ends."""

    name: str
    velocity: Velocity
    x_0: Tensor  # starts of the scans, (N, ...), on the velocity's device
    x_1: Tensor  # their ends, float64
    batch_size: int
    floor: float = ROUNDING  # smallest RMS error that can be measured against `x_1`
    encoding: Encoding | None = None  # of a trained flow; None for exact problems


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

    `floor` is three times the largest distance to dopri5 at a tight tolerance, inf if either did not converge.
    """
    flow = as_flow(checkpoint.generator, "report solvers")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    ends, apart = [], []
    with torch.inference_mode():
        for scan in x_0.double().split(1):
            rk4 = solve(flow.velocity, scan, method="rk4", steps=steps, progress=progress)
            dopri5 = solve(flow.velocity, scan, method="dopri5", tolerance=tolerance)
            ends.append(rk4.x)
            apart.append(rms(rk4.x - dopri5.x).item() if (rk4.converged & dopri5.converged).all() else math.inf)
    return Subject(name, flow.velocity, x_0, torch.cat(ends), batch_size, 3 * max(apart), checkpoint.encoding)


def measure(
    subjects: Sequence[Subject], chosen: Mapping[str, dict[str, Any]], progress: Progress = None
) -> list[dict[str, Any]]:
    """Measure error, evaluations and seconds of each configuration on each subject, one row each.

    Repetitions are interleaved, so that other load on the machine affects all configurations alike; errors are those of
    the first repetition.
    """
    rows = []
    for subject in subjects:
        seconds: dict[str, list[float]] = {label: [] for label in chosen}
        solutions: dict[str, list[Solution]] = {label: [] for label in chosen}
        with torch.inference_mode():
            subject.velocity(torch.zeros((), device=subject.x_0.device), subject.x_0[:1])  # warm up
            for repeat, (label, options) in product(range(REPEATS), chosen.items()):
                if repeat > 0 and sum(seconds[label]) >= PATIENCE:
                    continue
                how = {"max_evaluations": 1000, **options}
                for x_0 in subject.x_0.split(subject.batch_size):
                    solution, taken = timed(partial(solve, subject.velocity, x_0, **how), x_0.device)
                    seconds[label].append(taken / len(x_0))
                    solutions[label] += [] if repeat else [solution]
                if progress is not None and repeat == 0:
                    progress()
        rows += [_row(subject, label, options, seconds[label], solutions[label]) for label, options in chosen.items()]
    return rows


def _row(
    subject: Subject, label: str, options: Mapping[str, Any], seconds: list[float], solutions: Sequence[Solution]
) -> dict[str, Any]:
    x_1 = torch.cat([solution.x for solution in solutions])
    errors = rms(x_1 - subject.x_1).cpu()  # torch's median of an even number is the lower of two
    method = options["method"]
    plain = ":finish=0" if "steps" in options and method in SOLVERS else ""  # the model's own sampler may have one
    words = {"sampler": method.replace(TORCHDIFFEQ, f"{TORCHDIFFEQ}method=") + plain, **options}
    row = {
        "problem": subject.name, "method": method, "label": label,
        "options": " ".join(f"--{key} {value}" for key, value in words.items() if key != "method"),
        "scans": len(errors),
        "evaluations": float(torch.cat([solution.evaluations for solution in solutions]).double().mean()),
        "seconds": float(np.median(seconds)), "error": float(np.median(errors)), "error_worst": float(errors.max()),
        "floor": subject.floor, "length": float(rms(subject.x_1 - subject.x_0).quantile(0.5)),
        "converged": int(sum(solution.converged.sum() for solution in solutions)),
        "stiff": int(sum(solution.stiff.sum() for solution in solutions)),
    }  # fmt: skip
    if subject.encoding is not None:
        _, metres, dropped = metres_apart(*(subject.encoding.decode(x.float()) for x in (x_1, subject.x_1)))
        row |= {"range_rms_m": float(metres.nanquantile(0.5)), "drop_differs": float(dropped.quantile(0.5))}
    return row


def reached(row: Row) -> float:
    """Error of a row, at least `floor`; infinite if a scan was not solved or x_0 has a smaller error."""
    if row["converged"] < row["scans"] or not row["error"] < row["length"]:
        return math.inf
    return float(max(row["error"], row["floor"]))


def best_within(rows: Sequence[Row], budget: float) -> Row | None:
    """Row of smallest error within a number of evaluations; ties: fewest evaluations."""
    within = [row for row in rows if row["evaluations"] <= budget and math.isfinite(reached(row))]
    return min(within, key=lambda row: (reached(row), row["evaluations"]), default=None)


def cheapest(rows: Sequence[Row], metres: float) -> Row | None:
    """Row of fewest evaluations with a range error within a limit in metres (RMS, median over scans)."""
    within = [row for row in rows if math.isfinite(reached(row)) and row["range_rms_m"] <= metres]
    return min(within, key=lambda row: (row["evaluations"], reached(row)), default=None)


COLUMNS = {
    "problem": "problem", "label": "solver", "evaluations": "evaluations", "seconds": "s a scan", "error": "RMS error",
    "error_worst": "worst scan", "range_rms_m": "range, RMS m", "drop_differs": "ray-drop differs",
    "converged": "solved", "stiff": "stiff",
}  # fmt: skip


def solvers_page(
    rows: Sequence[Row],
    subject: Subject | None,
    budgets: Sequence[int],
    seeds: Mapping[str, int],
    device: str = "cpu",
) -> Page:
    """Build the report on the rows of `measure`; `subject` is the trained flow, if any."""
    text: list[str] = []
    figures: dict[str, Figure] = {}
    groups = {name: list(group) for name, group in groupby(rows, itemgetter("problem"))}
    if subject is not None:
        flow = groups.pop(subject.name)
        text += flow_text(flow, subject, budgets)
        axes = product(("evaluations", "seconds"), ("error", "range_rms_m"))
        figures["solvers"] = _figure([(subject.name, flow, x, y) for x, y in axes], 2)
    if groups:
        lines = []
        for name, group in groups.items():
            best = [best_within(group, budget) for budget in sorted(budgets)]
            lines.append([name, *("none" if row is None else f"{row['method']} {shown(reached(row))}" for row in best)])
        text += [
            "## Exact problems",
            f"{rows[0]['scans']} scans each, in float64: the most accurate solver within a number of evaluations and "
            "its median RMS error; none if x_0 has a smaller error.",
            table(lines, ["problem", *(f"within {budget}" for budget in sorted(budgets))]),
        ]
        panels = [(name, group, "evaluations", "error") for name, group in groups.items()]
        figures["solvers_problems"] = _figure(panels, 4)
    text += ["## All configurations", table(rows, COLUMNS)]
    return Page("solvers", "Solvers: error against run time", text, rows, figures, seeds, device)


def flow_text(rows: Sequence[Row], subject: Subject, budgets: Sequence[int]) -> list[str]:
    """Recommended solvers per budget and error on a trained flow."""
    by_budget = [{"budget": budget, **(best_within(rows, budget) or {"label": "none"})} for budget in sorted(budgets)]
    command = shlex.join(["r2flow", "sample", subject.name, *(f"--plugin={name}" for name in loaded_plugins())])
    by_error = []
    for metres in (0.2, 0.05, 0.01):
        row = cheapest(rows, metres) or {}
        by_error.append({**row, "how": f"`{command} {row['options']}`" if row else "none", "wanted": f"{metres:g} m"})
    errors = {"error": "RMS error", "range_rms_m": "range, RMS m"}
    return [
        f"**{subject.name}**, {len(subject.x_0)} scans, against its reference solution. Errors above "
        f"{shown(subject.floor)} can be measured.",
        "Sampler with the fewest evaluations for an RMS error of the range:",
        table(by_error, {"wanted": "error", "how": "sampler", "evaluations": "evaluations", "seconds": "s a scan"}),
        "Most accurate solver within a number of evaluations:",
        table(by_budget, {"budget": "evaluations", "label": "solver", **errors}),
    ]


LABELS = {
    "evaluations": "evaluations a scan", "seconds": "seconds a scan", "error": "RMS error, model space",
    "range_rms_m": "RMS range error, m",
}  # fmt: skip


def _figure(panels: Sequence[tuple[str, Sequence[Row], str, str]], columns: int) -> Figure:
    """Plot a panel per (title, rows, x, y), with a line per method through the rows that solve the problem."""
    columns = min(columns, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = blank_figure(3.6 * columns + 0.4, 3.0 * lines + 0.9)
    methods: dict[str, dict[str, Any]] = {}
    for place, (title, rows, x, y) in enumerate(panels, 1):
        axes = figure.add_subplot(lines, columns, place)
        for method, group in groupby(rows, itemgetter("method")):
            methods[method] = STYLES[METHODS.index(method) % len(STYLES)] if method in METHODS else STYLES[-1]
            solved = [row for row in group if math.isfinite(reached(row)) and math.isfinite(row[y])]
            if points := sorted((row[x], max(row[y], ROUNDING / 10)) for row in solved):
                axes.plot(*np.array(points).T, **methods[method], ms=4.5, lw=1.1)
        axes.set(xscale="log", yscale="log", xlabel=LABELS[x], ylabel=LABELS[y])
        axes.set_title(title.replace("_", " "), fontsize=9)
        axes.grid(True, which="major", color="0.88", lw=0.6)
        axes.tick_params(which="both", labelsize=8)
    handles = [Line2D([], [], **style, ms=5, lw=1.1, label=method) for method, style in methods.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure
