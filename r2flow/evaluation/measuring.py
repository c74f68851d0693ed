"""The metrics' figures of generated scans against real ones, each with its protocol."""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from r2flow.errors import InputError
from r2flow.evaluation.protocols import R2FLOW, WORDS, Rules
from r2flow.evaluation.sets import SampledScans, ScanSet
from r2flow.evaluation.statistics import Cache, Statistics, key_of
from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.bootstrap import bootstrap
from r2flow.metrics.scans import Scans
from r2flow.progress import Bar

# The field compares histograms of single scans with this many real scans, by a fixed shuffle, and features with all.
REAL_SCANS = 10_000

LEVEL = 0.95  # of intervals


@dataclass(frozen=True)
class Work:
    """How the work is done; figures do not depend on it beyond rounding."""

    batch_size: int = 8  # scans at once
    workers: int = 0  # further processes that read
    rank: int = 0  # number of this process among those that take batches by turns
    ranks: int = 1  # how many these are
    watched: bool = False  # whether progress is shown, by one process of several

    def bar(self, doing: str, total: int, unit: str = "scans") -> Bar:
        """A progress bar of `total` units; shows nothing unless the work is watched."""
        return Bar(doing, total, unit, shown=None if self.watched else False)


@dataclass(frozen=True)
class MetricResult:
    """One metric's figures of one comparison."""

    metric: str
    figures: Mapping[str, float]  # by name; NaN where one does not exist, and a remark says why
    protocol: Mapping[str, Any]  # the metric's, with the numbers of scans and how the real ones were chosen
    remarks: Sequence[str] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # (low, high), where asked for


@dataclass(frozen=True)
class Gathered:
    """The statistics of a real set, by metric."""

    statistics: Mapping[str, Statistics]
    rules: Mapping[str, str]  # how the scans that each metric saw were chosen
    kept: frozenset[str]  # the metrics whose statistics the cache held
    protocol: Rules = R2FLOW  # under which generated scans are compared with them


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
) -> Gathered:
    """Each metric's statistics of the real scans, from the cache where it holds them.

    Raises:
        InputError: no real scan, one that cannot be read, or scans without what the protocol compares.
    """
    if len(real) == 0:
        raise InputError(f"{real.label} holds no scan to compare with.")
    protocol.check(real)
    chosen = {name: real_rule(metric, real, protocol) for name, metric in metrics.items()}
    rules = {name: rule for name, (_, rule) in chosen.items()}
    points = "" if protocol.real == "centre" else f", points {WORDS[protocol.real]}"
    keys = {name: key_of(metric, real, rules[name] + points) for name, metric in metrics.items()}
    held = {name: cache.read(key) for name, key in keys.items()} if cache is not None else {}
    common = _common({name for name, one in held.items() if one is not None}, work)
    statistics = {name: one for name, one in held.items() if one is not None and name in common}
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
        statistics[name] = Statistics(metric.real_state(), *counts)
        if cache is not None and work.rank == 0:
            cache.write(keys[name], statistics[name])
    return Gathered(statistics, rules, frozenset(metrics.keys() - missing.keys()), protocol)


def measure(
    metrics: Mapping[str, ScanMetric], gathered: Gathered, generated: ScanSet, work: Work, draws: int = 0
) -> list[MetricResult]:
    """Every metric's figures of a generated set.

    Args:
        metrics: Built with `keep=True` where there are draws.
        draws: Bootstrap resamples for 95 % intervals; 0 for none.

    Raises:
        InputError: no generated scan, or one that cannot be read.
    """
    if len(generated) == 0:
        raise InputError(f"{generated.label} holds no scan to measure.")
    for name, metric in metrics.items():
        metric.reset()
        metric.load_real_state(gathered.statistics[name].states)
    empty = _update(metrics, generated, range(len(generated)), 0, False, work, gathered.protocol)
    results = []
    drawn = generated.source.unsolved if isinstance(generated.source, SampledScans) else 0
    unsolved = _sum_over_processes(drawn, work)
    for name, metric in metrics.items():
        real = gathered.statistics[name]
        figures = {key: float(value) for key, value in metric.compute().items()}
        remarks = metric.remarks()
        remarks += _remarks(real, len(generated), {k: v for k, v in figures.items() if not _explained(k, remarks)})
        if unsolved:
            remarks.append(f"{unsolved} of {len(generated)} scans are not solved to the tolerance.")
        sizes = {
            "real": real.scans, "real_chosen": gathered.rules[name], "real_empty": real.empty,
            "generated": len(generated), "generated_empty": empty,
        }  # fmt: skip
        e = generated.sensor.elevations
        image = {
            "sensor": generated.sensor.name, "elevations": [max(e), min(e)], "image": list(generated.sensor.shape)
        }  # fmt: skip
        protocol: dict[str, Any] = {
            **gathered.protocol.describe(), **metric.protocol.asdict(), **image, "sizes": sizes
        }  # fmt: skip
        intervals: dict[str, tuple[float, float]] = {}
        if draws and not metric.resamples:
            remarks.append(f"{name} has no bootstrap interval.")
        elif draws:
            protocol["interval"] = {"bootstrap draws": draws, "level": LEVEL, "seed": 0}
            with work.bar("resampling", draws, "sets") as advance:
                intervals = bootstrap(metric, draws, advance=advance)
        results.append(MetricResult(name, figures, protocol, remarks, intervals))
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
    starts = range(0, len(numbers), work.batch_size)[work.rank :: work.ranks]
    shared = [number for start in starts for number in numbers[start : start + work.batch_size]]
    names, side = scans.source.names, "real" if real else "generated"
    empty = 0
    with work.bar(f"reading {side} scans", len(shared)) as advance, torch.no_grad():
        for start, (images, points) in zip(starts, _read(scans, shared, work, protocol, real), strict=True):
            labels = [f"{names[number]} of {scans.label}" for number in numbers[start : start + work.batch_size]]
            batch = Scans(images.to(device), scans.sensor, protocol.rays(real), points, labels)
            empty += int((~batch.returned.flatten(1).any(1)).sum())
            for metric in metrics.values():
                metric.update(batch, real=real, first=first + start)
            advance(len(batch))
    return _sum_over_processes(empty, work)


def _read(
    scans: ScanSet, numbers: Sequence[int], work: Work, protocol: Rules, real: bool
) -> Iterable[tuple[torch.Tensor, torch.Tensor | None]]:
    """Batches of images and, where the protocol compares these, of measured points."""
    if real and protocol.real == "measured":
        return scans.batches_with_points(numbers, work.batch_size, work.workers)
    return ((images, None) for images in scans.batches(numbers, work.batch_size, work.workers))


def _remarks(real: Statistics, generated: int, figures: Mapping[str, float]) -> list[str]:
    """Remarks that hold for any metric."""
    sides = ((real.scans, "real"), (generated, "generated"))
    remarks = [f"a single {whose} scan is not a distribution." for total, whose in sides if total == 1]
    lost = [name for name, value in figures.items() if math.isnan(value)]
    return [*remarks, f"no figure for {', '.join(lost)}."] if lost else remarks


def _explained(name: str, remarks: Sequence[str]) -> bool:
    """Whether a metric's own remark gives the reason for a missing figure."""
    return any(remark.startswith(f"{name}: no figure: ") for remark in remarks)


def _sum_over_processes(count: int, work: Work) -> int:
    if work.ranks == 1:
        return count
    total = torch.tensor(count)
    torch.distributed.all_reduce(total)
    return int(total)


def _common(names: set[str], work: Work) -> set[str]:
    """The names that every process has found in the cache: a metric is read from it by all of them or by none."""
    if work.ranks == 1:
        return names
    all_names: list[set[str] | None] = [None] * work.ranks
    torch.distributed.all_gather_object(all_names, names)
    return set.intersection(*(each or set() for each in all_names))
