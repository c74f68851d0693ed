"""What a scan need not cost: evaluations and seconds saved, and the error that this adds."""

import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.problems import PROBLEMS, Mixed
from r2flow.generators import Field, Flow, Sampler, as_flow
from r2flow.generators.base import Progress
from r2flow.inversion import metres_apart, rms
from r2flow.lidar.region import Region, region
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.sampling import evaluated_region
from r2flow.noise import Draws
from r2flow.reports.outputs import write_scan
from r2flow.reports.pages import Page, blank_figure
from r2flow.reports.tables import shown, table
from r2flow.reports.timing import timed

Row = dict[str, Any]

NAME = "a savings report"
# Scans of the exact batches by kind.
MIXED = {"straight": 8, "gaussian": 4, "two_modes": 3, "ray_drop": 1}
LONE = {"straight": 255, "ray_drop": 1}
# Name, colour and hatch of a kind: told apart without colour.
KINDS = {
    "straight": ("straight", "#d9d9d9", ""), "gaussian": ("smooth", "#9ecae1", "//"),
    "two_modes": ("two modes", "#4a90c2", ".."), "ray_drop": ("ray-drop", "#1b3a57", ""),
}  # fmt: skip
ELEMENTS = 256  # of an exact scan
FIXED = 32  # steps of the fixed-step rows
REPEATS = 3  # of every timing
TOLERANCES = (1e-3, 1e-5)
MARGINS = (11.25, 22.5, 45.0)  # degrees on either side of a sector
TIGHT = 1e-6  # tolerance of the solution that a trained flow is compared with
WHOLE = "the whole image"

EULER, AB2 = f"euler, {FIXED} steps", f"ab2, {FIXED} steps"
ONE_STATE = "dopri5, the batch as one state (torchdiffeq)"
STAYING = "dopri5, own steps, the finished stay"
LEAVING = "dopri5, own steps, the finished leave"


WAYS: dict[str, Sampler | None] = {
    EULER: Sampler("euler", FIXED),
    AB2: Sampler("ab2", FIXED),
    ONE_STATE: None,
    LEAVING: Sampler("dopri5"),
}


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


def _solve(
    flow: Flow, x: Tensor, sampler: Sampler | None, tolerance: float, progress: Progress
) -> tuple[Tensor, Tensor]:
    if sampler is None:
        return one_state(flow, x, tolerance, progress)
    end = flow.solve(x, sampler=sampler.changed(tolerance=tolerance), progress=progress)
    return end.x, end.evaluations


def solve_in_all_ways(
    part: str, flow: Flow, x_0: Tensor, truth: Tensor, tolerance: float, repeats: int, progress: Progress = None
) -> Iterator[tuple[Row, Tensor, Tensor]]:
    """A row for each of `WAYS`, with every scan's evaluations and error, (B,); seconds are medians of `repeats`."""
    ends: dict[str, tuple[Tensor, Tensor]] = {}
    seconds: dict[str, list[float]] = defaultdict(list)
    for _ in range(repeats):
        for way, sampler in WAYS.items():
            ends[way], taken = timed(partial(_solve, flow, x_0, sampler, tolerance, progress), x_0.device)
            seconds[way].append(taken)
    for way, (x_1, evaluations) in ends.items():
        errors = rms(x_1 - truth)
        row: Row = {"part": part, "way": way, "tolerance": None if way in (EULER, AB2) else tolerance}
        row |= {"evaluations": int(evaluations.sum()), **spread("seconds", seconds[way])}
        row["worst_error"] = float(errors.max())
        if way == LEAVING:  # what solvers with own steps spend that keep the batch whole (torchode): same ends
            most = torch.full_like(evaluations, int(evaluations.max()))
            whole = {**row, "way": STAYING, "evaluations": int(most.sum()), **spread("seconds", [float("nan")])}
            yield whole, most, errors
        yield row, evaluations, errors


def exact_rows(kinds: Mapping[str, int], batch: str, tolerances: Sequence[float], seed: int) -> list[Row]:
    """Scans whose ends are known: evaluations and errors by kind, a row for each way and tolerance."""
    every = [kind for kind, count in kinds.items() for _ in range(count)]
    mixed = Mixed([PROBLEMS[kind]() for kind in every])
    # float64: the solver's error, not rounding, is measured
    x_0 = Draws(seed, range(len(every))).start((ELEMENTS,)).double()
    truth, flow = mixed.solution(x_0, 1.0), Field(mixed, (ELEMENTS,))
    rows = []
    for tolerance in tolerances:
        for row, evaluations, errors in solve_in_all_ways(batch, flow, x_0, truth, tolerance, REPEATS):
            for kind in kinds:
                own = torch.tensor([one == kind for one in every])
                row[f"evaluations_{kind}"] = float(evaluations[own].double().mean())
                row[f"error_{kind}"] = float(errors[own].max())
            if row["tolerance"] or tolerance == tolerances[0]:  # fixed steps: once
                rows.append(row)
    return rows


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
        found = list(solve_in_all_ways("scenes of the flow", flow, x_0, tight.x, tolerance, 1, progress))
    for row, _, errors in found:
        row["median_error"] = float(errors.median())
    return [row for row, _, _ in found]


def regions_to_measure(shape: tuple[int, int]) -> dict[str, tuple[Region, Region]]:
    """What is asked for and what is generated for it, before rounding, by name."""
    ahead, half = region(shape, (-45, 45)), region(shape, (-90, 90))
    margins = {f"90 degrees, a margin of {margin:g}": region(shape, (-45, 45), None, margin) for margin in MARGINS}
    upper = region(shape, None, (0, shape[0] // 2 - 1))
    quarter = region(shape, None, (shape[0] // 4, shape[0] // 2 - 1))
    corner = region(shape, (-45, 45), (0, shape[0] // 2 - 1))
    return {
        "sector of 180 degrees": (half, half),
        "sector of 90 degrees": (ahead, ahead),
        **{name: (ahead, wider.widened()) for name, wider in margins.items()},
        "upper half of the rows": (upper, upper),
        "a quarter of the rows": (quarter, quarter),
        "90 degrees, upper half of the rows": (corner, corner),
    }


def region_rows(checkpoint: Checkpoint, num: int, steps: int, seed: int, progress: Progress = None) -> list[Row]:
    """Parts of the image against the same pixels of the whole one, from the same noise and in the same steps."""
    flow, shape = as_flow(checkpoint.generator, NAME), checkpoint.sensor.shape
    wanted = {WHOLE: (region(shape), region(shape)), **regions_to_measure(shape)}
    seen = {name: evaluated_region(flow, generated) for name, (_, generated) in wanted.items()}
    alike = {(wanted[name][0], part): name for name, part in seen.items()}  # margins that rounding made one
    wanted = {name: both for name, both in wanted.items() if name in alike.values()}
    parts = {name: as_flow(flow.part(seen[name]), NAME) for name in wanted}
    x_0 = Draws(seed, range(num)).start(flow.noise_shape)
    calls, ends = {}, {}
    for name in wanted:
        part = seen[name]
        own, sampler = part.crop(x_0), Sampler("ab2", steps)
        one_by_one = [parts[name].solve(x, sampler=sampler, progress=progress).x.cpu() for x in own.split(1)]
        ends[name] = part.place(torch.cat(one_by_one))
        calls[name] = partial(parts[name].velocity, torch.tensor(0.5), own[:1].to(flow.device))
    seconds = _in_turns(calls, 1.0, flow.device)
    rows: list[Row] = []
    for name, (asked, _) in wanted.items():
        row: Row = {"part": "regions", "way": name, "share": seen[name].share}
        row |= spread("seconds", [steps * taken for taken in seconds[name]])
        row |= spread("time", [one / whole for one, whole in zip(seconds[name], seconds[WHOLE], strict=True)])
        if name != WHOLE:
            mine, truth = asked.crop(ends[name]), asked.crop(ends[WHOLE])
            # all rays of all scans as one image
            decoded = (checkpoint.encoding.decode(x)[:, :1].flatten(0, 2)[None, None] for x in (mine, truth))
            median_m, _, dropped = metres_apart(*decoded)
            row |= {"error": _rms(mine, truth), "median_m": float(median_m), "dropped": float(dropped)}
            # how far it would be if the noise told nothing of the scan
            row["unrelated"] = _rms(truth, truth.roll(1, 0)) if num > 1 else None
        rows.append(row)
    return rows


def _rms(a: Tensor, b: Tensor) -> float:
    return float((a - b).double().square().mean().sqrt())


def channel_rows(checkpoint: Checkpoint, budget: float = 1.0) -> list[Row]:
    """Seconds of one evaluation, of decoding and of writing a scan, with both channels and with the range alone."""
    from r2flow.backbones import build_backbone

    if not checkpoint.encoding.reflectance:
        return []
    ranges, t = checkpoint.encoding.format.channels, torch.tensor(0.5)
    space, device = checkpoint.generator.space, checkpoint.generator.device
    x = Draws(0, range(1)).start((ranges + 1, *checkpoint.sensor.shape))
    networks, decoders, writers = {}, {}, {}
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, channels in (("both", ranges + 1), ("range", ranges)):
            backbone = build_backbone(checkpoint.config["backbone"], space.rays, channels).eval().to(device)
            networks[name] = partial(backbone, t, x[:, :channels].to(device))
            decoders[name] = partial(space.decode, x, name)
            image, out = space.decode(x, name)[0].numpy(), Path(folder, name)
            writers[name] = partial(write_scan, image, checkpoint.sensor.rays(), out, "scan", ("ply", "npy"))
        network = _in_turns(networks, budget, device)
        decoding, writing = _in_turns(decoders, budget), _in_turns(writers, budget)
        for name in networks:
            row: Row = {"part": "channels", "way": name}
            for what, taken in (("network", network), ("decoding", decoding), ("writing", writing)):
                row |= spread(what, taken[name])
            rows.append({**row, "bytes": sum(path.stat().st_size for path in Path(folder, name).iterdir())})
    return rows


def _in_turns(
    calls: Mapping[str, Callable[[], Any]], budget: float, device: torch.device | str = "cpu"
) -> dict[str, list[float]]:
    """Seconds of each call, 3 to 40 times, as many as fit into a budget of seconds, after one to warm up.

    In turns, so that what else the machine does slows all of them alike.
    """
    seconds: list[dict[str, float]] = []
    rounds = 1 + 40
    with torch.inference_mode():
        while len(seconds) < rounds:
            seconds.append({name: timed(call, device)[1] for name, call in calls.items()})
            rounds = min(rounds, 1 + max(3, int(budget / max(seconds[-1].values()))))
    return {name: [one[name] for one in seconds[1:]] for name in calls}


def spread(name: str, values: Sequence[float]) -> Row:
    """The median under a name, the least and the most beside it."""
    return {name: median(values), f"{name}_least": min(values), f"{name}_most": max(values)}


# The page: a part is its conditions in a sentence and its rows as a table.

OF_KINDS = {"evaluations": "evaluations, all", "share": "of one state's", "worst_error": "worst error"}
OF_KINDS |= {f"evaluations_{kind}": f"a {name} scan" for kind, (name, _, _) in KINDS.items()}
OF_KINDS |= {f"error_{kind}": f"error, {name}" for kind, (name, _, _) in KINDS.items()}
SECONDS = {"seconds": "seconds", "seconds_least": "least", "seconds_most": "most"}
OF_SCANS = {"evaluations": "evaluations", "share": "of one state's", **SECONDS}
OF_SCANS |= {"median_error": "median error", "worst_error": "worst error"}
OF_REGIONS = {"share": "of the pixels", "seconds": "seconds a scan", "time": "of the time", "time_least": "least"}
OF_REGIONS |= {"time_most": "most", "error": "RMS, model space"}
OF_REGIONS |= {"unrelated": "unrelated scans", "median_m": "median, m", "dropped": "rays lost or gained"}
OF_CHANNELS = {"network": "network, s", "network_least": "least", "network_most": "most", "decoding": "decoding, s"}
OF_CHANNELS |= {"writing": "writing, s", "bytes": "bytes"}


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
    kinds = ", ".join(f"{count} {KINDS[kind][0]}" for kind, count in MIXED.items())
    text = [
        f"## Easy and hard scans in one batch\n\nExact problems, {ELEMENTS} elements a scan, float64: {kinds}. Seconds "
        "are the solver's own work, without a network.",
        table(_with_share(mixed), {"way": "way", "tolerance": "tolerance", **OF_KINDS, **SECONDS}),
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
            "the whole image from the same noise. Seconds are an evaluation's times the steps, the median of "
            "several, with the least and the most. The network sees the part alone, so it makes another scan, the more "
            "so the more is cut off. How realistic that scan is, is not measured here.",
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


def scans_figure(rows: Sequence[Row]) -> Figure:
    """Evaluations of the mixed batch by way and kind of scan, the worst error beside them."""
    figure = blank_figure(11, 4.4, "Easy and hard scans in one batch")
    panels = figure.subplots(1, len(TOLERANCES), sharey=True)
    for axes, tolerance in zip(panels, TOLERANCES, strict=True):
        chosen = [row for row in rows if row["tolerance"] in (tolerance, None) and row["way"] != AB2]
        ways, begin = [row["way"] for row in chosen], [0.0] * len(chosen)
        for kind, count in MIXED.items():
            length = [count * row[f"evaluations_{kind}"] for row in chosen]
            name, colour, hatch = KINDS[kind]
            style = {"color": colour, "hatch": hatch, "edgecolor": "black", "lw": 0.5}
            axes.barh(ways, length, left=begin, **style, label=f"{count} {name}")
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
    right.set(xlabel="RMS distance from the whole image, model space", xlim=(0, 1.6 * furthest))
    return figure


def _annotate(axes: Any, ends: Sequence[float], notes: Sequence[str]) -> None:
    """A note at the end of each bar."""
    for place, (end, note) in enumerate(zip(ends, notes, strict=True)):
        axes.annotate(note, (end, place), va="center", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3, axis="x")
    axes.set_axisbelow(True)
