"""`r2flow evaluate` and `r2flow report neighbours`: generated scans against real ones."""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2flow.cli.app import app, report
from r2flow.cli.options import (
    SETS,
    ConventionChoice,
    OutOption,
    ProjectionChoice,
    ScaleChoice,
    SensorChoice,
    SizeOption,
    choose_device,
    choose_reading,
)
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.checkpoints import Checkpoint
    from r2flow.data.sets import ScanSet
    from r2flow.data.sources import Reading
    from r2flow.evaluation.measuring import Work
    from r2flow.evaluation.processes import Place
    from r2flow.metrics.base import ScanMetric
    from r2flow.reports.speed_quality import Drawing

log = logging.getLogger(__name__)

EMBEDDED = "frechet_embedded"
DEFAULT = ("jsd", "mmd", EMBEDDED)
RealArgument = Annotated[str, typer.Argument(help=f"Real scans: {SETS}.", show_default=False)]
MetricsOption = Annotated[
    str | None,
    typer.Option(help="Names, separated by commas; jsd,mmd,frechet_embedded (or _range of it) if left out."),
]
WorkersOption = Annotated[int, typer.Option(min=0, help="Further processes that read scans.")]


@app.command(epilog="Example: r2flow evaluate kitti_360:/data/KITTI-360 runs/1rf --split test --num 1000 --json e.json")
def evaluate(
    real: RealArgument,
    generated: Annotated[
        str | None,
        typer.Argument(help="Scans to judge: the same, or a run or checkpoint to sample.", show_default=False),
    ] = None,
    metrics: MetricsOption = None,
    json: Annotated[Path | None, typer.Option("--json", help="File for every figure with its protocol.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for a page.", show_default=False)] = None,
    checkpoint: Annotated[
        list[Path] | None,
        typer.Option("--checkpoint", "-c", help="Flow for a speed-quality curve; may be given several times."),
    ] = None,
    steps: Annotated[
        str | None, typer.Option(help="Of the sampled flow, 32 or k of a k-TD if left out; of a curve, 1,2,4,...,256.")
    ] = None,
    solver: Annotated[str | None, typer.Option(help="Of the sampled flow: euler, heun2, rk4, dopri5, ...")] = None,
    tolerance: Annotated[float | None, typer.Option(help="Of an adaptive solver.")] = None,
    num: Annotated[
        int | None, typer.Option(min=1, help="Scans to sample or simulate (1000); the most to take of a folder (all).")
    ] = None,
    real_num: Annotated[
        int | None, typer.Option(min=1, help="The most real scans to take, by a fixed shuffle.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of sampled scans.")] = 0,
    split: Annotated[str | None, typer.Option("--split", "--real-split", help="Part of REAL's standard split.")] = None,
    generated_split: Annotated[
        str | None, typer.Option(help="Part of GENERATED's, where it is a LAYOUT:FOLDER.")
    ] = None,
    floor: Annotated[
        bool, typer.Option("--floor", help="Real against real beside it: halves, and two drives.")
    ] = False,
    bootstrap: Annotated[int, typer.Option(min=0, help="Resamples for 95 % intervals; 0 for none.")] = 0,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    projection: ProjectionChoice = None,
    convention: ConventionChoice = None,
    reflectance_scale: ScaleChoice = None,
    generated_scale: Annotated[
        float | None, typer.Option(min=1e-6, help="The same of GENERATED's files, if other.")
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 8,
    workers: WorkersOption = 2,
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Gather the real scans' statistics anew.")] = False,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")] = "auto",
) -> None:
    """Measure generated scans against real ones: distances, each with the protocol that it holds under.

    With --checkpoint it measures how the distance falls with the number of steps, against evaluations and seconds;
    points that are in --out already are not measured again. Under torchrun the processes share the scans.
    """
    from r2flow.evaluation.measuring import check_reflectance
    from r2flow.evaluation.processes import joined
    from r2flow.evaluation.sets import sampled_set
    from r2flow.reports.speed_quality import Drawing

    if checkpoint and generated is not None:
        raise InputError("give GENERATED for one comparison or --checkpoint for a curve, not both.")
    if checkpoint and out is None:
        raise InputError("a curve needs --out FOLDER, where its points are kept.")
    if generated is None and not checkpoint and not floor:
        raise InputError("nothing to compare with: give GENERATED, --checkpoint RUN or --floor.")
    if checkpoint and (floor or bootstrap or json):
        raise InputError("--floor, --bootstrap and --json belong to one comparison; a curve writes its page to --out.")
    if json is not None and json.is_dir():
        raise InputError(f"--json {json} is a folder; name a file to write to.")
    with joined(choose_device(device)) as place:
        built = _build(metrics.split(","), bootstrap, place) if metrics else None
        flows = _load_flows(
            [*(checkpoint or []), *([Path(generated)] if generated and _is_flow(generated) else [])], place.device
        )
        judged_scans = None if _is_flow(generated) else generated
        reading = reading_of(
            [real, judged_scans], list(flows.values()), sensor, size, projection, convention, reflectance_scale
        )
        if built is not None:  # a scale of reflectance is nobody's business where no metric looks at it
            looks = any(m.needs_reflectance or m.uses_reflectance for m in built.values())
            reading = replace(reading, reflectance=reading.reflectance if looks else False)
        truth = _open(real, reading, split, real_num)
        judged: ScanSet | None = None
        if _is_flow(generated):
            (label, flow), *_ = flows.items()
            sampler = flow.generator.sampler.changed(steps=_one(steps), method=solver, tolerance=tolerance)
            judged = sampled_set(flow, label, num or 1000, sampler, seed)
        elif generated is not None:
            judged = _open(generated, _rescaled(generated, reading, generated_scale), generated_split, num)
        sets = [truth, *([judged] if judged else [])]
        with_reflectance = all(s.about["reflectance"] for s in sets) and all(
            flow.encoding.reflectance for flow in flows.values()
        )
        if built is None:
            built = _build_default(with_reflectance, bootstrap, place)
        check_reflectance(built, sets)
        work = work_of(batch_size, workers, place.rank, place.ranks)
        if checkpoint:
            assert out is not None
            drawing = Drawing(num or 1000, seed, solver, tolerance)
            _curve(truth, flows, built, _many(steps), drawing, work, no_cache, out, place.device)
        else:
            _compare(truth, judged, built, floor, bootstrap, work, no_cache, json, out, place.device, seed)


def _compare(
    truth: "ScanSet",
    judged: "ScanSet | None",
    metrics: "dict[str, ScanMetric]",
    floor: bool,
    bootstrap: int,
    work: "Work",
    no_cache: bool,
    json: Path | None,
    out: Path | None,
    device: str,
    seed: int,
) -> None:
    from r2flow.cli.output import command
    from r2flow.evaluation.floor import floor_sets
    from r2flow.evaluation.measuring import Gathered, gather_real, measure
    from r2flow.evaluation.statistics import Cache
    from r2flow.reports.evaluation import Comparison, evaluation_page, print_comparisons, write_json
    from r2flow.reports.pages import prepare_folder, write_page

    pairs = {} if judged is None else {"generated": (truth, judged)}
    if floor:
        pairs |= floor_sets(truth, judged)
    for folder in (out, json.parent if json else None):
        if folder is not None:
            prepare_folder(folder)
    cache = None if no_cache else Cache()
    found: list[Comparison] = []
    known: dict[int, Gathered] = {}
    for name, (real, other) in pairs.items():
        start = time.monotonic()
        if id(real) not in known:
            known[id(real)] = gather_real(metrics, real, work, cache)
        measured = measure(metrics, known[id(real)], other, work, bootstrap)
        found.append(Comparison(name, real, other, measured, time.monotonic() - start))
    if work.rank > 0:
        return
    seeds = {"subsets": 0}
    if judged is not None and judged.about["kind"] == "sampled":
        seeds["sampled scans"] = seed
    if bootstrap:
        seeds["bootstrap"] = 0
    page = evaluation_page(found, command(), device, seeds)
    print_comparisons(found)
    if json is not None:
        write_json(page, found, json)
        print(json)
    if out is not None:
        for path in write_page(page, out):
            print(path)


def _curve(
    truth: "ScanSet",
    flows: "dict[str, Checkpoint]",
    metrics: "dict[str, ScanMetric]",
    steps: Sequence[int],
    drawing: "Drawing",
    work: "Work",
    no_cache: bool,
    out: Path,
    device: str,
) -> None:
    from r2flow.cli.output import command, finish
    from r2flow.evaluation.measuring import gather_real
    from r2flow.evaluation.statistics import Cache
    from r2flow.reports.pages import prepare_folder, write_page
    from r2flow.reports.speed_quality import Curve, measure_curve, read_rows, speed_quality_page

    prepare_folder(out)
    done = read_rows(out)
    gathered = gather_real(metrics, truth, work, None if no_cache else Cache())
    curve = Curve(truth, metrics, gathered, drawing, device)

    def keep(rows: list[dict[str, Any]]) -> None:
        if work.rank == 0:
            write_page(speed_quality_page(curve, rows, command(), done, figures=False), out)

    rows = measure_curve(curve, flows, steps, work, done, keep)
    if work.rank == 0:
        finish(speed_quality_page(curve, rows, command(), done), out)


@report.command(
    epilog="Example: r2flow report neighbours runs/1rf/samples prepared/train --real prepared/test --out sheet"
)
def neighbours(
    generated: Annotated[str, typer.Argument(help=f"Scans to judge: {SETS}.", show_default=False)],
    train: Annotated[str, typer.Argument(help="The scans that were learned from: likewise.", show_default=False)],
    out: OutOption,
    real: Annotated[str | None, typer.Option(help="Real scans that were held out: how near is usual.")] = None,
    by: Annotated[
        str | None, typer.Option(help="embedded (features) or pixels (log-range); embedded where it is.")
    ] = None,
    pairs: Annotated[int, typer.Option(min=1, help="Nearest pairs to draw, and half as many of the farthest.")] = 4,
    num: Annotated[int, typer.Option(min=1, help="The most generated and held-out scans, by a fixed shuffle.")] = 1000,
    split: Annotated[str | None, typer.Option("--split", help="Part of TRAIN's standard split.")] = None,
    real_split: Annotated[str | None, typer.Option(help="Part of REAL's.")] = None,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    projection: ProjectionChoice = None,
    convention: ConventionChoice = None,
    reflectance_scale: ScaleChoice = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 8,
    workers: WorkersOption = 2,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")] = "auto",
) -> None:
    """Generated scans beside their nearest training scans, the most suspicious first: memorising is seen."""
    from r2flow.cli.output import command, finish
    from r2flow.reports.neighbours import find_neighbours, likeness_of, neighbours_page
    from r2flow.reports.pages import prepare_folder

    where = choose_device(device)
    reading = reading_of([train, generated, real], [], sensor, size, projection, convention, reflectance_scale)
    reading = replace(reading, reflectance=False) if by == "pixels" else reading
    trained = _open(train, reading, split, None)
    judged = _open(generated, reading, None, num)
    held = None if real is None else _open(real, reading, real_split, num)
    likeness = likeness_of(by, [s for s in (trained, judged, held) if s is not None], where)
    prepare_folder(out)
    work = work_of(batch_size, workers)
    found = find_neighbours(judged, trained, held, likeness, work)
    finish(neighbours_page(found, pairs, command(), where), out)


def work_of(batch_size: int, workers: int, rank: int = 0, ranks: int = 1) -> "Work":
    """How the work is done, its bars on standard error where somebody watches."""
    from r2flow.evaluation.measuring import Work

    return Work(batch_size, workers, rank, ranks, watched=rank == 0 and sys.stderr.isatty())


def _is_flow(text: str | None) -> bool:
    from r2flow.evaluation.sets import is_checkpoint

    return text is not None and is_checkpoint(text)


def _load_flows(paths: list[Path], device: str) -> "dict[str, Checkpoint]":
    from r2flow.checkpoints import load_checkpoint

    flows = {str(path): load_checkpoint(path, device) for path in dict.fromkeys(paths)}
    sensors = {(flow.sensor.shape, flow.sensor.elevations) for flow in flows.values()}
    if len(sensors) > 1:
        raise InputError(f"{', '.join(flows)} look through different sensors or sizes; measure each by itself.")
    return flows


def reading_of(
    specs: "Sequence[str | None]",
    flows: "Sequence[Checkpoint]" = (),
    sensor: str | None = None,
    size: str | None = None,
    projection: str | None = None,
    convention: str | None = None,
    reflectance_scale: float | None = None,
) -> "Reading":
    """How scans become images: as asked for, else as the flow's or one of the named sets' were, else the usual way."""
    from r2flow.evaluation.sets import reading_of_flow

    flow = reading_of_flow(flows[0]) if flows else None
    return choose_reading(specs, sensor, size, projection, convention, reflectance_scale, flow)


def _rescaled(generated: str, reading: "Reading", scale: float | None) -> "Reading":
    """The reading with the scale of reflectance that was asked for, else the generated scans' own."""
    from r2flow.data.opening import own_reading

    own = own_reading(generated)
    if scale is None:
        scale = reading.reflectance_scale if own is None else own.reflectance_scale
    return replace(reading, reflectance_scale=scale)


def _open(text: str, reading: "Reading", split: str | None, num: int | None) -> "ScanSet":
    from r2flow.data.opening import open_scans

    scans = open_scans(text, reading, split, num)
    if len(scans):
        _ = scans.source[0]  # what does not fit is better known now than after the other set was read
    return scans


def _build(names: Sequence[str], bootstrap: int, place: "Place") -> "dict[str, ScanMetric]":
    from r2flow.metrics import METRICS

    options = {"keep": bootstrap > 0, "folder": place.folder}
    return {name: METRICS[name](**options).to(place.device) for name in dict.fromkeys(names)}


def _build_default(reflectance: bool, bootstrap: int, place: "Place") -> "dict[str, ScanMetric]":
    """The default metrics; a warning says which of them cannot be computed here."""
    built: dict[str, ScanMetric] = {}
    for name in DEFAULT:
        try:
            built |= _build([name if reflectance or name != EMBEDDED else f"{EMBEDDED}_range"], bootstrap, place)
        except InputError as error:
            log.warning("%s is left out: %s", name, error)
    return built


def _one(steps: str | None) -> int | None:
    found = [None] if steps is None else _many(steps)
    if len(found) != 1:
        raise InputError(f"one comparison takes one number of --steps, found {steps}; --checkpoint makes a curve.")
    return found[0]


def _many(steps: str | None) -> list[int]:
    from r2flow.cli.output import numbers

    return numbers("steps", steps or "1,2,4,8,16,32,64,128,256", int)
