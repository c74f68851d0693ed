"""Error against run time of every solver, on exact problems (smooth, stiff, extreme) and on a
trained flow.
"""

import logging
import math
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, product
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.base.plugins import loaded_plugins
from r2flow.base.progress import Bar
from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import (
    SOLVERS,
    TORCHDIFFEQ,
    Solution,
    Velocity,
    default_grid,
    method_of,
    solve,
)
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.lidar.encoding import Encoding
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.inversion import metres_apart, rms
from r2flow.reports.backbones import timed
from r2flow.reports.figures import Plot, lines_figure
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table, shown

USUAL = ("euler", "midpoint", "adams3", "dopri5")  # measured first
_METHODS = (*dict.fromkeys((*USUAL, "exprb43", *SOLVERS)), f"{TORCHDIFFEQ}dopri5")
_TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)  # of adaptive methods
_REPEATS = 5  # maximum timed solutions per scan
_PATIENCE = 0.5  # seconds after which timing stops
_REFERENCE = 800  # evaluations of a reference solution, about
_COARSE = {"steps": 32, "tolerance": 1e-5}  # a reference where there is no time for another
_ROUNDING = 1e-9  # smallest error distinguishable from rounding in float64
_COLUMNS = {
    "problem": "problem",
    "label": "solver",
    "evaluations": "evaluations",
    "seconds": "s a scan",
    "error": "RMS error",
    "error_worst": "worst scan",
    "range_rms_m": "range, RMS m",
    "drop_differs": "ray-drop differs",
    "converged": "solved",
    "stiff": "stiff",
}


def report_solvers(
    model: str | None = None,
    samplers: Sequence[str] | None = None,
    budgets: Sequence[int] = (4, 8, 16, 32, 64),
    problems: Sequence[str] = tuple(PROBLEMS),
    num: int = 4,
    seed: int = 0,
    batch_size: int = 1,
    seconds: float = math.inf,
    device: str = "cpu",
) -> Page:
    """The page of solvers on test problems with exact solutions and on `num` scans of a trained
    flow.

    With `seconds`, as few scans and other than the usual solvers as take about this time.

    Args:
        samplers: Solvers; default: all built-in, without which `seconds` bound nothing.
        budgets: Evaluations of fixed-step solvers.
    """
    methods = configurations(samplers or _METHODS, budgets)
    subjects = problem_subjects(problems)
    if not methods or not (problems or model):
        raise InputError(
            "nothing to measure: give a model or more --budgets, or no --problems none."
        )
    logging.getLogger("r2flow.flow").setLevel(logging.ERROR)  # the report counts failed scans
    seconds = math.inf if samplers else seconds
    until = time.monotonic() + seconds
    flow = None
    if model is not None:
        checkpoint = load_checkpoint(model, device)
        affordable = _affordable(checkpoint, num, seconds / 2)
        how: Row = {"steps": 128, "tolerance": 1e-7} if affordable else _COARSE
        num = max(affordable, 1)
        with Bar("measuring", num * how["steps"] * 4, "reference evaluations") as advance:
            how = {"progress": advance, **how}
            flow = checkpoint_subject(checkpoint, model, num, seed, batch_size, **how)
        subjects.insert(0, flow)
    with Bar("measuring", len(subjects) * len(methods), "solutions") as advance:
        rows = measure(subjects, methods, advance, until)
    return solvers_page(rows, flow, budgets, {"scans": seed}, device)


def configurations(
    methods: Sequence[str], budgets: Sequence[int], tolerances: Sequence[float] = _TOLERANCES
) -> dict[str, Row]:
    """Options of `solve` by label.

    All fixed-step methods at numbers of steps that fit the budgets, all adaptive methods at the
    tolerances.
    """
    found: dict[str, Row] = {}
    for method in methods:
        how = method_of(method)
        if how.adapts:
            for tolerance in tolerances:
                found[f"{method}, {tolerance:.0e}"] = {"method": method, "tolerance": tolerance}
            continue
        start = getattr(how, "start", 0)
        per_step = getattr(how, "evaluations", 1)
        for steps in sorted({(budget - start) // per_step for budget in budgets}):
            if steps > 0:
                label = f"{method}, {steps} step{'s' if steps > 1 else ''}"
                found[label] = {"method": method, "steps": steps, "grid": default_grid(method)}
    return found


@dataclass(frozen=True)
class Subject:
    """A velocity with known ends."""

    name: str
    velocity: Velocity
    x_0: Tensor  # starts of the scans, (N, ...), on the velocity's device
    x_1: Tensor  # their ends, float64
    batch_size: int
    floor: float = _ROUNDING  # smallest RMS error that can be measured against `x_1`
    encoding: Encoding | None = None  # of a trained flow; None for exact problems


def problem_subjects(names: Sequence[str], scans: int = 16, elements: int = 64) -> list[Subject]:
    """Exact problems of `r2flow.flow.problems` on Gaussian starts, in float64."""
    x_0 = Draws(0, range(scans)).start((elements,)).double()
    subjects = []
    for name in names:
        problem = PROBLEMS[name]()
        subjects.append(Subject(name, problem, x_0, problem.solution(x_0, 1.0), scans))
    return subjects


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

    `floor` is three times the largest distance to dopri5 at a tight tolerance, inf if either did
    not converge.
    """
    flow = as_flow(checkpoint.generator, "report solvers")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    ends = []
    floor = 0.0
    with torch.inference_mode():
        for scan in x_0.double().split(1):
            rk4 = solve(flow.velocity, scan, method="rk4", steps=steps, progress=progress)
            dopri5 = solve(flow.velocity, scan, method="dopri5", tolerance=tolerance)
            ends.append(rk4.x)
            solved = (rk4.converged & dopri5.converged).all()
            floor = max(floor, 3 * rms(rk4.x - dopri5.x).item() if solved else math.inf)
    x_1 = torch.cat(ends)
    return Subject(name, flow.velocity, x_0, x_1, batch_size, floor, checkpoint.encoding)


@torch.inference_mode()
def measure(
    subjects: Sequence[Subject],
    methods: Mapping[str, Row],
    progress: Progress = None,
    until: float = math.inf,
) -> list[Row]:
    """Measure error, evaluations and seconds of each configuration on each subject, one row each.

    Configurations come in order on all subjects, and then again: other load on the machine affects
    all alike. Errors are those of the first repetition. After the time `until` (of
    `time.monotonic`) only the `USUAL` methods are begun; what was not measured has no row.
    """
    seconds: dict[tuple[str, str], list[float]] = {}
    solutions: dict[tuple[str, str], list[Solution]] = {}
    for subject in subjects:
        subject.velocity(subject.x_0.new_zeros(()), subject.x_0[:1])  # warm up
    for _, (label, options), subject in product(range(_REPEATS), methods.items(), subjects):
        taken = seconds.setdefault((subject.name, label), [])
        late = time.monotonic() > until and (taken or options["method"] not in USUAL)
        if late or sum(taken) >= _PATIENCE:
            continue
        solved = list(_timed_solutions(subject, options))
        taken += [seconds_a_scan for _, seconds_a_scan in solved]
        if (subject.name, label) not in solutions:
            solutions[subject.name, label] = [solution for solution, _ in solved]
            if progress is not None:
                progress()
    rows = []
    for subject, (label, options) in product(subjects, methods.items()):
        if found := solutions.get((subject.name, label)):
            row = {"problem": subject.name, "label": label, **_row(subject, options, found)}
            rows.append(row | {"seconds": float(np.median(seconds[subject.name, label]))})
    return rows


def _affordable(checkpoint: Checkpoint, num: int, seconds: float) -> int:
    """Number of scans, up to `num`, whose reference solutions take about these seconds."""
    flow = as_flow(checkpoint.generator, "report solvers")
    x = Draws(0, [0]).start(flow.noise_shape).to(flow.device)
    evaluate = partial(flow.velocity, x.new_zeros(()), x)
    with torch.inference_mode():
        evaluate()  # warm up
        _, one = timed(evaluate, flow.device)
    return int(min(num, seconds / (one * _REFERENCE)))


def _timed_solutions(subject: Subject, options: Row) -> Iterator[tuple[Solution, float]]:
    """Solutions of the batches of a subject, with seconds per scan."""
    how = {"max_evaluations": 1000, **options}
    for x_0 in subject.x_0.split(subject.batch_size):
        solution, taken = timed(partial(solve, subject.velocity, x_0, **how), x_0.device)
        yield solution, taken / len(x_0)


def _row(subject: Subject, options: Row, solutions: Sequence[Solution]) -> Row:
    """Errors, cost and options of a configuration."""
    x_1 = torch.cat([solution.x for solution in solutions])
    evaluations = torch.cat([solution.evaluations for solution in solutions])
    errors = rms(x_1 - subject.x_1).cpu()
    row = {
        "method": options["method"],
        "options": _as_options(options),
        "scans": len(errors),
        "evaluations": float(evaluations.double().mean()),
        "error": float(np.median(errors)),
        "error_worst": float(errors.max()),
        "floor": subject.floor,
        "length": float(rms(subject.x_1 - subject.x_0).quantile(0.5)),
        "converged": int(sum(solution.converged.sum() for solution in solutions)),
        "stiff": int(sum(solution.stiff.sum() for solution in solutions)),
    }
    if subject.encoding is not None:
        found = subject.encoding.decode(x_1.float())
        expected = subject.encoding.decode(subject.x_1.float())
        _, metres, dropped = metres_apart(found, expected)
        row["range_rms_m"] = float(metres.nanquantile(0.5))
        row["drop_differs"] = float(dropped.quantile(0.5))
    return row


def _as_options(options: Row) -> str:
    """Options of `solve` as those of `r2flow sample`."""
    sampler = options["method"].replace(TORCHDIFFEQ, f"{TORCHDIFFEQ}method=")
    if "steps" in options and sampler in SOLVERS:
        sampler += ":finish=0"  # the model's own sampler may have one
    others = [f"--{key} {value}" for key, value in options.items() if key != "method"]
    return " ".join([f"--sampler {sampler}", *others])


def _reached(row: Row) -> float:
    """Error of a row, at least `floor`; infinite if a scan was not solved or x_0 has a smaller
    error.
    """
    if row["converged"] < row["scans"] or not row["error"] < row["length"]:
        return math.inf
    return float(max(row["error"], row["floor"]))


def best_within(rows: Sequence[Row], budget: float) -> Row | None:
    """Row of smallest error within a number of evaluations; ties: fewest evaluations."""
    within = [row for row in rows if row["evaluations"] <= budget and math.isfinite(_reached(row))]
    return min(within, key=lambda row: (_reached(row), row["evaluations"]), default=None)


def cheapest(rows: Sequence[Row], metres: float) -> Row | None:
    """Row of fewest evaluations with a range error within a limit in metres (RMS, median over
    scans).
    """
    within = [row for row in rows if math.isfinite(_reached(row)) and row["range_rms_m"] <= metres]
    return min(within, key=lambda row: (row["evaluations"], _reached(row)), default=None)


def solvers_page(
    rows: Sequence[Row],
    subject: Subject | None,
    budgets: Sequence[int],
    seeds: Mapping[str, int],
    device: str = "cpu",
) -> Page:
    """Build the report on the rows of `measure`; `subject` is the trained flow, if any."""
    text: list[Part] = []
    figures = {}
    groups = {name: list(group) for name, group in groupby(rows, itemgetter("problem"))}
    if subject is not None:
        flow = groups.pop(subject.name)
        text += _flow_text(flow, subject)
        plots = [
            _plot(subject.name, flow, x, y)
            for x in ("evaluations", "seconds")
            for y in ("error", "range_rms_m")
        ]
        figures["solvers"] = lines_figure(plots, 2)
    if groups:
        lines = []
        scans = next(iter(groups.values()))[0]["scans"]
        for name, group in groups.items():
            best = [best_within(group, budget) for budget in budgets]
            cells = [f"{row['method']} {shown(_reached(row))}" if row else "none" for row in best]
            lines.append([name, *cells])
        text += [
            "## Exact problems",
            f"{scans} scans each, in float64: the most accurate solver within a number of "
            "evaluations and its median RMS error; none if x_0 has a smaller error.",
            Table(lines, ["problem", *(f"within {budget}" for budget in budgets)]),
        ]
        plots = [_plot(name, group, "evaluations", "error") for name, group in groups.items()]
        figures["solvers_problems"] = lines_figure(plots, 4)
    title = "Solvers: error against run time"
    every = [Table(rows, _COLUMNS, "All configurations")]
    return Page("solvers", title, text, rows, figures, seeds, device, details=every)


def _flow_text(rows: Sequence[Row], subject: Subject) -> list[Part]:
    """Recommended solvers per error on a trained flow."""
    plugins = [f"--plugin={name}" for name in loaded_plugins()]
    command = shlex.join(["r2flow", "sample", subject.name, *plugins])
    by_error = []
    for metres in (0.2, 0.05, 0.01):
        row = cheapest(rows, metres)
        how = f"`{command} {row['options']}`" if row else "none"
        by_error.append({**(row or {}), "how": how, "wanted": f"{metres:g} m"})
    cost = {"evaluations": "evaluations", "seconds": "s a scan"}
    return [
        f"**{subject.name}**, {len(subject.x_0)} scans, against its reference solution. Errors "
        "above "
        f"{shown(subject.floor)} can be measured.",
        "Sampler with the fewest evaluations for an RMS error of the range:",
        Table(by_error, {"wanted": "error", "how": "sampler", **cost}),
    ]


def _plot(title: str, rows: Sequence[Row], x: str, y: str) -> Plot:
    """A line per method through the rows that solve the problem."""
    lines = {}
    for method, group in groupby(rows, itemgetter("method")):
        solved = [row for row in group if math.isfinite(_reached(row)) and math.isfinite(row[y])]
        solved.sort(key=itemgetter(x))
        if solved:
            errors = [max(row[y], _ROUNDING / 10) for row in solved]
            lines[method] = [row[x] for row in solved], errors
    return Plot(f"{x} a scan", _COLUMNS[y], lines, title, log_x=True)
