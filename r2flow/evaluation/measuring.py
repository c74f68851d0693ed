"""Metrics of generated against real scans, with their protocols; statistics of real scans are cached on disk."""

import json
import logging
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError, check
from r2flow.evaluation.protocols import R2FLOW, WORDS, Rules
from r2flow.evaluation.sets import SampledScans
from r2flow.files import cache_folder
from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.scans import Scans
from r2flow.plugins import plugin_digests
from r2flow.processes import place, summed
from r2flow.progress import Bar
from r2flow.store import Damaged, Store, checksum

log = logging.getLogger(__name__)

FORMAT = 9  # increment if statistics or figures change for the same scans and protocol
# Metrics of single-scan histograms use this many real scans, by a fixed shuffle; metrics of features use all.
REAL_SCANS = 10_000


@dataclass(frozen=True)
class Statistics:
    """A metric's states after a set of scans, and scan counts."""

    states: Mapping[str, Tensor] = field(repr=False)  # from `ScanMetric.real_state`
    scans: int
    empty: int  # scans without a return within the mask
    chosen: str = ""  # description of their choice from the set


class Cache:
    """Folder of statistics of real scans; names in it are hashes of everything the statistics depend on."""

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = cache_folder("R2FLOW_CACHE") / "statistics" if folder is None else Path(folder)

    def _store(self, key: str) -> Store:
        return Store(self.folder / checksum(key)[:24], "statistics", {"key": key})

    def read(self, key: str) -> Statistics | None:
        """Read the statistics of a key from `key_of`; None if missing, damaged or not readable."""
        try:
            states, notes = self._store(key).read(0)
        except (OSError, Damaged, InputError):
            return None
        return Statistics({name: torch.from_numpy(value) for name, value in states.items()}, **notes)

    def write(self, key: str, statistics: Statistics) -> None:
        """Store statistics; only warn if the disk is not writable."""
        states = {name: value.numpy() for name, value in statistics.states.items()}
        try:
            self._store(key).write(0, states, {"scans": statistics.scans, "empty": statistics.empty})
        except OSError as error:
            log.warning("statistics are not cached: %s: %s", self.folder, error.strerror or error)


def key_of(metric: ScanMetric, scans: ScanSet, rule: str) -> str:
    """Everything a metric's statistics of a set depend on, as JSON.

    The key contains scan files with sizes and times (or seed, or manifest), sensor, projection, mask, subset, the
    metric's protocol with its weights' hash, the code of plug-ins, the device type, and the file format.
    """
    parts = {
        "format": FORMAT, "scans": scans.identity, "subset": rule, "protocol": asdict(metric.protocol),
        "plugins": plugin_digests(), "device": torch.device(metric.device).type,
    }  # fmt: skip
    return json.dumps(parts, sort_keys=True)


@dataclass(frozen=True)
class Work:
    """Batch size and reader processes; results do not depend on them beyond rounding."""

    batch_size: int = 8  # scans per batch
    workers: int = 0  # additional reader processes


def bar(doing: str, total: int) -> Bar:
    """Create a progress bar, shown only by the first process."""
    return Bar(doing, total, shown=None if place()[0] == 0 else False)


@dataclass(frozen=True)
class MetricResult:
    """Results of one metric for one pair of sets."""

    metric: str
    figures: Mapping[str, float]  # by name; NaN if undefined, with a remark
    protocol: Mapping[str, Any]  # the metric's, plus set sizes and choice of real scans
    biased: bool | None  # as in `ScanMetric`
    remarks: Sequence[str] = ()


def real_rule(metric: ScanMetric, real: ScanSet, protocol: Rules = R2FLOW) -> tuple[Sequence[int] | None, str]:
    """Indices of the real scans for a metric (None: all) and a description of the choice."""
    count = len(real)
    if metric.protocol.extractor is not None or count <= REAL_SCANS:
        return None, f"all {count}"
    return protocol.choose(real, REAL_SCANS), f"{REAL_SCANS} of {count}, {protocol.chosen}"


def check_reflectance(metrics: Mapping[str, ScanMetric], sets: Iterable[ScanSet]) -> None:
    """Refuse a set without the reflectance that a metric needs, before reading scans."""
    needing = [name for name, metric in metrics.items() if metric.needs_reflectance]
    for scans in sets:
        if needing and not scans.about.get("reflectance", True):
            raise InputError(f"{scans.label} has no reflectance, which {', '.join(needing)} needs; leave it out.")


def gather_real(
    metrics: Mapping[str, ScanMetric], real: ScanSet, work: Work, cache: Cache | None = None, protocol: Rules = R2FLOW
) -> dict[str, Statistics]:
    """Compute each metric's statistics of the real scans, or read them from the cache."""
    chosen = {name: real_rule(metric, real, protocol) for name, metric in metrics.items()}
    points = "" if protocol.real == "centre" else f", points {WORDS[protocol.real]}"
    statistics: dict[str, Statistics] = {}
    cache = None if real.identity is None else cache  # without an identity there is no key
    if cache is not None:
        keys = {name: key_of(metric, real, chosen[name][1] + points) for name, metric in metrics.items()}
        cached = {name: entry for name, key in keys.items() if (entry := cache.read(key)) is not None}
        readers = summed(torch.tensor([int(name in cached) for name in metrics])).tolist()
        everywhere = [name for name, count in zip(metrics, readers, strict=True) if count == place()[1]]
        statistics = {name: replace(cached[name], chosen=chosen[name][1]) for name in everywhere}
    missing = {name: metric for name, metric in metrics.items() if name not in statistics}
    for metric in missing.values():
        metric.reset()
    # Read the subset for all metrics, then the rest for metrics of all scans: every scan is read once.
    subset = next((chosen[name][0] for name in missing if chosen[name][0] is not None), None) or []
    whole_set = {name: metric for name, metric in missing.items() if chosen[name][0] is None}
    rest = sorted(set(range(len(real))) - set(subset)) if whole_set else []
    first = _update(missing, real, subset, True, work, protocol)
    second = _update(whole_set, real, rest, True, work, protocol)
    for name, metric in missing.items():
        counts = (len(real), first + second) if name in whole_set else (len(subset), first)
        statistics[name] = Statistics(metric.real_state(), *counts, chosen[name][1])
        if cache is not None and place()[0] == 0:
            cache.write(keys[name], statistics[name])
    return statistics


def measure(
    metrics: Mapping[str, ScanMetric],
    real: Mapping[str, Statistics],
    generated: ScanSet,
    work: Work,
    protocol: Rules = R2FLOW,
) -> list[MetricResult]:
    """Compute all metrics of a generated set; `real` are statistics from `gather_real` under the same protocol."""
    for name, metric in metrics.items():
        metric.reset()
        metric.load_real_state(real[name].states)
    before = getattr(generated.source, "unsolved", 0)
    empty = _update(metrics, generated, range(len(generated)), False, work, protocol)
    unsolved = int(summed(torch.tensor(getattr(generated.source, "unsolved", 0) - before)))
    elevations = generated.sensor.elevations
    described: dict[str, Any] = {
        "name": protocol.name, "points": {"real": WORDS[protocol.real], "generated": WORDS[protocol.generated]},
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
        if undefined := [key for key, value in figures.items() if math.isnan(value)]:
            remarks.append(f"no figure for {', '.join(undefined)}.")
        if unsolved:
            remarks.append(f"{unsolved} of {len(generated)} scans are not solved to the tolerance.")
        sizes = {
            "real": real[name].scans, "real_chosen": real[name].chosen, "real_empty": real[name].empty,
            "generated": len(generated), "generated_empty": empty,
        }  # fmt: skip
        settings = {**described, **asdict(metric.protocol), "sizes": sizes}
        results.append(MetricResult(name, figures, settings, metric.biased, remarks))
    return results


def speed_result(real: ScanSet, generated: ScanSet) -> MetricResult:
    """Mean network evaluations per scan and median over batches of seconds per scan, excluding metrics."""
    source = generated.source
    assert isinstance(source, SampledScans)
    # A process without a batch has no samples; the first process always has some.
    figures = {
        "evaluations": statistics.fmean(source.evaluations or [math.nan]),
        "seconds": statistics.median(source.seconds or [math.nan]),
    }
    sizes = {"real": len(real), "real_chosen": "none", "generated": len(generated)}
    return MetricResult("speed", figures, {**asdict(Protocol("speed", "network and solver")), "sizes": sizes}, None)


def _update(
    metrics: Mapping[str, ScanMetric],
    scans: ScanSet,
    numbers: Sequence[int],
    real: bool,
    work: Work,
    protocol: Rules,
) -> int:
    """Update the metrics with this process's share of scans; return how many of all scans are empty within the mask."""
    if not metrics or not numbers:
        return 0
    device = next(iter(metrics.values())).device
    rank, ranks = place()
    starts = range(0, len(numbers), work.batch_size)[rank::ranks]
    shared = [number for start in starts for number in numbers[start : start + work.batch_size]]
    measured = real and protocol.real == "measured"
    rays = protocol.real if real and protocol.real != "measured" else protocol.generated
    batches = scans.batches(shared, work.batch_size, work.workers, with_points=measured)
    names, side = scans.source.names, "real" if real else "generated"
    empty, last = 0, torch.empty(0)
    with bar(f"reading {side} scans", len(shared)) as advance, torch.no_grad():
        for start, read in zip(starts, batches, strict=True):
            images, points = read if measured else (read, None)
            given = numbers[start : start + work.batch_size]
            if measured or not torch.equal(images, last):  # some baselines repeat one scan
                labels = [f"{names[number]} of {scans.label}" for number in given]
                batch, last = Scans(images.to(device), scans.sensor, rays, points, labels), images
            empty += int((~batch.returned.flatten(1).any(1)).sum())
            version = batch.images._version  # counts the edits in place
            for name, metric in metrics.items():
                metric.update(batch, real=real, numbers=given)
                check(batch.images._version == version, f"metric {name} edits the scans of all metrics: edit a copy.")
            advance(len(batch))
    return int(summed(torch.tensor(empty)))
