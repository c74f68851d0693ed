"""`r2flow evaluate`: generated scans against real ones."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, SamplerOptions, WorkOptions, grouped
from r2flow.cli.options import SETS, PrecisionOption, choose_device, choose_reading
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.data.sets import ScanSet
    from r2flow.evaluation.measuring import Work
    from r2flow.evaluation.processes import Process
    from r2flow.evaluation.protocols import Rules
    from r2flow.evaluation.statistics import Cache
    from r2flow.metrics.base import ScanMetric
    from r2flow.model.checkpoint import Checkpoint
    from r2flow.reports.speed_quality import Drawing

log = logging.getLogger(__name__)

ALL = "all"
SAMPLED = 1000  # scans of a flow
REAL = "the real scans"


@dataclass(frozen=True)
class MeasureOptions:
    """What is measured."""

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


@dataclass(frozen=True)
class SetOptions:
    """Which scans of the two sets are compared."""

    num: Annotated[
        int | None, typer.Option(min=1, help="Scans to sample or simulate (1000); the most to take of a folder (all).")
    ] = None
    real_num: Annotated[int | None, typer.Option(min=1, help="The most real scans to take, by a fixed shuffle.")] = None
    split: Annotated[str | None, typer.Option("--split", "--real-split", help="Part of REAL's standard split.")] = None
    generated_split: Annotated[str | None, typer.Option(help="Part of GENERATED's, where it is a LAYOUT:FOLDER.")] = (
        None
    )
    generated_scale: Annotated[
        float | None, typer.Option(min=1e-6, max=1e9, help="--reflectance-scale of the files in GENERATED, if other.")
    ] = None


@dataclass(frozen=True)
class SamplingOptions:
    """How scans are sampled from a flow."""

    steps: Annotated[
        str | None, typer.Option(help="Of the sampled flow, its own if left out; of a curve, 1,2,4,...,256.")
    ] = None
    sampler: Annotated[
        str | None,
        typer.Option(help="Of the sampled flow: euler, heun2, dopri5, ...; of a curve, several as ddpm,adams3."),
    ] = None
    tolerance: Annotated[float | None, typer.Option(help="Of an adaptive sampler.")] = None
    precision: PrecisionOption = None
    seed: Annotated[int, typer.Option(min=0, help="Of sampled scans.")] = 0


@dataclass(frozen=True)
class OutputOptions:
    """Where figures are written to."""

    json: Annotated[Path | None, typer.Option("--json", help="File for every figure with its protocol.")] = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for a page.", show_default=False)] = None


@app.command(
    epilog="Example: r2flow evaluate kitti_360:/data/KITTI-360 runs/1rf runs/2rf others/ --split test --json e.json"
)
@grouped
def evaluate(
    real: Annotated[str, typer.Argument(help=f"Real scans: {SETS}.", show_default=False)],
    measured: MeasureOptions,
    output: OutputOptions,
    scans: SetOptions,
    sampling: SamplingOptions,
    how: ReadingOptions,
    work: WorkOptions,
    generated: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scans to judge, one or several sets: the same, or a run, checkpoint or model to sample.",
            show_default=False,
        ),
    ] = None,
    checkpoint: Annotated[
        list[Path] | None,
        typer.Option("--checkpoint", "-c", help="Flow for a speed-quality curve; may be given several times."),
    ] = None,
) -> None:
    """Measure generated scans against real ones: distances, each with its protocol and the sensor.

    Several sets make one table, next to reference distances between real scans and to baselines. With --checkpoint it
    measures how the distance falls with the number of steps, against evaluations and seconds; points that are in --out
    already are not measured again. Under torchrun the processes share the scans.
    """
    from r2flow.evaluation.measuring import Work, check_reflectance
    from r2flow.evaluation.processes import joined
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.evaluation.statistics import Cache
    from r2flow.metrics import METRICS, default_metrics
    from r2flow.reports.pages import prepare_folder

    named = list(dict.fromkeys(generated or []))
    sampled = [one for one in named if is_checkpoint(one)]
    rules = _check_evaluation(named, checkpoint, measured, output)
    _check_used(len(named) > len(sampled), bool(sampled or checkpoint), scans, sampling)
    with joined(choose_device(work.device)) as place:
        wanted = (
            None if measured.metrics in (None, ALL) else _build(measured.metrics.split(","), measured.bootstrap, place)
        )
        flows = _load_flows([*(checkpoint or []), *map(Path, sampled)], place.device)
        if flows and scans.num is None and place.rank == 0:
            each = "each point" if checkpoint else "each" if len(flows) > 1 else "it"
            print(f"{', '.join(flows)}: {SAMPLED} scans of {each} are drawn (--num says how many)")
        files = [one for one in named if one not in sampled]
        flow = next(iter(flows.values()), None)
        reading = choose_reading([real, *files, measured.train], **vars(how), model=flow)
        if rules.convention is not None and how.convention is None:
            reading = replace(reading, convention=rules.convention)
        if wanted is not None:  # where no metric reads reflectance, its scale does not matter
            looks = any(m.needs_reflectance or m.uses_reflectance for m in wanted.values())
            reading = replace(reading, reflectance=reading.reflectance if looks else False)
        truth = _open(real, reading, scans.split, scans.real_num)
        rules.check(truth)
        judged: dict[str, ScanSet] = {}
        for text, name in zip(named, _names(named), strict=True):
            if text in sampled:
                judged[name] = _sampled(text, flows[text], scans.num or SAMPLED, sampling)
            else:
                scale = scans.generated_scale or reading.reflectance_scale
                judged[name] = _open(text, replace(reading, reflectance_scale=scale), scans.generated_split, scans.num)
        sets = [truth, *judged.values()]
        reflectance = all(s.about["reflectance"] for s in sets)
        reflectance = reflectance and all(flow.encoding.reflectance for flow in flows.values())
        names = METRICS if measured.metrics == ALL else default_metrics(reflectance)
        built = wanted or _build_possible([*names], reflectance, measured.bootstrap, place)
        check_reflectance(built, sets)
        job = Job(
            truth, built, Work(work.batch_size, work.workers, place.rank, place.ranks, watched=place.rank == 0),
            None if measured.no_cache else Cache(), place.device, sampling, rules,
        )  # fmt: skip
        training = None if measured.train is None else _open(measured.train, reading, measured.train_split, None)
        drawings, steps = _curve_of(flows, scans.num or SAMPLED, sampling) if checkpoint else ([], [])
        for folder in (output.out, output.json.parent if output.json else None):
            if folder is not None:
                prepare_folder(folder)
        if drawings and output.out:
            _measure_curve(job, flows, drawings, steps, measured.bootstrap, output.out)
        else:
            _compare(job, judged, training, measured, output)


@dataclass(frozen=True)
class Job:
    """What a comparison and a curve both need: real scans, metrics, and how the work is done."""

    truth: "ScanSet"
    metrics: "dict[str, ScanMetric]"
    work: "Work"
    cache: "Cache | None"
    device: str
    sampling: SamplingOptions
    rules: "Rules"


def _check_evaluation(
    generated: list[str], checkpoint: list[Path] | None, measured: MeasureOptions, output: OutputOptions
) -> "Rules":
    """The protocol; options that do not go together are refused before anything is read."""
    from r2flow.evaluation.protocols import PROTOCOLS

    rules = PROTOCOLS[measured.protocol]
    if checkpoint and generated:
        raise InputError("give GENERATED for one comparison or --checkpoint for a curve, not both.")
    if checkpoint and output.out is None:
        raise InputError("a curve needs --out FOLDER, where its points are kept.")
    if not generated and not checkpoint and not (measured.reference or measured.baselines):
        raise InputError("nothing to compare with: give GENERATED, --checkpoint RUN or --reference.")
    if checkpoint and (measured.reference or measured.baselines or measured.train or output.json):
        raise InputError("--reference, --baselines, --train and --json are of a comparison; a curve writes to --out.")
    if output.json is not None and output.json.is_dir():
        raise InputError(f"--json {output.json} is a folder; name a file to write to.")
    if output.json is not None and output.json.suffix.lower() != ".json":
        raise InputError(f"--json must be a file that ends in .json, found {output.json}.")
    return rules


def _check_used(files: bool, flows: bool, scans: SetOptions, sampling: SamplingOptions) -> None:
    """Refuse options of generated files, or of flows, where there are none."""
    if not flows and sampling != SamplingOptions():
        raise InputError(
            "--steps, --sampler, --tolerance, --precision and --seed are of a run, a checkpoint or a model to sample; "
            "found none."
        )
    if not files and (scans.generated_split is not None or scans.generated_scale is not None):
        raise InputError("--generated-split and --generated-scale are of files in GENERATED; found none.")


def _names(generated: Sequence[str]) -> list[str]:
    """What each judged set is called: `generated` where it is the only one, else the shortest end of its name."""
    if len(generated) < 2:
        return ["generated"] * len(generated)
    from r2flow.reports.compare import labels

    return labels([Path(text) for text in generated])


def _compare(
    job: Job, judged: "dict[str, ScanSet]", training: "ScanSet | None", measured: MeasureOptions, output: OutputOptions
) -> None:
    from r2flow.cli.output import command
    from r2flow.evaluation.copies import Nearest, copies_result, find_nearest
    from r2flow.evaluation.measuring import Gathered, gather_real, measure
    from r2flow.evaluation.references import baseline_sets, reference_sets
    from r2flow.reports.evaluation import Comparison, Kind, evaluation_page, print_comparisons, write_json
    from r2flow.reports.pages import write_page
    from r2flow.reports.view.panels import write_sets

    kinds: dict[Kind, dict[str, tuple[ScanSet, ScanSet]]]
    kinds = {"judged": {name: (job.truth, one) for name, one in judged.items()}}
    usual = bool(judged)
    if measured.reference or (usual and measured.reference is None and len(job.truth) > 1):
        kinds["reference"] = reference_sets(job.truth, judged)
    if measured.baselines or (usual and measured.baselines is None):
        num = max((len(one) for one in judged.values()), default=len(job.truth))
        baselines = baseline_sets(job.truth, min(num, SAMPLED))
        kinds["baseline"] = {name: (job.truth, one) for name, one in baselines.items()}
    comparisons: list[Comparison] = []
    statistics: dict[int, Gathered] = {}
    for kind, (name, (real, other)) in ((kind, pair) for kind, pairs in kinds.items() for pair in pairs.items()):
        start = time.monotonic()
        if id(real) not in statistics:
            statistics[id(real)] = gather_real(job.metrics, real, job.work, job.cache, job.rules)
        draws = 0 if kind == "baseline" else measured.bootstrap
        results = measure(job.metrics, statistics[id(real)], other, job.work, draws)
        comparisons.append(Comparison(name, real, other, results, time.monotonic() - start, kind))
    if job.work.rank > 0:
        return
    nearest: dict[str, Nearest] = {}
    if training is not None:
        alone = replace(job.work, ranks=1)
        nearest = find_nearest({**judged, REAL: job.truth}, training, alone, job.device)
        of = {("judged", name): nearest[name] for name in judged} | {("reference", "real halves"): nearest[REAL]}
        for place, one in enumerate(comparisons):
            if (at := of.get((one.kind, one.name))) is not None:
                result = copies_result(at, nearest[REAL], len(training))
                comparisons[place] = replace(one, measured=[*one.measured, result])
    seeds: dict[str, int] = {}
    if any(one.about["kind"] == "sampled" for one in judged.values()):
        seeds["sampled scans"] = job.sampling.seed
    if measured.bootstrap:
        seeds["bootstrap"] = 0
    drawn = {name: one for name, one in nearest.items() if name in judged}
    page = evaluation_page(comparisons, command(), job.device, seeds, drawn, training)
    print_comparisons(comparisons)
    if output.json is not None:
        write_json(page, output.json)
        print(output.json)
    if output.out is not None:
        for path in write_page(page, output.out):
            print(path)
        sets = {"real": job.truth} | {"real, judged" if name == "real" else name: one for name, one in judged.items()}
        print(write_sets(output.out / "evaluation.html", sets, title="Generated and real scans"))


def _curve_of(flows: "dict[str, Checkpoint]", num: int, sampling: SamplingOptions) -> "tuple[list[Drawing], list[int]]":
    """What is drawn for each line of a curve, and the numbers of steps; what they cannot be is refused before anything
    is read.
    """
    from r2flow.registry import options_of
    from r2flow.reports.speed_quality import Drawing, steps_of
    from r2flow.samplers import SAMPLERS, parse_sampler

    names = [*dict.fromkeys(sampling.sampler.split(","))] if sampling.sampler else []
    ways = [parse_sampler(name) for name in names] or [{}]
    taken = [options_of(SAMPLERS[way["name"]]) for way in ways if way]
    if taken and sampling.steps and not any("steps" in options for options in taken):
        raise InputError(f"{', '.join(names)}: no option 'steps'; leave --steps out.")
    if sampling.tolerance is not None:  # of the samplers that have one
        for way in [way for way, options in zip(ways, taken, strict=False) if "tolerance" in options] or ways:
            way["tolerance"] = sampling.tolerance
    drawings = [Drawing(num, sampling.seed, way, sampling.precision or "32-true") for way in ways]
    steps = _many(sampling.steps)
    for (label, flow), drawing in product(flows.items(), drawings):
        steps_of(flow, label, steps, drawing)
    return drawings, steps


def _measure_curve(
    job: Job, flows: "dict[str, Checkpoint]", drawings: "list[Drawing]", steps: Sequence[int], bootstrap: int, out: Path
) -> None:
    from r2flow.cli.output import command, finish
    from r2flow.evaluation.measuring import gather_real
    from r2flow.reports.pages import write_page
    from r2flow.reports.speed_quality import Curve, measure_curve, read_rows, speed_quality_page

    done = read_rows(out)
    gathered = gather_real(job.metrics, job.truth, job.work, job.cache, job.rules)
    curve = Curve(job.truth, job.metrics, gathered, drawings, job.device, bootstrap)

    def keep(rows: list[dict[str, Any]]) -> None:
        if job.work.rank == 0:
            write_page(speed_quality_page(curve, rows, command(), done, figures=False), out)

    rows = measure_curve(curve, flows, steps, job.work, done, keep)
    if job.work.rank == 0:
        page = speed_quality_page(curve, rows, command(), done)
        finish(page, out, page.text)


def _load_flows(paths: list[Path], device: str) -> "dict[str, Checkpoint]":
    from r2flow.model.checkpoint import load_checkpoint

    flows = {str(path): load_checkpoint(path, device) for path in dict.fromkeys(paths)}
    sensors = {(flow.sensor.shape, flow.sensor.elevations) for flow in flows.values()}
    if len(sensors) > 1:
        seen = (f"{name} {flow.sensor.name} {'x'.join(map(str, flow.sensor.shape))}" for name, flow in flows.items())
        raise InputError(f"flows of different sensors or sizes, {', '.join(seen)}: measure each by itself.")
    return flows


def _open(text: str, reading: "Reading", split: str | None, num: int | None) -> "ScanSet":
    from r2flow.data.opening import open_scans, refuse_parts

    scans = open_scans(text, reading, split, num)
    refuse_parts(text)
    if len(scans):
        _ = scans.source[0]  # what does not fit is better known now than after the other set was read
    return scans


def _sampled(label: str, flow: "Checkpoint", num: int, sampling: SamplingOptions) -> "ScanSet":
    """Scans of the one flow that is judged."""
    from r2flow.evaluation.sets import sampled_set

    steps = _many(sampling.steps) if sampling.steps else [None]
    if len(steps) != 1:
        raise InputError(
            f"one comparison takes one number of --steps, found {sampling.steps}; --checkpoint makes a curve."
        )
    how = flow.generator.choose(**SamplerOptions(sampling.sampler, steps[0], sampling.tolerance).given)
    return sampled_set(flow, label, num, how, sampling.seed, sampling.precision or "32-true")


def _build(names: Sequence[str], bootstrap: int, place: "Process") -> "dict[str, ScanMetric]":
    from r2flow.metrics import METRICS

    return {name: METRICS[name](keep=bootstrap > 0).to(place.device) for name in dict.fromkeys(names)}


def _build_possible(
    names: Sequence[str], reflectance: bool, bootstrap: int, place: "Process"
) -> "dict[str, ScanMetric]":
    """The metrics that can be computed here; a warning names the others."""
    built: dict[str, ScanMetric] = {}
    left_out: dict[str, list[str]] = {}
    for name in names:
        try:
            (metric,) = _build([name], bootstrap, place).values()
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


def _many(steps: str | None) -> list[int]:
    from r2flow.cli.output import numbers

    return numbers("steps", steps or "1,2,4,8,16,32,64,128,256", int)
