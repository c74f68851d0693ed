"""What a scene need not cost: evaluations and seconds saved, and the error that is paid for it."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor, nn

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.flow.problems import PROBLEMS, Mixed, Problem
from r2flow.flow.straight_exit import probes
from r2flow.generators import Field, Flow, Sampler, as_flow
from r2flow.lidar.region import Region, region
from r2flow.noise import Draws
from r2flow.reports.outputs import formats_of, write_scan
from r2flow.sampling import evaluated_region

Row = dict[str, Any]
Progress = Callable[[], None]

# Scenes of the mixed batch by kind: their number and their problem.
MIXED = {"straight": 8, "gaussian": 4, "two_modes": 3, "ray_drop": 1}
LONE = {"straight": 255, "ray_drop": 1}
ELEMENTS = 256  # of an exact scene
FIXED = 32  # steps of the fixed-step rows
REPEATS = 3  # of every timing
TOLERANCES = (1e-3, 1e-5)
TIGHT = 1e-6  # tolerance of the solution that a trained flow is held against

EULER, AB2 = f"euler, {FIXED} steps", f"ab2, {FIXED} steps"
ONE_STATE = "dopri5, the batch as one state (torchdiffeq)"
STAYING = "dopri5, own steps, the finished stay"
LEAVING = "dopri5, own steps, the finished leave"
STRAIGHT = "the same, and one step for the straight"


@dataclass(frozen=True)
class Solved:
    """Ends of all scenes, (B, ...), their evaluations, (B,), and the seconds of it all."""

    x: Tensor
    evaluations: Tensor
    seconds: float


def one_state(flow: Flow, x: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """torchdiffeq's dopri5 as it is usually called: one step and one error norm for the whole batch."""
    import torchdiffeq

    calls, velocity = 0, flow.field()

    def counted(t: Tensor, state: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return velocity(t, state).to(state.dtype)

    span = torch.tensor([0.0, 1.0], dtype=x.dtype, device=x.device)
    end = torchdiffeq.odeint(counted, x, span, rtol=tolerance, atol=tolerance, method="dopri5")[-1]
    return end, torch.full((len(x),), calls)


def _by(sampler: Sampler) -> Callable[[Flow, Tensor, float], tuple[Tensor, Tensor]]:
    def way(flow: Flow, x: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        end = flow.solve(x, sampler=sampler.changed(tolerance=tolerance))
        return end.x, end.evaluations

    return way


WAYS: dict[str, Callable[[Flow, Tensor, float], tuple[Tensor, Tensor]]] = {
    EULER: _by(Sampler("euler", FIXED)),
    AB2: _by(Sampler("ab2", FIXED)),
    ONE_STATE: one_state,
    LEAVING: _by(Sampler("dopri5")),
    STRAIGHT: _by(Sampler("dopri5", straight_first=True)),
}


def solve_in_all_ways(flow: Flow, x: Tensor, tolerance: float, repeats: int = REPEATS) -> dict[str, Solved]:
    """Every row of the scenes' table, in its order; seconds are medians of `repeats`."""
    ends: dict[str, tuple[Tensor, Tensor]] = {}
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    for _ in range(repeats):
        for name, way in WAYS.items():
            begin = time.perf_counter()
            ends[name] = way(flow, x, tolerance)
            _wait(x)
            seconds[name].append(time.perf_counter() - begin)
    found = {}
    for name, (end, evaluations) in ends.items():
        if name == LEAVING:  # what per-scene solvers that keep the batch whole spend (torchode): same ends
            found[STAYING] = Solved(end, torch.full_like(evaluations, int(evaluations.max())), float("nan"))
        found[name] = Solved(end, evaluations, median(seconds[name]))
    return found


def exact_rows(kinds: Mapping[str, int], batch: str, tolerances: Sequence[float], seed: int) -> list[Row]:
    """Scenes whose ends are known: evaluations and errors by kind, a row for each way and tolerance."""
    problems: list[Problem] = []
    places: dict[str, slice] = {}
    for kind, count in kinds.items():
        places[kind] = slice(len(problems), len(problems) + count)
        problems += [PROBLEMS[kind]()] * count
    # float64: the solver's error, not rounding, is what we measure
    x_0 = Draws(seed, range(len(problems))).start((ELEMENTS,)).double()
    mixed = Mixed(problems)
    truth, flow = mixed.solution(x_0, 1.0), Field(mixed, (ELEMENTS,))
    rows = []
    for tolerance in tolerances:
        for way, solved in solve_in_all_ways(flow, x_0, tolerance).items():
            errors = (solved.x - truth).square().mean(1).sqrt()
            row: Row = {"part": batch, "way": way, "tolerance": None if way in (EULER, AB2) else tolerance}
            row |= {"evaluations": int(solved.evaluations.sum()), "seconds": solved.seconds}
            row["worst_error"] = float(errors.max())
            for kind, scenes in places.items():
                row[f"evaluations_{kind}"] = float(solved.evaluations[scenes].double().mean())
                row[f"error_{kind}"] = float(errors[scenes].max())
            rows.append(row)
    return [row for i, row in enumerate(rows) if row["tolerance"] or i < len(WAYS)]  # fixed steps: once


def scene_rows(checkpoint: Checkpoint, num: int, tolerance: float, seed: int, advance: Progress) -> list[Row]:
    """The same ways on scenes of a trained flow, held against its own tight solution.

    Raises:
        InputError: the flow has none.
    """
    flow = as_flow(checkpoint.generator, "a savings report")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    counted = Field(_Counted(flow, advance), flow.noise_shape)
    with torch.inference_mode():
        tight = counted.solve(x_0, sampler=Sampler("dopri5", tolerance=TIGHT))
        if not tight.converged.all():
            lost = ", ".join(str(scene) for scene in (~tight.converged).nonzero()[:, 0].tolist())
            raise InputError(
                f"dopri5 at {TIGHT:g} does not solve scene {lost} of this flow: there is nothing to hold its scenes "
                "against. Leave the checkpoint out for the exact problems alone."
            )
        truth = tight.x
        found = solve_in_all_ways(counted, x_0, tolerance, repeats=1)
    rows = []
    for way, solved in found.items():
        errors = (solved.x - truth).double().square().flatten(1).mean(1).sqrt()
        row: Row = {"part": "scenes of the flow", "way": way, "tolerance": None if way in (EULER, AB2) else tolerance}
        row |= {"evaluations": int(solved.evaluations.sum()), "seconds": solved.seconds}
        row["straight"] = int((solved.evaluations == 1 + len(probes(tolerance))).sum()) if way == STRAIGHT else None
        rows.append({**row, "worst_error": float(errors.max()), "median_error": float(errors.median())})
    return rows


def regions_to_measure(shape: tuple[int, int]) -> dict[str, tuple[Region, Region]]:
    """What is asked for and what is generated for it, before rounding, by name."""
    ahead, half = region(shape, (-45, 45)), region(shape, (-90, 90))
    upper = region(shape, None, (0, shape[0] // 2 - 1))
    quarter = region(shape, None, (shape[0] // 4, shape[0] // 2 - 1))
    corner = region(shape, (-45, 45), (0, shape[0] // 2 - 1))
    return {
        "sector of 180 degrees": (half, half),
        "sector of 90 degrees": (ahead, ahead),
        "90 degrees out of 180 generated": (ahead, half),
        "upper half of the rows": (upper, upper),
        "a quarter of the rows": (quarter, quarter),
        "90 degrees, upper half of the rows": (corner, corner),
    }


def region_rows(checkpoint: Checkpoint, num: int, steps: int, seed: int, advance: Progress) -> list[Row]:
    """Parts of the image against the same pixels of the whole one, from the same noise and in the same steps."""
    flow = as_flow(checkpoint.generator, "a savings report")
    x_0 = Draws(seed, range(num)).start(flow.noise_shape)
    wanted = regions_to_measure(checkpoint.sensor.shape)
    regions = {"the whole image": region(checkpoint.sensor.shape)}
    regions |= {name: evaluated_region(flow, generated) for name, (_, generated) in wanted.items()}
    parts = {name: as_flow(flow.part(seen), "a part") for name, seen in regions.items()}
    ends = {name: _sampled(parts[name], seen.crop(x_0), steps, advance) for name, seen in regions.items()}
    t, first = torch.tensor(0.5), x_0[:1]
    calls = {name: partial(parts[name].velocity, t, seen.crop(first).to(flow.device)) for name, seen in regions.items()}
    seconds = _in_turns(calls, 1.0)
    whole = ends["the whole image"]
    rows: list[Row] = []
    for name, seen in regions.items():
        row: Row = {"part": "regions", "way": name, "share": seen.share, "seconds": steps * seconds[name]}
        row["time"] = seconds[name] / seconds["the whole image"]
        if name in wanted:
            asked, _ = wanted[name]
            truth = asked.crop(whole)
            row |= _apart(checkpoint, asked.crop(seen.place(ends[name])), truth)
            # how far it would be if the noise told nothing of the scene
            row["unrelated"] = _rms(truth, truth.roll(1, 0)) if num > 1 else None
        rows.append(row)
    return rows


def channel_rows(checkpoint: Checkpoint, budget: float = 1.0) -> list[Row]:
    """Seconds of one evaluation, of decoding and of writing a scan, with both channels and with the range alone."""
    from r2flow.backbones import build_backbone

    if not checkpoint.encoding.reflectance:
        return []
    ranges, t = checkpoint.encoding.format.channels, torch.tensor(0.5)
    space, device = checkpoint.generator.space, checkpoint.generator.device
    x = Draws(0, range(1)).start((ranges + 1, *checkpoint.sensor.shape))
    alone = build_backbone(checkpoint.config["backbone"], space.rays, ranges).eval().to(device)
    on = x.to(device)
    network = _in_turns({"both": partial(checkpoint.model, t, on), "range": partial(alone, t, on[:, :ranges])}, budget)
    decoding = _in_turns({name: partial(space.decode, x, name) for name in network}, budget)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        writers = {}
        for name in network:
            image = space.decode(x, name)[0].numpy()
            formats = [ending for ending in formats_of(checkpoint, name) if ending != "bin"]
            writers[name] = partial(write_scan, image, checkpoint.sensor.rays(), Path(folder, name), "scan", formats)
        writing = _in_turns(writers, budget)
        for name in network:
            size = sum(path.stat().st_size for path in Path(folder, name).iterdir())
            row: Row = {"part": "channels", "way": name, "network": network[name], "decoding": decoding[name]}
            rows.append({**row, "writing": writing[name], "bytes": size})
    return rows


class _Counted(nn.Module):
    """A flow's velocity that tells of its evaluations."""

    def __init__(self, flow: Flow, advance: Progress) -> None:
        super().__init__()
        self.flow, self.advance = flow, advance

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        self.advance()
        return self.flow.velocity(t, x)


def _sampled(flow: Flow, x_0: Tensor, steps: int, advance: Progress) -> Tensor:
    """Scenes one by one, (B, ...) on the CPU."""
    sampler = Sampler("ab2", steps)
    return torch.cat([flow.solve(scene, sampler=sampler, progress=advance).x.cpu() for scene in x_0.split(1)])


def _in_turns(calls: Mapping[str, Callable[[], Any]], budget: float) -> dict[str, float]:
    """Seconds of each call: the least of 3 to 40, as many as fit into a budget of seconds, after one to warm up.

    In turns, and the least: what else the machine does slows all of them alike, and can only add.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    rounds = 1 + 40
    with torch.inference_mode():
        while len(next(iter(seconds.values()))) < rounds:
            for name, call in calls.items():
                begin = time.perf_counter()
                _wait(call())
                seconds[name].append(time.perf_counter() - begin)
            longest = max(values[-1] for values in seconds.values())
            rounds = min(rounds, 1 + max(3, int(budget / longest)))
    return {name: min(values[1:]) for name, values in seconds.items()}


def _wait(result: Any) -> None:
    if isinstance(result, Tensor) and result.is_cuda:
        torch.cuda.synchronize(result.device)


def _rms(a: Tensor, b: Tensor) -> float:
    return float((a - b).double().square().mean().sqrt())


def _apart(checkpoint: Checkpoint, mine: Tensor, truth: Tensor) -> Row:
    """Root mean square in model space, median metres where both return, share of rays lost or gained."""
    a, b = (checkpoint.encoding.decode(x)[:, 0].double() for x in (mine, truth))
    both = (a > 0) & (b > 0)
    metres = float((a - b).abs()[both].median()) if both.any() else float("nan")
    return {"error": _rms(mine, truth), "median_m": metres, "dropped": float(((a > 0) != (b > 0)).double().mean())}
