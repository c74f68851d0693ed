"""What a scan need not cost: evaluations and seconds saved, and the error that this adds."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.flow.problems import PROBLEMS, Mixed, Problem
from r2flow.flow.straight_exit import probes
from r2flow.generators import Field, Flow, Sampler, as_flow
from r2flow.generators.base import Progress
from r2flow.lidar.region import Region, region
from r2flow.noise import Draws
from r2flow.reports.outputs import formats_of, write_scan
from r2flow.reports.pages import Page, blank_figure
from r2flow.reports.tables import shown, table
from r2flow.sampling import evaluated_region

Row = dict[str, Any]

NAME = "a savings report"
# Scans of the mixed batch by kind: their number and their problem.
MIXED = {"straight": 8, "gaussian": 4, "two_modes": 3, "ray_drop": 1}
LONE = {"straight": 255, "ray_drop": 1}
ELEMENTS = 256  # of an exact scan
FIXED = 32  # steps of the fixed-step rows
REPEATS = 3  # of every timing
TOLERANCES = (1e-3, 1e-5)
TIGHT = 1e-6  # tolerance of the solution that a trained flow is compared with
WHOLE = "the whole image"

EULER, AB2 = f"euler, {FIXED} steps", f"ab2, {FIXED} steps"
ONE_STATE = "dopri5, the batch as one state (torchdiffeq)"
STAYING = "dopri5, own steps, the finished stay"
LEAVING = "dopri5, own steps, the finished leave"
STRAIGHT = "the same, and one step for the straight"


@dataclass(frozen=True)
class Solved:
    """Ends of all scans, (B, ...), their evaluations, (B,), and the seconds for all of them."""

    x: Tensor
    evaluations: Tensor
    seconds: float


Way = Callable[[Flow, Tensor, float, Progress], tuple[Tensor, Tensor]]


def one_state(flow: Flow, x: Tensor, tolerance: float, progress: Progress = None) -> tuple[Tensor, Tensor]:
    """torchdiffeq's dopri5 as it is usually called: one step and one error norm for the whole batch."""
    import torchdiffeq

    calls, velocity = 0, flow.field()

    def counted(t: Tensor, state: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        if progress is not None:
            progress()
        return velocity(t, state).to(state.dtype)

    span = torch.tensor([0.0, 1.0], dtype=x.dtype, device=x.device)
    end = torchdiffeq.odeint(counted, x, span, rtol=tolerance, atol=tolerance, method="dopri5")[-1]
    return end, torch.full((len(x),), calls)


def _by(sampler: Sampler) -> Way:
    def way(flow: Flow, x: Tensor, tolerance: float, progress: Progress = None) -> tuple[Tensor, Tensor]:
        end = flow.solve(x, sampler=sampler.changed(tolerance=tolerance), progress=progress)
        return end.x, end.evaluations

    return way


WAYS: dict[str, Way] = {
    EULER: _by(Sampler("euler", FIXED)),
    AB2: _by(Sampler("ab2", FIXED)),
    ONE_STATE: one_state,
    LEAVING: _by(Sampler("dopri5")),
    STRAIGHT: _by(Sampler("dopri5", straight_first=True)),
}


def solve_in_all_ways(
    flow: Flow, x: Tensor, tolerance: float, repeats: int = REPEATS, progress: Progress = None
) -> dict[str, Solved]:
    """The end of x at t = 1 by each of `WAYS`; seconds are medians of `repeats`."""
    ends: dict[str, tuple[Tensor, Tensor]] = {}
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    for _ in range(repeats):
        for name, way in WAYS.items():
            begin = time.perf_counter()
            ends[name] = way(flow, x, tolerance, progress)
            _wait(x)
            seconds[name].append(time.perf_counter() - begin)
    found = {}
    for name, (end, evaluations) in ends.items():
        if name == LEAVING:  # what solvers with own steps spend that keep the batch whole (torchode): same ends
            found[STAYING] = Solved(end, torch.full_like(evaluations, int(evaluations.max())), float("nan"))
        found[name] = Solved(end, evaluations, median(seconds[name]))
    return found


def exact_rows(kinds: Mapping[str, int], batch: str, tolerances: Sequence[float], seed: int) -> list[Row]:
    """Scans whose ends are known: evaluations and errors by kind, a row for each way and tolerance."""
    problems: list[Problem] = []
    places: dict[str, slice] = {}
    for kind, count in kinds.items():
        places[kind] = slice(len(problems), len(problems) + count)
        problems += [PROBLEMS[kind]()] * count
    # float64: the solver's error, not rounding, is measured
    x_0 = Draws(seed, range(len(problems))).start((ELEMENTS,)).double()
    mixed = Mixed(problems)
    truth, flow = mixed.solution(x_0, 1.0), Field(mixed, (ELEMENTS,))
    rows = []
    for tolerance in tolerances:
        for way, solved in solve_in_all_ways(flow, x_0, tolerance, REPEATS).items():
            row, errors = _row(batch, way, tolerance, solved, truth)
            for kind, scans in places.items():
                row[f"evaluations_{kind}"] = float(solved.evaluations[scans].double().mean())
                row[f"error_{kind}"] = float(errors[scans].max())
            rows.append(row)
    return [row for i, row in enumerate(rows) if row["tolerance"] or i < len(WAYS)]  # fixed steps: once


def _row(part: str, way: str, tolerance: float, solved: Solved, truth: Tensor) -> tuple[Row, Tensor]:
    errors = (solved.x - truth).double().square().flatten(1).mean(1).sqrt()
    row: Row = {"part": part, "way": way, "tolerance": None if way in (EULER, AB2) else tolerance}
    row |= {"evaluations": int(solved.evaluations.sum()), "seconds": solved.seconds}
    return row | {"worst_error": float(errors.max())}, errors


def scan_rows(checkpoint: Checkpoint, num: int, tolerance: float, seed: int, progress: Progress = None) -> list[Row]:
    """The same ways on scans of a trained flow, compared with its own tight solution.

    Raises:
        InputError: the flow has none.
    """
    flow = as_flow(checkpoint.generator, NAME)
    x_0 = Draws(seed, range(num)).start(flow.noise_shape).to(flow.device)
    with torch.inference_mode():
        tight = flow.solve(x_0, sampler=Sampler("dopri5", tolerance=TIGHT), progress=progress)
        if not tight.converged.all():
            lost = ", ".join(str(number) for number in (~tight.converged).nonzero()[:, 0].tolist())
            raise InputError(
                f"dopri5 at {TIGHT:g} does not solve scan {lost} of this flow, so there is no solution to compare "
                "with. Leave the checkpoint out for the exact problems alone."
            )
        found = solve_in_all_ways(flow, x_0, tolerance, repeats=1, progress=progress)
    rows = []
    for way, solved in found.items():
        row, errors = _row("scenes of the flow", way, tolerance, solved, tight.x)
        row["straight"] = int((solved.evaluations == 1 + len(probes(tolerance))).sum()) if way == STRAIGHT else None
        rows.append({**row, "median_error": float(errors.median())})
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


def region_rows(checkpoint: Checkpoint, num: int, steps: int, seed: int, progress: Progress = None) -> list[Row]:
    """Parts of the image against the same pixels of the whole one, from the same noise and in the same steps."""
    flow = as_flow(checkpoint.generator, NAME)
    x_0 = Draws(seed, range(num)).start(flow.noise_shape)
    wanted = regions_to_measure(checkpoint.sensor.shape)
    regions = {WHOLE: region(checkpoint.sensor.shape)}
    regions |= {name: evaluated_region(flow, generated) for name, (_, generated) in wanted.items()}
    parts = {name: as_flow(flow.part(seen), NAME) for name, seen in regions.items()}
    ends = {name: _sampled(parts[name], seen.crop(x_0), steps, progress) for name, seen in regions.items()}
    t, first = torch.tensor(0.5), x_0[:1]
    calls = {name: partial(parts[name].velocity, t, seen.crop(first).to(flow.device)) for name, seen in regions.items()}
    seconds = _in_turns(calls, 1.0)
    rows: list[Row] = []
    for name, seen in regions.items():
        row: Row = {"part": "regions", "way": name, "share": seen.share, "seconds": steps * seconds[name]}
        row["time"] = seconds[name] / seconds[WHOLE]
        if name in wanted:
            asked, _ = wanted[name]
            truth = asked.crop(ends[WHOLE])
            row |= _apart(checkpoint, asked.crop(seen.place(ends[name])), truth)
            # how far it would be if the noise told nothing of the scan
            row["unrelated"] = _rms(truth, truth.roll(1, 0)) if num > 1 else None
        rows.append(row)
    return rows


def _sampled(flow: Flow, x_0: Tensor, steps: int, progress: Progress) -> Tensor:
    """Scans one by one, (B, ...) on the CPU."""
    sampler = Sampler("ab2", steps)
    return torch.cat([flow.solve(scan, sampler=sampler, progress=progress).x.cpu() for scan in x_0.split(1)])


def channel_rows(checkpoint: Checkpoint, budget: float = 1.0) -> list[Row]:
    """Seconds of one evaluation, of decoding and of writing a scan, with both channels and with the range alone."""
    from r2flow.backbones import build_backbone

    if not checkpoint.encoding.reflectance:
        return []
    ranges, t = checkpoint.encoding.format.channels, torch.tensor(0.5)
    space, device = checkpoint.generator.space, checkpoint.generator.device
    x = Draws(0, range(1)).start((ranges + 1, *checkpoint.sensor.shape))
    networks = {}
    for name, channels in (("both", ranges + 1), ("range", ranges)):
        backbone = build_backbone(checkpoint.config["backbone"], space.rays, channels).eval().to(device)
        networks[name] = partial(backbone, t, x[:, :channels].to(device))
    network = _in_turns(networks, budget)
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


# The page: a part is its conditions in a sentence and its rows as a table.

KIND_NAMES = {"straight": "straight", "gaussian": "smooth", "two_modes": "two modes", "ray_drop": "ray-drop"}
OF_KINDS = {"evaluations": "evaluations, all", "share": "of one state's", "worst_error": "worst error"}
OF_KINDS |= {f"evaluations_{kind}": f"a {name} scan" for kind, name in KIND_NAMES.items()}
OF_KINDS |= {f"error_{kind}": f"error, {name}" for kind, name in KIND_NAMES.items()}
OF_SCANS = {"evaluations": "evaluations", "share": "of one state's", "seconds": "seconds"}
OF_SCANS |= {"median_error": "median error", "worst_error": "worst error", "straight": "straight scans"}
OF_REGIONS = {"share": "of the pixels", "seconds": "seconds a scan", "time": "of the time", "error": "RMS, model space"}
OF_REGIONS |= {"unrelated": "unrelated scans", "median_m": "median, m", "dropped": "rays lost or gained"}
OF_CHANNELS = {"network": "network, s", "decoding": "decoding, s", "writing": "writing, s", "bytes": "bytes"}


def savings_page(
    checkpoint: Checkpoint | None,
    num: int = 4,
    steps: int = 16,
    tolerance: float = 1e-3,
    seed: int = 0,
    command: str = "",
    progress: Progress = None,
) -> Page:
    """All of it as a page.

    Args:
        checkpoint: None leaves out what needs one.
        num: Scans of the checkpoint's flow.
        steps: AB2 steps of the regions.
        tolerance: Of the checkpoint's adaptive solutions.
        progress: Called after every evaluation of the checkpoint's network.
    """
    mixed = exact_rows(MIXED, "mixed", TOLERANCES, seed)
    lone = [row for row in exact_rows(LONE, "one among 255", (1e-3,), seed) if row["tolerance"]]
    kinds = ", ".join(f"{count} {KIND_NAMES[kind]}" for kind, count in MIXED.items())
    text = [
        f"## Easy and hard scans in one batch\n\nExact problems, {ELEMENTS} elements a scan, float64: {kinds}. Seconds "
        "are the solver's own work, without a network.",
        table(_with_share(mixed), {"way": "way", "tolerance": "tolerance", **OF_KINDS, "seconds": "seconds"}),
        "### One hard scan among 255 easy ones\n\nWhere the batch is one state, its error norm hides the hard one.",
        table(_with_share(lone), {"way": "way", **{k: v for k, v in OF_KINDS.items() if any(k in r for r in lone)}}),
    ]
    figures, rows, device = {"savings_scenes": scans_figure(mixed)}, [*mixed, *lone], "cpu"
    if checkpoint is not None:
        device = str(checkpoint.generator.device)
        scans = scan_rows(checkpoint, num, tolerance, seed, progress)
        regions = region_rows(checkpoint, num, steps, seed, progress)
        channels = channel_rows(checkpoint)
        name = f"{checkpoint.config['backbone']['name']} at {'x'.join(map(str, checkpoint.sensor.shape))}"
        text += [
            f"## Scans of the flow\n\n{name}, {num} scans in one batch, tolerance {tolerance:g}; errors in model space "
            f"against the flow's own dopri5 solution at {TIGHT:g}.",
            table(_with_share(scans), {"way": "way", **OF_SCANS}),
            f"## A part of the image\n\n{name}, {num} scans, {steps} AB2 steps; the part against the same pixels of "
            "the whole image from the same noise. Seconds are an evaluation's, the least of several, times the steps. "
            "The network sees the part alone, so it makes another scan, the more so the more is cut off. How "
            "realistic that scan is, is not measured here.",
            table(regions, {"way": "region", **OF_REGIONS}),
        ]
        figures["savings_regions"] = regions_figure(regions)
        if channels:
            text += [
                "## One channel\n\nBoth channels share their tokens, so `--channels range` saves decoding, writing and "
                "bytes (PLY and range image), but hardly anything of the network.",
                table(channels, {"way": "channels", **OF_CHANNELS}),
            ]
        rows += scans + regions + channels
    return Page("savings", "What a scan need not cost", text, rows, figures, command, {"noise": seed}, device)


def evaluations_of_page(num: int, steps: int) -> int:
    """About how many evaluations `savings_page` takes of a checkpoint: for a progress bar."""
    return 2 * FIXED + 270 + num * 7 * steps


def _with_share(rows: Sequence[Row]) -> list[Row]:
    """With each row's evaluations as a share of those of the batch as one state, at the same tolerance."""
    base = {row["tolerance"]: row["evaluations"] for row in rows if row["way"] == ONE_STATE}
    return [{**row, "share": row["evaluations"] / base[row["tolerance"]] if row["tolerance"] else None} for row in rows]


# Told apart without colour.
HATCHES = {
    "straight": ("#d9d9d9", ""), "gaussian": ("#9ecae1", "//"), "two_modes": ("#4a90c2", ".."),
    "ray_drop": ("#1b3a57", ""),
}  # fmt: skip


def scans_figure(rows: Sequence[Row]) -> Figure:
    """Evaluations of the mixed batch by way and kind of scan, the worst error beside them."""
    figure = blank_figure(11, 4.4, "Easy and hard scans in one batch")
    panels = figure.subplots(1, len(TOLERANCES), sharey=True)
    for axes, tolerance in zip(panels, TOLERANCES, strict=True):
        chosen = [row for row in rows if row["tolerance"] in (tolerance, None) and row["way"] != AB2]
        ways, begin = [row["way"] for row in chosen], [0.0] * len(chosen)
        for kind, count in MIXED.items():
            length = [count * row[f"evaluations_{kind}"] for row in chosen]
            colour, hatch = HATCHES[kind]
            label = f"{count} {KIND_NAMES[kind]}"
            axes.barh(ways, length, left=begin, color=colour, hatch=hatch, edgecolor="black", lw=0.5, label=label)
            begin = [a + b for a, b in zip(begin, length, strict=True)]
        notes = [f" {row['evaluations']}; worst error {shown(row['worst_error'])}" for row in chosen]
        _annotate(axes, begin, notes)
        axes.set(xlabel="evaluations, all 16 scans", xlim=(0, 1.65 * max(begin)), title=f"tolerance {tolerance:g}")
    panels[0].invert_yaxis()  # shared: the first way on top
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(MIXED), fontsize=8)
    return figure


def regions_figure(rows: Sequence[Row]) -> Figure:
    """Share of the time and distance from the whole image, region by region."""
    figure = blank_figure(10, 3.6, "A part of the image instead of the whole")
    left, right = figure.subplots(1, 2, sharey=True)
    names, times = [row["way"] for row in rows], [row["time"] for row in rows]
    left.barh(names, times, color="#9ecae1", edgecolor="black", lw=0.5)
    _annotate(left, times, [f" {time:.2f}" for time in times])
    left.set(xlabel="share of the whole image's time", xlim=(0, 1.15))
    left.invert_yaxis()
    errors = [row.get("error", 0.0) for row in rows]
    right.barh(names, errors, color="#d9d9d9", edgecolor="black", hatch="//", lw=0.5)
    metres = [f", median {row['median_m']:.2g} m" if "median_m" in row else "" for row in rows]
    _annotate(right, errors, [f" {shown(error)}{more}" for error, more in zip(errors, metres, strict=True)])
    unrelated = [(row["unrelated"], row["way"]) for row in rows if row.get("unrelated")]
    if unrelated:
        right.plot(*zip(*unrelated, strict=True), "k|", ms=13, mew=1.6, label="two unrelated scans")
        right.legend(fontsize=8, loc="upper right")
    furthest = max([*errors, *(value for value, _ in unrelated), 1e-9])
    right.set(xlabel="RMS distance from the whole image, model space", xlim=(0, 1.3 * furthest))
    return figure


def _annotate(axes: Any, ends: Sequence[float], notes: Sequence[str]) -> None:
    """A note at the end of each bar."""
    for place, (end, note) in enumerate(zip(ends, notes, strict=True)):
        axes.annotate(note, (end, place), va="center", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3, axis="x")
    axes.set_axisbelow(True)
