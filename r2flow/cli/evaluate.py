"""`r2flow evaluate`: generated scans against real ones."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, SamplerOptions, WorkOptions, grouped
from r2flow.cli.options import SETS, PrecisionOption, choose_device
from r2flow.cli.output import command, finish, numbers
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.data.sets import ScanSet
    from r2flow.evaluation.measuring import Gathered, Work
    from r2flow.metrics.base import ScanMetric
    from r2flow.model.checkpoint import Checkpoint
    from r2flow.reports.speed_quality import Drawing

log = logging.getLogger(__name__)

SAMPLED = 1000  # scans of a flow
STEPS = "1,2,4,8,16,32,64,128,256"  # of a curve
REAL = "the real scans"
SAMPLING = ("steps", "sampler", "tolerance", "precision", "seed")  # options of a sampled flow


@dataclass(frozen=True)
class EvaluateOptions:
    """What is measured, on which scans, and where the figures are written."""

    metrics: Annotated[
        str | None,
        typer.Option(
            help="Names, separated by commas; KID and Frechet of hand-made features, the panel, JSD, MMD if left out; "
            "all: whatever can be computed here."
        ),
    ] = None
    protocol: Annotated[
        str, typer.Option(help="r2flow, or paper: measured points of real scans against generated ones' bin corners.")
    ] = "r2flow"
    reference: Annotated[
        bool | None,
        typer.Option("--reference/--no-reference", help="Real against real: halves, two drives.", show_default="on"),
    ] = None
    baselines: Annotated[
        bool | None,
        typer.Option(
            "--baselines/--no-baselines", help="Noise, flat ground, mean scan, shuffled pixels.", show_default="on"
        ),
    ] = None
    train: Annotated[
        str | None, typer.Option(help=f"Training scans: adds distances to the nearest, to find copies: {SETS}.")
    ] = None
    train_split: Annotated[str | None, typer.Option(help="Part of TRAIN's standard split.")] = None
    bootstrap: Annotated[int, typer.Option(min=0, help="Resamples for 95 % intervals; 0 for none.")] = 0
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Read the real scans again.")] = False
    curve: Annotated[
        bool, typer.Option("--curve", help="Distance of models against evaluations and seconds, into --out.")
    ] = False
    num: Annotated[
        int | None, typer.Option(min=1, help="Scans to sample or simulate (1000); the most to take of a folder (all).")
    ] = None
    real_num: Annotated[int | None, typer.Option(min=1, help="The most real scans to take, by a fixed shuffle.")] = None
    split: Annotated[str | None, typer.Option(help="Part of REAL's standard split.")] = None
    generated_split: Annotated[str | None, typer.Option(help="Part of GENERATED's, for a LAYOUT:FOLDER.")] = None
    generated_scale: Annotated[
        float | None, typer.Option(min=1e-6, max=1e9, help="--reflectance-scale of the files in GENERATED, if other.")
    ] = None
    steps: Annotated[
        str | None, typer.Option(help="Of the sampled flow, its own if left out; of a curve, 1,2,4,...,256.")
    ] = None
    sampler: Annotated[
        str | None,
        typer.Option(help="Of the sampled flow: euler, heun2, dopri5, ...; of a curve, several as ddpm,adams3."),
    ] = None
    tolerance: Annotated[float | None, typer.Option(help="Of an adaptive sampler.")] = None
    precision: PrecisionOption = "32-true"
    seed: Annotated[int, typer.Option(min=0, help="Of sampled scans.")] = 0
    json: Annotated[Path | None, typer.Option("--json", help="File for every figure with its protocol.")] = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for a page.", show_default=False)] = None


@app.command(
    epilog="Example: r2flow evaluate kitti_360:/data/KITTI-360 runs/1rf runs/2rf others/ --split test --json e.json"
)
@grouped
def evaluate(
    real: Annotated[str, typer.Argument(help=f"Real scans: {SETS}.", show_default=False)],
    options: EvaluateOptions,
    how: ReadingOptions,
    work: WorkOptions,
    generated: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scans to judge, one or several sets: the same, or a run, checkpoint or model to sample.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Measure generated scans against real ones: distances, each with its protocol and the sensor.

    Several sets make one table, next to reference distances between real scans and to baselines. With --curve it
    measures how the distance of models falls with the number of steps, against evaluations and seconds; points that are
    in --out already are not measured again. Under torchrun the processes share the scans.
    """
    from r2flow.evaluation.measuring import Work, check_reflectance, gather_real
    from r2flow.evaluation.processes import joined
    from r2flow.evaluation.protocols import PROTOCOLS
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.evaluation.statistics import Cache
    from r2flow.metrics import METRICS, default_metrics
    from r2flow.reports.pages import prepare_folder

    named, curve = list(dict.fromkeys(generated or [])), options.curve
    sampled = [one for one in named if is_checkpoint(one)]
    rules = PROTOCOLS[options.protocol]
    _check_options(named, sampled, options)
    if not sampled and any(getattr(options, key) != getattr(EvaluateOptions, key) for key in SAMPLING):
        raise InputError(f"--{', --'.join(SAMPLING)} are of a run, a checkpoint or a model to sample; found none.")
    if len(named) == len(sampled) and (options.generated_split or options.generated_scale):
        raise InputError("--generated-split and --generated-scale are of files in GENERATED; found none.")
    with joined(choose_device(work.device)) as place:
        keep = options.bootstrap > 0
        wanted = None
        if options.metrics not in (None, "all"):
            wanted = _build(options.metrics.split(","), keep, place.device)
        flows = _load_flows(sampled, place.device)
        if flows and options.num is None and place.rank == 0:
            each = "each point" if curve else "each" if len(flows) > 1 else "it"
            print(f"{', '.join(flows)}: {SAMPLED} scans of {each} are drawn (--num says how many)")
        files = [one for one in named if one not in sampled]
        reading = how.reading([real, *files, options.train], next(iter(flows.values()), None))
        if rules.convention is not None and how.convention is None:
            reading = replace(reading, convention=rules.convention)
        if wanted and not any(m.needs_reflectance or m.uses_reflectance for m in wanted.values()):
            reading = replace(reading, reflectance=False)  # its scale does not matter
        truth = _open(real, reading, options.split, options.real_num)
        rules.check(truth)
        scaled = replace(reading, reflectance_scale=options.generated_scale or reading.reflectance_scale)
        judged = (
            {}
            if curve
            else {
                name: _sampled(text, flows[text], options)
                if text in sampled
                else _open(text, scaled, options.generated_split, options.num)
                for text, name in zip(named, _names(named), strict=True)
            }
        )
        sets = [truth, *judged.values()]
        reflectance = all(s.about["reflectance"] for s in sets)
        reflectance = reflectance and all(flow.encoding.reflectance for flow in flows.values())
        usual = [*METRICS] if options.metrics == "all" else default_metrics(reflectance)
        metrics = wanted or _build_possible(usual, reflectance, keep, place.device)
        check_reflectance(metrics, sets)
        training = None if options.train is None else _open(options.train, reading, options.train_split, None)
        drawings, steps = _curve_of(flows, options) if curve else ([], [])
        for folder in (options.out, options.json.parent if options.json else None):
            if folder is not None:
                prepare_folder(folder)
        share = Work(work.batch_size, work.workers, place.rank, place.ranks, watched=place.rank == 0)
        cache = None if options.no_cache else Cache()

        def gather(scans: "ScanSet") -> "Gathered":
            return gather_real(metrics, scans, share, cache, rules)

        if curve:
            _measure_curve(truth, metrics, gather, share, place.device, flows, drawings, steps, options)
        else:
            _compare(truth, metrics, gather, share, place.device, judged, training, options)


def _check_options(generated: Sequence[str], sampled: Sequence[str], options: EvaluateOptions) -> None:
    """Refuse options that do not go together, before anything is read."""
    curve, scans = options.curve, [one for one in generated if one not in sampled]
    if curve and (scans or not sampled):
        raise InputError(f"--curve is of runs, checkpoints or models to sample, found {scans[0] if scans else 'none'}.")
    if curve and options.out is None:
        raise InputError("a curve needs --out FOLDER, where its points are kept.")
    if curve and (options.reference or options.baselines or options.train or options.json):
        raise InputError("--reference, --baselines, --train and --json are of a comparison; a curve writes to --out.")
    if not (generated or options.reference or options.baselines):
        raise InputError("nothing to compare with: give GENERATED or --reference.")
    if options.json is not None and (options.json.is_dir() or options.json.suffix.lower() != ".json"):
        raise InputError(f"--json must be a file that ends in .json, found {options.json}.")


def _names(generated: Sequence[str]) -> list[str]:
    """What each judged set is called: `generated` where it is the only one, else the shortest end of its name."""
    if len(generated) < 2:
        return ["generated"] * len(generated)
    from r2flow.reports.compare import labels

    return labels([Path(text) for text in generated])


def _compare(
    truth: "ScanSet",
    metrics: "Mapping[str, ScanMetric]",
    gather: "Callable[[ScanSet], Gathered]",
    work: "Work",
    device: str,
    judged: "dict[str, ScanSet]",
    training: "ScanSet | None",
    options: EvaluateOptions,
) -> None:
    from r2flow.evaluation.copies import Nearest, copies_result, find_nearest
    from r2flow.evaluation.measuring import measure
    from r2flow.evaluation.references import baseline_sets, reference_sets
    from r2flow.reports.evaluation import Comparison, Kind, evaluation_page, print_comparisons, write_json
    from r2flow.reports.pages import write_page
    from r2flow.reports.view.panels import write_sets

    kinds: dict[Kind, dict[str, tuple[ScanSet, ScanSet]]]
    kinds = {"judged": {name: (truth, one) for name, one in judged.items()}}
    usual = bool(judged)
    if options.reference or (usual and options.reference is None and len(truth) > 1):
        kinds["reference"] = reference_sets(truth, judged)
    if options.baselines or (usual and options.baselines is None):
        num = max((len(one) for one in judged.values()), default=len(truth))
        kinds["baseline"] = {name: (truth, one) for name, one in baseline_sets(truth, min(num, SAMPLED)).items()}
    comparisons: list[Comparison] = []
    statistics: dict[int, Gathered] = {}
    for kind, (name, (real, other)) in ((kind, pair) for kind, pairs in kinds.items() for pair in pairs.items()):
        start = time.monotonic()
        if id(real) not in statistics:
            statistics[id(real)] = gather(real)
        draws = 0 if kind == "baseline" else options.bootstrap
        results = measure(metrics, statistics[id(real)], other, work, draws)
        comparisons.append(Comparison(name, real, other, results, time.monotonic() - start, kind))
    if work.rank > 0:
        return
    nearest: dict[str, Nearest] = {}
    if training is not None:
        nearest = find_nearest({**judged, REAL: truth}, training, replace(work, ranks=1), device)
        of = {("judged", name): nearest[name] for name in judged} | {("reference", "real halves"): nearest[REAL]}
        for place, one in enumerate(comparisons):
            if (at := of.get((one.kind, one.name))) is not None:
                result = copies_result(at, nearest[REAL], len(training))
                comparisons[place] = replace(one, measured=[*one.measured, result])
    seeds: dict[str, int] = {}
    if any(one.about["kind"] == "sampled" for one in judged.values()):
        seeds["sampled scans"] = options.seed
    if options.bootstrap:
        seeds["bootstrap"] = 0
    drawn = {name: one for name, one in nearest.items() if name in judged}
    page = evaluation_page(comparisons, command(), device, seeds, drawn, training)
    print_comparisons(comparisons)
    if options.json is not None:
        write_json(page, options.json)
        print(options.json)
    if options.out is not None:
        for path in write_page(page, options.out):
            print(path)
        sets = {"real": truth} | {"real, judged" if name == "real" else name: one for name, one in judged.items()}
        print(write_sets(options.out / "evaluation.html", sets, title="Generated and real scans"))


def _curve_of(flows: "Mapping[str, Checkpoint]", options: EvaluateOptions) -> "tuple[list[Drawing], list[int]]":
    """The samplers of a curve and its numbers of steps, checked before anything is read."""
    from r2flow.registry import options_of
    from r2flow.reports.speed_quality import Drawing, steps_of
    from r2flow.samplers import SAMPLERS, parse_sampler

    names = [*dict.fromkeys(options.sampler.split(","))] if options.sampler else []
    ways = [parse_sampler(name) for name in names] or [{}]
    taken = [options_of(SAMPLERS[way["name"]]) for way in ways if way]
    if taken and options.steps and not any("steps" in fields for fields in taken):
        raise InputError(f"{', '.join(names)}: no option 'steps'; leave --steps out.")
    if options.tolerance is not None:  # of the samplers that have one
        for way in [way for way, fields in zip(ways, taken, strict=False) if "tolerance" in fields] or ways:
            way["tolerance"] = options.tolerance
    drawings = [Drawing(options.num or SAMPLED, options.seed, way, options.precision) for way in ways]
    steps = numbers("steps", options.steps or STEPS, int)
    for (label, flow), drawing in product(flows.items(), drawings):
        steps_of(flow, label, steps, drawing)
    return drawings, steps


def _measure_curve(
    truth: "ScanSet",
    metrics: "Mapping[str, ScanMetric]",
    gather: "Callable[[ScanSet], Gathered]",
    work: "Work",
    device: str,
    flows: "Mapping[str, Checkpoint]",
    drawings: "Sequence[Drawing]",
    steps: Sequence[int],
    options: EvaluateOptions,
) -> None:
    from r2flow.reports.pages import write_page
    from r2flow.reports.speed_quality import Curve, measure_curve, read_rows, speed_quality_page

    assert options.out is not None
    out, done = options.out, read_rows(options.out)
    curve = Curve(truth, metrics, gather(truth), drawings, device, options.bootstrap)

    def keep(rows: list[dict[str, Any]]) -> None:
        if work.rank == 0:
            write_page(speed_quality_page(curve, rows, command(), done, figures=False), out)

    rows = measure_curve(curve, flows, steps, work, done, keep)
    if work.rank == 0:
        page = speed_quality_page(curve, rows, command(), done)
        finish(page, out, page.text)


def _load_flows(names: Sequence[str], device: str) -> "dict[str, Checkpoint]":
    from r2flow.model.checkpoint import load_checkpoint

    flows = {name: load_checkpoint(name, device) for name in dict.fromkeys(names)}
    sensors = {(flow.sensor.shape, flow.sensor.elevations) for flow in flows.values()}
    if len(sensors) > 1:
        raise InputError(f"{', '.join(flows)} have different sensors or image sizes; measure each by itself.")
    return flows


def _open(text: str, reading: "Reading", split: str | None, num: int | None) -> "ScanSet":
    from r2flow.data.opening import open_scans, refuse_parts

    scans = open_scans(text, reading, split, num)
    refuse_parts(text)
    if len(scans):
        _ = scans.source[0]  # what does not fit is better known now than after the other set was read
    return scans


def _sampled(label: str, flow: "Checkpoint", options: EvaluateOptions) -> "ScanSet":
    """Scans of a flow that is judged."""
    from r2flow.evaluation.sets import sampled_set

    steps = numbers("steps", options.steps, int) if options.steps else [None]
    if len(steps) != 1:
        raise InputError(f"a comparison takes one number of --steps, found {options.steps}; --curve takes several.")
    sampler = flow.generator.choose(**SamplerOptions(options.sampler, steps[0], options.tolerance).given)
    return sampled_set(flow, label, options.num or SAMPLED, sampler, options.seed, options.precision)


def _build(names: Sequence[str], keep: bool, device: str) -> "dict[str, ScanMetric]":
    from r2flow.metrics import METRICS

    return {name: METRICS[name](keep=keep).to(device) for name in dict.fromkeys(names)}


def _build_possible(names: Sequence[str], reflectance: bool, keep: bool, device: str) -> "dict[str, ScanMetric]":
    """The metrics that can be computed here; a warning names the others."""
    built: dict[str, ScanMetric] = {}
    left_out: dict[str, list[str]] = {}
    for name in names:
        try:
            metric = _build([name], keep, device)[name]
        except InputError:
            left_out.setdefault("their weights are not here (r2flow weights)", []).append(name)
            continue
        if metric.needs_reflectance and not reflectance:
            left_out.setdefault("a set has no reflectance", []).append(name)
        else:
            built[name] = metric
    for why, those in left_out.items():
        log.warning("%s left out: %s", ", ".join(those), why)
    return built
