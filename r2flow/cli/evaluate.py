"""`r2flow evaluate`: compare generated with real scans."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import SETS, DeviceOption, PrecisionOption, ReadingOptions, SamplerOptions, grouped, numbers
from r2flow.config import at_most_three
from r2flow.devices import choose_device
from r2flow.errors import InputError, check, check_folder

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.data.sets import ScanSet
    from r2flow.generators import Generator, Sampler
    from r2flow.metrics.base import ScanMetric
    from r2flow.model.checkpoint import Checkpoint

log = logging.getLogger(__name__)

SAMPLED = 1000  # default number of scans per sampled model
REAL = "the real scans"
SAMPLING = ("steps", "sampler", "tolerance", "precision", "seed")  # options of sampled models


@dataclass(frozen=True)
class EvaluateOptions:
    metrics: Annotated[
        str | None,
        typer.Option(
            help="Metrics, separated by commas, or all available here: all. Default: panel, KID and Frechet distance "
            "of hand-made features, JSD, MMD."
        ),
    ] = None
    protocol: Annotated[
        str, typer.Option(help="r2flow, or paper: measured points of real, bin corners of generated scans.")
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
    train: Annotated[str | None, typer.Option(help=f"Training scans, to find copies by distance: {SETS}.")] = None
    train_split: Annotated[str | None, typer.Option(help="Part of TRAIN's standard split.")] = None
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Recompute the statistics of the real scans.")] = False
    num: Annotated[
        int | None, typer.Option(min=1, help="Scans to sample or simulate (1000), or to read per folder (all).")
    ] = None
    real_num: Annotated[int | None, typer.Option(min=1, help="Maximum of real scans, by a fixed shuffle.")] = None
    split: Annotated[str | None, typer.Option(help="Part of REAL's standard split.")] = None
    generated_split: Annotated[str | None, typer.Option(help="Part of GENERATED's standard split.")] = None
    generated_scale: Annotated[
        float | None, typer.Option(min=1e-6, max=1e9, help="--reflectance-scale of files in GENERATED, if different.")
    ] = None
    steps: Annotated[str | None, typer.Option(help="Steps of models; 1,2,4: one set each.")] = None
    sampler: Annotated[str | None, typer.Option(help="Samplers of models; adams3,heun2: one set each.")] = None
    tolerance: Annotated[float | None, typer.Option(help="Error tolerance per step, for adaptive samplers.")] = None
    precision: PrecisionOption = "32-true"
    seed: Annotated[int, typer.Option(min=0, help="Seed of sampled scans.")] = 0
    batch_size: Annotated[int, typer.Option(min=1, help="Scans per batch.")] = 8
    workers: Annotated[int, typer.Option(min=0, help="Additional processes that read scans.")] = 2
    device: DeviceOption = "auto"
    json: Annotated[Path | None, typer.Option("--json", help="JSON file of results with their protocols.")] = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for a page; replaces an earlier one.")] = None

    def check(self, named: Sequence[str], sampled: Sequence[str]) -> None:
        """Refuse incompatible options before reading any scan."""
        check(named or self.reference or self.baselines, "nothing to compare with: give GENERATED or --reference.")
        check(named or self.num is None, "--num is of GENERATED; found none. REAL has --real-num.")
        check(self.train or not self.train_split, "--train-split is of --train; found none.")
        if self.json is not None and (self.json.is_dir() or self.json.suffix.lower() != ".json"):
            raise InputError(f"--json must be a file that ends in .json, found {self.json}.")
        if not sampled and any(getattr(self, key) != getattr(EvaluateOptions, key) for key in SAMPLING):
            found = at_most_three(named) or "none"
            raise InputError(f"--{', --'.join(SAMPLING)} are of a run, a checkpoint or a model; found {found}.")
        if len(named) == len(sampled) and (self.generated_split or self.generated_scale):
            raise InputError("--generated-split and --generated-scale are of files in GENERATED; found none.")


@app.command(
    epilog="Example: r2flow evaluate kitti_360:/data/KITTI-360 runs/1rf runs/2rf others/ --split test --json e.json"
)
@grouped
def evaluate(
    real: Annotated[str, typer.Argument(help=f"Real scans: {SETS}.")],
    options: EvaluateOptions,
    how: ReadingOptions,
    generated: Annotated[
        list[str] | None,
        typer.Argument(help="Sets of generated scans, as REAL, or runs, checkpoints or models to sample."),
    ] = None,
) -> None:
    """Evaluate generated scans against real scans: distances with their protocols and sensor.

    One table compares all sets with reference distances between real scans and with baselines. Models are sampled;
    several --steps or --sampler plot distance against evaluations and seconds. The same command with --out resumes.
    Under torchrun, processes share the scans.
    """
    from r2flow.evaluation.comparing import Comparer, pairs_of, with_equal_panels
    from r2flow.evaluation.copies import Nearest, find_nearest, with_copies
    from r2flow.evaluation.measuring import Cache, Work, check_reflectance
    from r2flow.evaluation.protocols import PROTOCOLS
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.metrics import METRICS
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.processes import joined, place
    from r2flow.reports.evaluation import evaluation_page, print_comparisons
    from r2flow.reports.pages import write_json, write_page
    from r2flow.reports.view.panels import write_sets

    named = list(dict.fromkeys(generated or []))
    sampled = [name for name in named if is_checkpoint(name)]
    rules = PROTOCOLS[options.protocol]
    options.check(named, sampled)
    with joined(choose_device(options.device)) as device:
        names = None if options.metrics in (None, "all") else options.metrics.split(",")
        chosen = names and {name: METRICS[name]().to(device) for name in dict.fromkeys(names)}
        flows = {name: load_checkpoint(name, device) for name in sampled}
        if len({(flow.sensor.shape, flow.sensor.elevations) for flow in flows.values()}) > 1:
            raise InputError(f"{', '.join(flows)} have different sensors or image sizes; measure each by itself.")
        if flows and options.num is None and place()[0] == 0:
            print(f"{', '.join(flows)}: sampling {SAMPLED} scans per set (change the number by --num)")
        files = [name for name in named if name not in flows]
        how = replace(how, convention=how.convention or rules.convention)
        reading = _reading(how, [real, *files, *([options.train] if options.train else [])], list(flows.values()))
        if chosen and not any(m.needs_reflectance or m.uses_reflectance for m in chosen.values()):
            reading = replace(reading, reflectance=False)  # else a scale would be required
        truth = _open(real, reading, options.split, options.real_num)
        rules.check(truth)
        judged = _judged(named, flows, reading, options)
        sets = [truth, *judged.values()]
        metrics = chosen or _build_possible(all(s.about.get("reflectance") for s in sets), options, device)
        check_reflectance(metrics, sets)
        training = None if options.train is None else _open(options.train, reading, options.train_split, None)
        for folder in filter(None, (options.out, options.json and options.json.parent)):
            check_folder(folder)
        work = Work(options.batch_size, options.workers)
        cache = None if options.no_cache else Cache()
        compare = Comparer(metrics, work, rules, cache, options.out and options.out / "results", device)
        pairs = pairs_of(truth, judged, options.reference, options.baselines)
        comparisons = with_equal_panels([compare(*pair) for pair in pairs])
        if place()[0] > 0:  # the first process prints and writes the results
            return
        nearest: dict[str, Nearest] = {}
        if training is not None:
            nearest = find_nearest({**judged, REAL: truth}, training, work, device)
            comparisons = with_copies(comparisons, nearest, nearest.pop(REAL))
        seeds = {"sampled scans": options.seed} if any(scans.source.drawn for scans in judged.values()) else {}
        page = evaluation_page(comparisons, device, seeds, nearest)
        print_comparisons(comparisons)
        if options.json is not None:
            write_json(page, options.json)
            print(options.json)
        if options.out is not None:
            print(*write_page(page, options.out), sep="\n")
            shown = {"real": truth} | {"real, judged" if name == "real" else name: s for name, s in judged.items()}
            print(write_sets(options.out / "evaluation.html", shown, title="Generated and real scans"))


def _reading(how: ReadingOptions, specs: Sequence[str], flows: "Sequence[Checkpoint]") -> "Reading":
    """How points become images, whatever the order of models and samples: with all returns that any of them has."""
    from r2flow.data.opening import PREPARED, own_reading, parse, reading_for
    from r2flow.metrics.scans import MASK

    reading = how.reading(specs, next(iter(flows), None))
    sets = [reading_for([], flow) for flow in flows] + [stored for s in specs[1:] if (stored := own_reading(s))]
    if (how.sensor and not flows) or not sets or PREPARED in [parse(spec)[0].name for spec in specs]:
        return reading  # as chosen, or as the prepared scans were projected
    near, far = min(one.sensor.min_range for one in sets), max(one.sensor.max_range for one in sets)
    sensor = replace(reading.sensor, min_range=near, max_range=max(far, MASK[1]))
    agreed = how.convention or len({one.convention for one in sets}) == 1
    return replace(reading, sensor=sensor, convention=reading.convention if agreed else "centre")


def _open(text: str, reading: "Reading", split: str | None, num: int | None) -> "ScanSet":
    from r2flow.data.opening import open_scans, refuse_parts

    scans = open_scans(text, reading, split, num)
    refuse_parts(text)
    _ = scans.source[0]  # fail before the other set is read
    return scans


def _judged(
    named: Sequence[str], flows: "Mapping[str, Checkpoint]", reading: "Reading", options: EvaluateOptions
) -> "dict[str, ScanSet]":
    """The sets of GENERATED by name: files, and samples of models."""
    from r2flow.reports.compare import labels

    reading = replace(reading, reflectance_scale=options.generated_scale or reading.reflectance_scale)
    sets: dict[str, ScanSet] = {}
    for text, name in zip(named, labels([Path(text) for text in named]), strict=True):
        if text in flows:
            sets |= _sampled(name, flows[text], options)
        else:
            sets[name] = _open(text, reading, options.generated_split, options.num)
    return sets


def _sampled(label: str, flow: "Checkpoint", options: EvaluateOptions) -> "dict[str, ScanSet]":
    """One set per sampler and number of steps that suits the generator, by name."""
    from r2flow.evaluation.sets import sampled_set
    from r2flow.samplers import split_samplers

    names = [None] if options.sampler is None else split_samplers(options.sampler)
    steps = numbers("steps", options.steps) if options.steps else [None]
    sets, samplers = {}, _samplers(flow.generator, names, steps, options.tolerance)
    if not samplers:
        samplers = [flow.generator.sampler]
        log.warning("%s is distilled for %s alone", label, *samplers)
    curves = [re.sub(":steps=[0-9]+", "", sampler.text) for sampler in samplers]
    for sampler, curve in zip(samplers, curves, strict=True):
        alike = [text for other, text in zip(samplers, curves, strict=True) if other.name == sampler.name]
        line = f"{label}, {curve if len({*alike}) > 1 else sampler.name}" if len(names) > 1 else label
        name = line + str(sampler).removeprefix(sampler.name) * (len(steps) > 1 or len(alike) > 1)
        sets[name] = sampled_set(flow, line, options.num or SAMPLED, sampler, options.seed, options.precision)
    return sets


def _samplers(
    generator: "Generator", names: Sequence[str | None], steps: Sequence[int | None], tolerance: float | None
) -> "list[Sampler]":
    """Samplers that suit a generator; of several, each receives only the options that it has."""
    from r2flow.registry import options_of
    from r2flow.samplers import SAMPLERS, parse_sampler

    fields = [vars(generator.sampler) if n is None else options_of(SAMPLERS[parse_sampler(n)["name"]]) for n in names]
    curve = names == [None] and len(steps) > 1  # a generator without steps (GAN) is one point of the curve
    varied = {option for option in ("steps", "tolerance") if curve or any(option in other for other in fields)}
    chosen: list[Sampler] = []
    refused = None
    for (name, own), count in product(zip(names, fields, strict=True), steps):
        given = SamplerOptions(name, count, tolerance).given
        try:
            sampler = generator.choose(**{key: v for key, v in given.items() if key in own or key not in varied})
        except InputError as error:
            refused = error
            continue
        if sampler not in chosen:
            chosen.append(sampler)
    if refused and not chosen and not generator.fixed:
        raise refused
    return chosen


def _build_possible(reflectance: bool, options: EvaluateOptions, device: str) -> "dict[str, ScanMetric]":
    """Build the default metrics, or all, that can be computed here; warn about the others."""
    from r2flow.metrics import METRICS, default_metrics

    built: dict[str, ScanMetric] = {}
    left_out: dict[str, list[str]] = {}
    for name in METRICS if options.metrics == "all" else default_metrics(reflectance):
        try:
            metric = METRICS[name]().to(device)
        except InputError:
            left_out.setdefault("their weights are not installed (r2flow weights)", []).append(name)
            continue
        if metric.needs_reflectance and not reflectance:
            left_out.setdefault("a set has no reflectance", []).append(name)
        else:
            built[name] = metric
    for reason, skipped in left_out.items():
        log.warning("%s left out: %s", ", ".join(skipped), reason)
    return built
