"""The metrics' figures of generated scans against real ones, each with its protocol."""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError
from r2flow.evaluation.protocols import R2FLOW, WORDS, Rules
from r2flow.evaluation.sets import SampledScans
from r2flow.evaluation.statistics import Cache, Statistics, key_of
from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.bootstrap import LEVEL, bootstrap
from r2flow.metrics.scans import Scans
from r2flow.processes import place, summed
from r2flow.progress import Bar

# The field compares histograms of single scans with this many real scans, by a fixed shuffle, and features with all.
REAL_SCANS = 10_000


@dataclass(frozen=True)
class Work:
    """How the work is done; figures do not depend on it beyond rounding."""

    batch_size: int = 8  # scans at once
    workers: int = 0  # further processes that read


def bar(doing: str, total: int, unit: str = "scans") -> Bar:
    """A progress bar, shown by the first of several processes."""
    return Bar(doing, total, unit, shown=None if place()[0] == 0 else False)


@dataclass(frozen=True)
class MetricResult:
    """One metric's figures of one comparison."""

    metric: str
    figures: Mapping[str, float]  # by name; NaN where one does not exist, and a remark says why
    protocol: Mapping[str, Any]  # the metric's, with the numbers of scans and how the real ones were chosen
    remarks: Sequence[str] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # (low, high), where asked for


def real_rule(metric: ScanMetric, real: ScanSet, protocol: Rules = R2FLOW) -> tuple[Sequence[int] | None, str]:
    """The real scans that a metric is given: their numbers, or None for all, and the rule in words."""
    count = len(real)
    if metric.protocol.extractor is not None or count <= REAL_SCANS:
        return None, f"all {count}"
    return protocol.choose(real, REAL_SCANS), f"{REAL_SCANS} of {count}, {protocol.chosen}"


def check_reflectance(metrics: Mapping[str, ScanMetric], sets: Iterable[ScanSet]) -> None:
    """Refuse, before anything is read, a set without the reflectance that a metric needs."""
    needing = [name for name, metric in metrics.items() if metric.needs_reflectance]
    for scans in sets:
        if needing and not scans.about.get("reflectance", True):
            raise InputError(f"{scans.label} has no reflectance, which {', '.join(needing)} needs; leave it out.")


def gather_real(
    metrics: Mapping[str, ScanMetric], real: ScanSet, work: Work, cache: Cache | None = None, protocol: Rules = R2FLOW
) -> dict[str, Statistics]:
    """Each metric's statistics of the real scans, from the cache where it holds them."""
    if len(real) == 0:
        raise InputError(f"{real.label} holds no scan to compare with.")
    protocol.check(real)
    chosen = {name: real_rule(metric, real, protocol) for name, metric in metrics.items()}
    points = "" if protocol.real == "centre" else f", points {WORDS[protocol.real]}"
    statistics: dict[str, Statistics] = {}
    cache = None if real.identity is None else cache  # what cannot be told apart from other scans
    if cache is not None:
        keys = {name: key_of(metric, real, chosen[name][1] + points) for name, metric in metrics.items()}
        held = {name: one for name, key in keys.items() if (one := cache.read(key)) is not None}
        statistics = {name: replace(held[name], chosen=chosen[name][1]) for name in _common(set(held))}
    missing = {name: metric for name, metric in metrics.items() if name not in statistics}
    for metric in missing.values():
        metric.reset()
    # The subset first, for every metric, then the rest, for those that take all scans: every scan is read once.
    some = next((chosen[name][0] for name in missing if chosen[name][0] is not None), None) or []
    whole_set = {name: metric for name, metric in missing.items() if chosen[name][0] is None}
    rest = sorted(set(range(len(real))) - set(some)) if whole_set else []
    first = _update(missing, real, some, 0, True, work, protocol)
    second = _update(whole_set, real, rest, len(some), True, work, protocol)
    for name, metric in missing.items():
        counts = (len(real), first + second) if name in whole_set else (len(some), first)
        statistics[name] = Statistics(metric.real_state(), *counts, chosen[name][1])
        if cache is not None and place()[0] == 0:
            cache.write(keys[name], statistics[name])
    return statistics


def measure(
    metrics: Mapping[str, ScanMetric],
    real: Mapping[str, Statistics],
    generated: ScanSet,
    work: Work,
    draws: int = 0,
    protocol: Rules = R2FLOW,
) -> list[MetricResult]:
    """Every metric's figures of a generated set.

    Args:
        metrics: Built with `keep=True` where there are draws.
        real: Of `gather_real`, under the same protocol.
        draws: Bootstrap resamples for 95 % intervals; 0 for none.
    """
    if len(generated) == 0:
        raise InputError(f"{generated.label} holds no scan to measure.")
    for name, metric in metrics.items():
        metric.reset()
        metric.load_real_state(real[name].states)
    empty = _update(metrics, generated, range(len(generated)), 0, False, work, protocol)
    unsolved = generated.source.unsolved if isinstance(generated.source, SampledScans) else 0
    unsolved = int(summed(torch.tensor(unsolved)))
    elevations = generated.sensor.elevations
    described = {
        "sensor": generated.sensor.name, "elevations": [max(elevations), min(elevations)],
        "image": list(generated.sensor.shape),
    }  # fmt: skip
    results = []
    for name, metric in metrics.items():
        figures = {key: float(value) for key, value in metric.compute().items()}
        remarks = metric.remarks()
        for side, count in (("real", real[name].scans), ("generated", len(generated))):
            if count == 1:
                remarks.append(f"a single {side} scan is not a distribution.")
        if lost := [key for key, value in figures.items() if math.isnan(value)]:
            remarks.append(f"no figure for {', '.join(lost)}.")
        if unsolved:
            remarks.append(f"{unsolved} of {len(generated)} scans are not solved to the tolerance.")
        sizes = {
            "real": real[name].scans, "real_chosen": real[name].chosen, "real_empty": real[name].empty,
            "generated": len(generated), "generated_empty": empty,
        }  # fmt: skip
        used: dict[str, Any] = {
            **protocol.describe(), **metric.protocol.asdict(), **described, "sizes": sizes
        }  # fmt: skip
        intervals: dict[str, tuple[float, float]] = {}
        if draws and not metric.resamples:
            remarks.append(f"{name} has no bootstrap interval.")
        elif draws:
            used["interval"] = {"bootstrap draws": draws, "level": LEVEL, "seed": 0}
            with bar("resampling", draws, "sets") as advance:
                intervals = bootstrap(metric, draws, advance=advance)
        results.append(MetricResult(name, figures, used, remarks, intervals))
    return results


def speed_result(real: ScanSet, generated: ScanSet) -> MetricResult:
    """Mean network evaluations a scan, and seconds a scan: the median over batches, without the metrics' time."""
    source = generated.source
    assert isinstance(source, SampledScans)
    # A process without a batch has drawn nothing; the first process always has.
    figures = {
        "evaluations": statistics.fmean(source.evaluations or [math.nan]),
        "seconds": statistics.median(source.seconds or [math.nan]),
    }
    sizes = {"real": len(real), "real_chosen": "none", "generated": len(generated)}
    return MetricResult("speed", figures, {**Protocol("speed", "network and solver").asdict(), "sizes": sizes})


def _update(
    metrics: Mapping[str, ScanMetric],
    scans: ScanSet,
    numbers: Sequence[int],
    first: int,
    real: bool,
    work: Work,
    protocol: Rules,
) -> int:
    """Give this process's share of the scans to the metrics; returns how many of all have no return within the mask."""
    if not metrics or not numbers:
        return 0
    device = next(iter(metrics.values())).device
    rank, ranks = place()
    starts = range(0, len(numbers), work.batch_size)[rank::ranks]
    shared = [number for start in starts for number in numbers[start : start + work.batch_size]]
    batches: Iterable[tuple[torch.Tensor, torch.Tensor | None]]
    if real and protocol.real == "measured":
        batches = scans.batches_with_points(shared, work.batch_size, work.workers)
    else:
        batches = ((images, None) for images in scans.batches(shared, work.batch_size, work.workers))
    names, side = scans.source.names, "real" if real else "generated"
    empty = 0
    with bar(f"reading {side} scans", len(shared)) as advance, torch.no_grad():
        for start, (images, points) in zip(starts, batches, strict=True):
            labels = [f"{names[number]} of {scans.label}" for number in numbers[start : start + work.batch_size]]
            batch = Scans(images.to(device), scans.sensor, protocol.rays(real), points, labels)
            empty += int((~batch.returned.flatten(1).any(1)).sum())
            for metric in metrics.values():
                metric.update(batch, real=real, first=first + start)
            advance(len(batch))
    return int(summed(torch.tensor(empty)))


def _common(names: set[str]) -> set[str]:
    """The names that every process has found in the cache: a metric is read from it by all of them or by none."""
    _, ranks = place()
    if ranks == 1:
        return names
    all_names: list[set[str]] = [set()] * ranks
    torch.distributed.all_gather_object(all_names, names)
    return set.intersection(*all_names)
