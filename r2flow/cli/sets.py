"""The sets of scans of `r2flow evaluate`, and its metrics."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from r2flow.base.errors import InputError
from r2flow.cli.options import (
    SETS,
    BatchOption,
    DeviceOption,
    PrecisionOption,
    ReadingOptions,
    SamplerOptions,
    SeedOption,
    SplitOption,
    StepsList,
    ToleranceOption,
)

if TYPE_CHECKING:
    from r2flow.data.described import Described
    from r2flow.data.reading import Reading
    from r2flow.data.sets import ScanSet
    from r2flow.metrics.base import ScanMetric
    from r2flow.model.checkpoint import Checkpoint

_log = logging.getLogger(__name__)

_SAMPLED = 1000  # default number of scans per sampled model


@dataclass(frozen=True)
class EvaluateOptions:
    """Metrics, the number of scans they compare, and the files of results."""

    metrics: Annotated[
        str | None,
        Option(
            help="Metrics, separated by commas, or all available here: all. Default: panel, KID "
            "and Frechet distance of hand-made features, JSD, MMD. miou alone: labels beside scans "
            "of the same names."
        ),
    ] = None
    protocol: Annotated[
        str,
        Option(help="r2flow, or paper: measured points of real, bin corners of generated scans."),
    ] = "r2flow"
    reference: Annotated[
        bool | None,
        Option(
            "--reference/--no-reference",
            help="Real against real: halves, two drives.",
            show_default="on",
        ),
    ] = None
    baselines: Annotated[
        bool | None,
        Option(
            "--baselines/--no-baselines",
            help="Noise, flat ground, mean scan, shuffled pixels.",
            show_default="on",
        ),
    ] = None
    train: Annotated[
        str | None, Option(help=f"Training scans, to find copies by distance: {SETS}.")
    ] = None
    train_split: SplitOption = None
    no_cache: Annotated[
        bool, Option("--no-cache", help="Recompute the statistics of the real scans.")
    ] = False
    num: Annotated[
        int | None,
        Option(min=1, help="Scans to sample or simulate (1000), or to read per folder (all)."),
    ] = None
    real_num: Annotated[
        int | None, Option(min=1, help="Maximum of real scans, by a fixed shuffle.")
    ] = None
    split: SplitOption = None
    steps: StepsList = None
    sampler: Annotated[
        str | None, Option(help="Samplers of models; adams3,heun2: one set each.")
    ] = None
    tolerance: ToleranceOption = None
    precision: PrecisionOption = "32-true"
    seed: SeedOption = 0
    batch_size: BatchOption = 8
    workers: Annotated[int, Option(min=0, help="Additional processes that read scans.")] = 2
    device: DeviceOption = "auto"
    json: Annotated[
        Path | None,
        Option("--json", dir_okay=False, help="JSON file of results with their protocols."),
    ] = None
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="Folder for a page; replaces an earlier one."),
    ] = None


def reading_of(
    how: ReadingOptions, named: "Sequence[Described]", flows: "Sequence[Checkpoint]"
) -> "Reading":
    """How points become images, whatever the order of models and samples: with all returns that any
    of them has.
    """
    from r2flow.data.detection import reading_for
    from r2flow.data.options import PREPARED
    from r2flow.metrics.scans import MASK

    sensors = {(flow.sensor.shape, flow.sensor.elevations) for flow in flows}
    if len(sensors) > 1:
        raise InputError(
            "the models have different sensors or image sizes; measure each by itself."
        )
    reading = how.reading(named, next(iter(flows), None))
    sets = [reading_for([], flow) for flow in flows]
    sets += [scans.stored for scans in named[1:] if scans.stored]
    prepared = any(scans.options.name == PREPARED for scans in named)
    if (how.sensor and not flows) or not sets or prepared:
        return reading  # as chosen, or as the prepared scans were projected
    near = min(other.sensor.min_range for other in sets)
    far = max(MASK[1], *(other.sensor.max_range for other in sets))
    sensor = replace(reading.sensor, min_range=near, max_range=far)
    agreed = how.convention or len({other.convention for other in sets}) == 1
    return replace(reading, sensor=sensor, convention=reading.convention if agreed else "centre")


def open_set(described: "Described", reading: "Reading", num: int | None) -> "ScanSet":
    from r2flow.data.opening import open_scans

    scans = open_scans(described, reading, num=num)
    _ = scans.source[0]  # fail before the other set is read
    return scans


def judged_sets(
    named: Sequence[str],
    flows: "Mapping[str, Checkpoint]",
    files: "Mapping[str, Described]",
    reading: "Reading",
    options: EvaluateOptions,
) -> "dict[str, ScanSet]":
    """The sets of GENERATED by name: files, and samples of models."""
    from r2flow.reports.tables import short_names

    sets: dict[str, ScanSet] = {}
    for text, name in zip(named, short_names(named), strict=True):
        if text in flows:
            sets |= _sampled(name, flows[text], options)
        else:
            sets[name] = open_set(files[text], reading, options.num)
    return sets


def _sampled(label: str, flow: "Checkpoint", options: EvaluateOptions) -> "dict[str, ScanSet]":
    """One set per sampler and number of steps that suits the generator, by name.

    Of several samplers, each receives only the options that it has.
    """
    from r2flow.base.registry import options_of
    from r2flow.evaluation.sets import sampled_set
    from r2flow.samplers import SAMPLERS, parse_sampler, split_samplers

    generator = flow.generator
    names = split_samplers(options.sampler) if options.sampler else [None]
    counts = options.steps or [None]
    samplers = {}
    refused: InputError | None = None
    for name in names:
        known = vars(generator.sampler)
        if name is not None:
            known = options_of(SAMPLERS[parse_sampler(name)["name"]])
        for steps in counts:
            fields = SamplerOptions(name, steps, options.tolerance).fields
            if len(names) > 1 or len(counts) > 1:
                fields = {key: fields[key] for key in fields if key == "name" or key in known}
            try:
                sampler = generator.choose(**fields)
            except InputError as error:
                refused = error
                continue
            curve = re.sub(":steps=[0-9]+", "", name) if name else ""
            line = f"{label}, {curve}" if len(names) > 1 else label
            varied = len(counts) > 1 and "steps" in fields
            ending = str(sampler).removeprefix(sampler.name) if varied else ""
            samplers[line + ending] = (line, sampler)
    if refused and not samplers:
        if not generator.fixed:
            raise refused
        _log.warning("%s is distilled for %s alone", label, generator.sampler)
        samplers = {label: (label, generator.sampler)}
    num = options.num or _SAMPLED
    return {
        name: sampled_set(flow, line, num, sampler, options.seed, options.precision)
        for name, (line, sampler) in samplers.items()
    }


def possible_metrics(
    reflectance: bool, options: EvaluateOptions, device: str
) -> "dict[str, ScanMetric]":
    """Build the default metrics, or all, that can be computed here; warn about the others."""
    from r2flow.metrics import METRICS, default_metrics

    built: dict[str, ScanMetric] = {}
    missing = []
    for name in METRICS if options.metrics == "all" else default_metrics(reflectance):
        try:
            metric = METRICS[name]().to(device)
        except InputError:
            missing.append(name)
            continue
        if reflectance or not metric.needs_reflectance:
            built[name] = metric
    if missing:
        _log.warning(
            "%s left out: their weights are not installed (r2flow info)", ", ".join(missing)
        )
    return built
