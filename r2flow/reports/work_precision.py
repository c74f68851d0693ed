"""Error against work: which solver gives what accuracy for how many evaluations and how much time."""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import SOLVERS, TORCHDIFFEQ, Solution, adapts, check_method
from r2flow.generators import Field, Flow, Sampler, as_flow
from r2flow.lidar.encoding import Encoding
from r2flow.noise import Draws

NAME = "a work-precision report"
BUDGETS = (4, 8, 16, 32, 64)  # evaluations of the fixed-step methods
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)
METHODS = (*SOLVERS, f"{TORCHDIFFEQ}dopri5")
REFERENCE_STEPS, REFERENCE_TOLERANCE = 128, 1e-7
MOST_EVALUATIONS = 1000  # of an adaptive method on a scene: what has not arrived by then never does at such a price
PATIENCE = 0.5  # seconds after which a configuration is not timed again
PROBLEM_SEED = 0
TRUST = 3.0  # an error is told from the reference's own when it is so many times as large


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

    def solve(self, flow: Flow, x_0: Tensor, max_evaluations: int = MOST_EVALUATIONS) -> Solution:
        """x_1 from x_0."""
        sampler = Sampler(self.method).changed(steps=self.steps, tolerance=self.tolerance)
        return flow.solve(x_0, sampler=sampler, max_evaluations=max_evaluations)


@dataclass(frozen=True)
class Subject:
    """A flow whose end is known.

    Attributes:
        name: Of the problem, or the checkpoint as it was typed.
        flow: What is solved.
        x_0: Starts of the scenes, (N, ...), on the flow's device.
        x_1: Their ends, (N, ...), float64.
        batch_size: Scenes solved at once.
        floor: Below this root mean square error, `x_1` is not good enough to judge; 0 where it is exact.
        encoding: Between model space and metres; None for a problem that has none.
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
    """The tight solution that a checkpoint is judged against, and how far two methods agree on it.

    Attributes:
        x_1: By rk4, (N, ...), float64.
        disagreement: Root mean square difference to dopri5 of every scene, (N,); inf where either was lost.
        evaluations: What both took for a scene, the mean.
    """

    x_1: Tensor
    disagreement: np.ndarray
    evaluations: float
    steps: int
    tolerance: float

    @property
    def floor(self) -> float:
        """The least error that can be told from the reference's own."""
        return TRUST * float(self.disagreement.max())


def configurations(
    methods: Sequence[str] = METHODS,
    budgets: Sequence[int] = BUDGETS,
    tolerances: Sequence[float] = TOLERANCES,
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
            per_step = SOLVERS[ours].evaluations or 1 if ours in SOLVERS else 1
            steps = sorted({budget // per_step for budget in budgets if budget >= per_step})
            chosen += [Configuration(method, steps=count) for count in steps]
    return chosen


def reference(
    flow: Flow,
    x_0: Tensor,
    steps: int = REFERENCE_STEPS,
    tolerance: float = REFERENCE_TOLERANCE,
    progress: Callable[[], None] | None = None,
) -> Reference:
    """x_1 by rk4 with many steps and, one scene at a time, its distance from dopri5 at a tight tolerance.

    The state is kept in float64, so that two methods differ by the network's rounding and their own error alone.
    """
    ends, apart, evaluations = [], [], []
    for scene in x_0.double().split(1):
        rk4 = flow.solve(scene, sampler=Sampler("rk4", steps), progress=progress)
        dopri5 = flow.solve(scene, sampler=Sampler("dopri5", tolerance=tolerance))
        ends.append(rk4.x)
        arrived = bool(rk4.converged.all() and dopri5.converged.all())
        apart.append(rms(rk4.x - dopri5.x).item() if arrived else math.inf)
        evaluations.append(int(rk4.evaluations.sum() + dopri5.evaluations.sum()))
    return Reference(torch.cat(ends), np.array(apart), float(np.mean(evaluations)), steps, tolerance)


def checkpoint_subject(
    checkpoint: Checkpoint, name: str, found: Reference, num: int, seed: int, batch_size: int
) -> Subject:
    """A checkpoint on scenes 0 to num - 1 of a seed, against its reference."""
    return Subject(
        name,
        as_flow(checkpoint.generator, NAME),
        starts(checkpoint, num, seed),
        found.x_1,
        batch_size,
        found.floor,
        checkpoint.encoding,
    )


def starts(checkpoint: Checkpoint, num: int, seed: int) -> Tensor:
    """x_0 of scenes 0 to num - 1 of a seed, on the model's device."""
    generator = checkpoint.generator
    return Draws(seed, range(num)).start(generator.noise_shape).to(generator.device)


def rms(x: Tensor) -> Tensor:
    """Root mean square over each scene's elements, (B, ...) -> (B,), float64."""
    return x.double().square().flatten(1).mean(1).sqrt()


def measure(
    subjects: Sequence[Subject],
    chosen: Sequence[Configuration],
    repeats: int = 9,
    progress: Callable[[], None] | None = None,
) -> list[dict[str, Any]]:
    """Error, evaluations and seconds of every configuration on every subject, a row each.

    All configurations take turns, again and again: whatever else the machine does meanwhile falls on all of them.

    Args:
        repeats: The most timed solutions of a scene; the first one is also judged. Slow configurations rest after
            `PATIENCE` seconds, their times being steadier.
        progress: Called `runs(...)` times.
    """
    rows = []
    for subject in subjects:
        tallies = [_Tally() for _ in chosen]
        with torch.inference_mode():
            subject.flow.velocity(torch.zeros((), device=subject.x_0.device), subject.x_0[:1])  # what happens only once
            for repeat in range(repeats):
                _take_turns(subject, chosen, tallies, repeat == 0, progress)
        rows += _mark([tally.row(subject, of) for tally, of in zip(tallies, chosen, strict=True)])
    return rows


def _take_turns(
    subject: Subject,
    chosen: Sequence[Configuration],
    tallies: Sequence["_Tally"],
    judge: bool,
    progress: Callable[[], None] | None,
) -> None:
    """Every configuration on every batch of scenes; where they are not judged, slow ones rest."""
    for x_0, x_1 in zip(*(x.split(subject.batch_size) for x in (subject.x_0, subject.x_1)), strict=True):
        for configuration, tally in zip(chosen, tallies, strict=True):
            if judge or tally.spent < PATIENCE:
                found, seconds = timed(configuration, subject.flow, x_0)
                tally.add(seconds, len(x_0))
                if judge:
                    tally.judge(found, x_1, subject.encoding)
            if progress is not None:
                progress()


def runs(subjects: Iterable[Subject], chosen: Sequence[Configuration], repeats: int) -> int:
    """How often `measure` calls its progress."""
    return sum(repeats * len(chosen) * math.ceil(len(s.x_0) / s.batch_size) for s in subjects)


def timed(configuration: Configuration, flow: Flow, x_0: Tensor) -> tuple[Solution, float]:
    """The solution and its seconds."""
    _wait_for(x_0.device)
    begin = time.perf_counter()
    found = configuration.solve(flow, x_0)
    _wait_for(x_0.device)
    return found, time.perf_counter() - begin


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class _Tally:
    """What one configuration did on one subject."""

    def __init__(self) -> None:
        self.spent = 0.0
        self.seconds: list[float] = []
        self.scenes: dict[str, list[float]] = defaultdict(list)

    def add(self, seconds: float, scenes: int) -> None:
        self.spent += seconds
        self.seconds.append(seconds / scenes)

    def judge(self, found: Solution, x_1: Tensor, encoding: Encoding | None) -> None:
        self.scenes["error"] += rms(found.x.double() - x_1).tolist()
        self.scenes["evaluations"] += found.evaluations.tolist()
        self.scenes["converged"] += found.converged.tolist()
        self.scenes["stiff"] += found.stiff.tolist()
        if encoding is not None:
            for name, values in metres_apart(encoding.decode(found.x), encoding.decode(x_1.to(found.x))).items():
                self.scenes[name] += values

    def row(self, subject: Subject, of: Configuration) -> dict[str, Any]:
        error, evaluations = np.array(self.scenes["error"]), self.scenes["evaluations"]
        row = {
            "problem": subject.name, "method": of.method, "steps": of.steps, "tolerance": of.tolerance,
            "label": of.label, "scenes": len(error),
            "evaluations": float(np.mean(evaluations)), "evaluations_most": int(max(evaluations)),
            "seconds": float(np.median(self.seconds)), "timings": len(self.seconds),
            "seconds_quarter": float(np.quantile(self.seconds, 0.25)),
            "seconds_three_quarters": float(np.quantile(self.seconds, 0.75)),
            "error": float(np.median(error)), "error_p95": float(np.quantile(error, 0.95, method="higher")),
            "error_worst": float(error.max()), "floor": subject.floor,
            "length": float(rms(subject.x_1 - subject.x_0).median()),
            "judged": bool(np.median(error) > subject.floor),
            "converged": int(sum(self.scenes["converged"])), "stiff": int(sum(self.scenes["stiff"])),
        }  # fmt: skip
        for name in ("range_rms_m", "range_median_m", "drop_differs"):
            known = [value for value in self.scenes[name] if math.isfinite(value)]
            row[name] = float(np.median(known)) if known else None
        return row


def metres_apart(image: Tensor, other: Tensor) -> dict[str, list[float]]:
    """How far two batches of decoded images, (B, 2 or 1, H, W), are from each other, scene by scene.

    Returns:
        `range_rms_m` and `range_median_m` of |difference| over the rays that both say return, NaN where there is
        none; `drop_differs`, the share of all rays that one says return and the other does not.
    """
    r, s = image[:, 0].flatten(1).double(), other[:, 0].flatten(1).double()
    both = (r > 0) & (s > 0)
    found: dict[str, list[float]] = {"range_rms_m": [], "range_median_m": [], "drop_differs": []}
    for scene in range(len(r)):
        apart = (r[scene] - s[scene]).abs()[both[scene]]
        found["range_rms_m"].append(apart.square().mean().sqrt().item())
        found["range_median_m"].append(apart.median().item() if len(apart) else math.nan)
        found["drop_differs"].append(((r[scene] > 0) != (s[scene] > 0)).double().mean().item())
    return found


def _mark(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Enter which rows of one subject are on the Pareto fronts of error against evaluations and against seconds."""
    for work in ("evaluations", "seconds"):
        front = pareto([row[work] for row in rows], [reached(row) for row in rows])
        for row, on_front in zip(rows, front, strict=True):
            row[f"pareto_{work}"] = on_front
    return rows


def reached(row: Mapping[str, Any]) -> float:
    """The error that a row may claim: not below what its reference can judge.

    Infinite where a scene was lost, and where x_0 itself is no farther from the end.
    """
    if row["converged"] < row["scenes"] or not row["error"] < row["length"]:
        return math.inf
    return float(max(row["error"], row["floor"]))


def pareto(work: Sequence[float], error: Sequence[float]) -> list[bool]:
    """Which points no other one beats: as good in both and better in one. Infinite errors are never among them."""
    points = list(zip(work, error, strict=True))
    return [math.isfinite(e) and not any(v <= w and f <= e and (v < w or f < e) for v, f in points) for w, e in points]


def best_within(
    rows: Sequence[Mapping[str, Any]], budget: float, work: str = "evaluations"
) -> Mapping[str, Any] | None:
    """The row of least error whose work is within a budget; of equals, the one of least work."""
    within = [row for row in rows if row[work] <= budget and math.isfinite(reached(row))]
    return min(within, key=lambda row: (reached(row), row[work]), default=None)


def problem_subjects(names: Sequence[str] | None = None, scenes: int = 16, elements: int = 64) -> list[Subject]:
    """The exact problems of `r2flow.flow.problems`, all if none are named, on Gaussian starts.

    Raises:
        InputError: an unknown name.
    """
    subjects = []
    for name in PROBLEMS if names is None else names:
        problem = PROBLEMS[name]()
        # float64: the solver's error, not rounding, is what we measure.
        x_0 = Draws(PROBLEM_SEED, range(scenes)).start((elements,)).double()
        subjects.append(Subject(name, Field(problem, (elements,)), x_0, problem.solution(x_0, 1.0), scenes, floor=1e-9))
    return subjects
