"""Error against work: which solver gives what accuracy for how many evaluations and how much time (measurement)."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import SOLVERS, TORCHDIFFEQ, Solution, adapts, check_method, fixed_step
from r2flow.generators import Field, Flow, Sampler
from r2flow.inversion import metres_apart, rms
from r2flow.lidar.encoding import Encoding
from r2flow.noise import Draws
from r2flow.reports import timing

METHODS = (*SOLVERS, f"{TORCHDIFFEQ}dopri5")
MOST_EVALUATIONS = 1000  # of an adaptive method for a scan; one that needs more is of no use here
PATIENCE = 0.5  # seconds after which a configuration is not timed again
PROBLEM_SEED = 0
METRES = ("range_median_m", "range_rms_m", "drop_differs")
TRUST = 3.0  # an error can be measured when it is this many times the reference's own


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

    def solve(self, flow: Flow, x_0: Tensor) -> Solution:
        """x_1 from x_0."""
        return flow.solve(x_0, sampler=self.sampler(flow), max_evaluations=MOST_EVALUATIONS)

    def sampler(self, flow: Flow) -> Sampler:
        """The solver on its usual grid; on that of the flow, where it is the flow's own solver."""
        return flow.sampler.changed(method=self.method, steps=self.steps, tolerance=self.tolerance)


@dataclass(frozen=True)
class Subject:
    """A flow with known ends.

    Attributes:
        x_0: Starts of the scans, (N, ...), on the flow's device.
        x_1: Their ends, (N, ...), float64.
        floor: The least root mean square error that can be measured against `x_1`; 0 where it is exact.
        encoding: None for a problem without metres.
    """

    name: str
    flow: Flow
    x_0: Tensor
    x_1: Tensor
    batch_size: int
    floor: float = 0.0
    encoding: Encoding | None = None


@dataclass(frozen=True)
class Reference:
    """The tight solution by rk4 that errors on a checkpoint are measured against.

    Attributes:
        x_1: (N, ...), float64.
        disagreement: Root mean square difference to dopri5 of every scan, (N,); inf where either did not converge.
        evaluations: Of both for a scan, the mean.
    """

    x_1: Tensor
    disagreement: np.ndarray
    evaluations: float
    steps: int
    tolerance: float

    @property
    def floor(self) -> float:
        """The least error that can be measured against it."""
        return TRUST * float(self.disagreement.max())


def configurations(
    methods: Sequence[str], budgets: Sequence[int], tolerances: Sequence[float] = ()
) -> list[Configuration]:
    """Every fixed-step method at the numbers of steps that fit the budgets, every adaptive one at the tolerances.

    Raises:
        InputError: an unknown method.
    """
    chosen: list[Configuration] = []
    for method in methods:
        check_method(method)
        if adapts(method):
            chosen += [Configuration(method, tolerance=tolerance) for tolerance in tolerances]
        else:
            ours = method.removeprefix(TORCHDIFFEQ)
            own = fixed_step(ours)
            start, per_step = (own.start, own.evaluations) if own else (0, 1)
            steps = sorted({(budget - start) // per_step for budget in budgets if budget >= start + per_step})
            chosen += [Configuration(method, steps=count) for count in steps]
    return chosen


def reference(
    flow: Flow, x_0: Tensor, steps: int, tolerance: float, progress: Callable[[], None] | None = None
) -> Reference:
    """x_1 by rk4 with many steps and, one scan at a time, its distance from dopri5 at a tight tolerance.

    The state is float64, so that the two differ by the network's rounding and their own error alone.
    """
    ends, apart, evaluations = [], [], []
    for scan in x_0.double().split(1):
        rk4 = flow.solve(scan, sampler=Sampler("rk4", steps), progress=progress)
        dopri5 = flow.solve(scan, sampler=Sampler("dopri5", tolerance=tolerance))
        ends.append(rk4.x)
        solved = bool(rk4.converged.all() and dopri5.converged.all())
        apart.append(rms(rk4.x - dopri5.x).item() if solved else math.inf)
        evaluations.append(int(rk4.evaluations.sum() + dopri5.evaluations.sum()))
    return Reference(torch.cat(ends), np.array(apart), float(np.mean(evaluations)), steps, tolerance)


def measure(
    subjects: Sequence[Subject],
    chosen: Sequence[Configuration],
    repeats: int = 9,
    progress: Callable[[], None] | None = None,
) -> list[dict[str, Any]]:
    """Error, evaluations and seconds of every configuration on every subject, a row each.

    The configurations take turns, so that whatever else the machine does slows all of them alike.

    Args:
        repeats: The most timed solutions of a scan; the error is that of the first. A configuration that has taken
            `PATIENCE` seconds is not timed again.
        progress: Called `runs(...)` times.
    """
    rows = []
    for subject in subjects:
        seconds: list[list[float]] = [[] for _ in chosen]  # for a scan
        spent = [0.0] * len(chosen)
        found: list[list[dict[str, Tensor]]] = [[] for _ in chosen]
        batches = list(zip(*(x.split(subject.batch_size) for x in (subject.x_0, subject.x_1)), strict=True))
        with torch.inference_mode():
            subject.flow.velocity(torch.zeros((), device=subject.x_0.device), subject.x_0[:1])  # what happens only once
            for repeat, (x_0, x_1), (i, one) in product(range(repeats), batches, list(enumerate(chosen))):
                if repeat == 0 or spent[i] < PATIENCE:
                    solution, taken = timed(one, subject.flow, x_0)
                    spent[i] += taken
                    seconds[i].append(taken / len(x_0))
                    if repeat == 0:
                        found[i].append(_judged(solution, x_1, subject.encoding))
                if progress is not None:
                    progress()
        own = [_row(subject, *of_one) for of_one in zip(chosen, seconds, found, strict=True)]
        for work in ("evaluations", "seconds"):
            front = pareto([row[work] for row in own], [reached(row) for row in own])
            for row, on_front in zip(own, front, strict=True):
                row[f"pareto_{work}"] = on_front
        rows += own
    return rows


def runs(subjects: Iterable[Subject], chosen: Sequence[Configuration], repeats: int) -> int:
    """How often `measure` calls its progress."""
    return sum(repeats * len(chosen) * math.ceil(len(s.x_0) / s.batch_size) for s in subjects)


def timed(configuration: Configuration, flow: Flow, x_0: Tensor) -> tuple[Solution, float]:
    """The solution and its seconds."""
    return timing.timed(partial(configuration.solve, flow, x_0), x_0.device)


def _judged(solution: Solution, x_1: Tensor, encoding: Encoding | None) -> dict[str, Tensor]:
    """What is known of each scan, (B,) by name."""
    known = {name: getattr(solution, name) for name in ("evaluations", "converged", "stiff")}
    known["error"] = rms(solution.x - x_1)
    if encoding is not None:
        apart = metres_apart(encoding.decode(solution.x), encoding.decode(x_1.to(solution.x)))
        known |= dict(zip(METRES, apart, strict=True))
    return known


def _row(
    subject: Subject, of: Configuration, seconds: Sequence[float], found: Sequence[Mapping[str, Tensor]]
) -> dict[str, Any]:
    scans = {name: torch.cat([batch[name] for batch in found]).cpu().numpy() for name in found[0]}
    error, evaluations = scans["error"], scans["evaluations"]
    row = {
        "problem": subject.name, **asdict(of), "grid": str(of.sampler(subject.flow).grid), "label": of.label,
        "scenes": len(error),
        "evaluations": float(np.mean(evaluations)), "evaluations_most": int(max(evaluations)),
        "seconds": float(np.median(seconds)), "timings": len(seconds),
        "seconds_quarter": float(np.quantile(seconds, 0.25)),
        "seconds_three_quarters": float(np.quantile(seconds, 0.75)),
        "error": float(np.median(error)), "error_p95": float(np.quantile(error, 0.95, method="higher")),
        "error_worst": float(error.max()), "floor": subject.floor,
        "length": float(rms(subject.x_1 - subject.x_0).median()),
        "judged": bool(np.median(error) > subject.floor),
        "converged": int(scans["converged"].sum()), "stiff": int(scans["stiff"].sum()),
    }  # fmt: skip
    for name in METRES:
        values = scans.get(name, np.empty(0))
        known = values[np.isfinite(values)]
        row[name] = float(np.median(known)) if len(known) else None
    return row


def reached(row: Mapping[str, Any]) -> float:
    """The error of a row: not below what can be measured.

    Infinite where a scan was not solved, and where x_0 itself is no farther from the end.
    """
    if row["converged"] < row["scenes"] or not row["error"] < row["length"]:
        return math.inf
    return float(max(row["error"], row["floor"]))


def pareto(work: Sequence[float], error: Sequence[float]) -> list[bool]:
    """Which points no other is better than in one coordinate and as good in the other. Infinite errors are excluded."""
    points = list(zip(work, error, strict=True))
    return [math.isfinite(e) and not any(v <= w and f <= e and (v < w or f < e) for v, f in points) for w, e in points]


def best_within(
    rows: Sequence[Mapping[str, Any]], budget: float, work: str = "evaluations"
) -> Mapping[str, Any] | None:
    """The row of least error whose work is within a budget; of equals, the one of least work."""
    within = [row for row in rows if row[work] <= budget and math.isfinite(reached(row))]
    return min(within, key=lambda row: (reached(row), row[work]), default=None)


def recommended(rows: Sequence[Mapping[str, Any]], metres: float = 0.05) -> Mapping[str, Any] | None:
    """The row of fewest evaluations whose range error is within so many metres; where none is, that of least error.

    Args:
        metres: Root mean square, the median over scans.
    """
    solved = [row for row in rows if math.isfinite(reached(row))]
    near = [row for row in solved if row["range_rms_m"] is not None and row["range_rms_m"] <= metres]
    if near:
        return min(near, key=lambda row: (row["evaluations"], reached(row)))
    return min(solved, key=lambda row: (reached(row), row["evaluations"]), default=None)


def problem_subjects(names: Sequence[str], scenes: int = 16, elements: int = 64) -> list[Subject]:
    """Exact problems of `r2flow.flow.problems` on Gaussian starts.

    Raises:
        InputError: an unknown name.
    """
    subjects = []
    for name in names:
        problem = PROBLEMS[name]()
        # float64: the solver's error, not rounding, is measured
        x_0 = Draws(PROBLEM_SEED, range(scenes)).start((elements,)).double()
        subjects.append(Subject(name, Field(problem, (elements,)), x_0, problem.solution(x_0, 1.0), scenes, floor=1e-9))
    return subjects
