"""Metrics of generated against real scans."""

import json
import logging
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.plugins import plugin_digests
from r2flow.base.processes import rank_and_world_size, sum_over_processes
from r2flow.base.progress import Bar
from r2flow.base.registry import Options
from r2flow.data.sets import ScanSet
from r2flow.evaluation.protocols import R2FLOW, WORDS, Rules
from r2flow.evaluation.sets import SampledScans
from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.scans import Scans

_log = logging.getLogger(__name__)

FORMAT = 12  # increment if figures change for the same scans and protocol
# Metrics of single-scan histograms use this many real scans, by a fixed shuffle; metrics of
# features use all.
REAL_SCANS = 10_000

_Metrics = Mapping[str, ScanMetric]  # by name


@dataclass(frozen=True)
class Work:
    """Batch size and reader processes; results do not depend on them beyond rounding."""

    batch_size: int = 8  #: scans per batch
    workers: int = 0  #: additional reader processes


@dataclass(frozen=True)
class Statistics:
    """A metric's states after a set of scans, and scan counts."""

    states: Mapping[str, Tensor] = field(repr=False)  #: from `ScanMetric.real_state`
    scans: int
    empty: int  #: scans without a return within the mask
    choice: str = ""  #: description of their choice from the set


@dataclass(frozen=True)
class MetricResult:
    """Results of one metric for one pair of sets."""

    metric: str
    figures: Mapping[str, float]  #: by name; NaN if undefined, with a remark
    protocol: Options  #: the metric's, plus set sizes and choice of real scans
    biased: bool | None  #: as in `ScanMetric`
    remarks: Sequence[str] = ()


def key_of(metric: ScanMetric, scans: ScanSet, choice: str) -> str:
    """Everything a metric's figures for a set of real scans depend on, as JSON.

    The key contains scan files with sizes and times (or seed, or manifest), sensor, projection,
    mask, subset, the metric's protocol with its weights' hash, the code of plug-ins, the device
    type, and the file format.
    """
    parts = {
        "format": FORMAT,
        "scans": scans.identity,
        "subset": choice,
        "protocol": asdict(metric.protocol),
        "plugins": plugin_digests(),
        "device": metric.device.type,
    }
    return json.dumps(parts, sort_keys=True)


def bar(doing: str, total: int) -> Bar:
    """Create a progress bar, shown only by the first process."""
    return Bar(doing, total, shown=None if rank_and_world_size()[0] == 0 else False)


def _of_all_processes(count: int) -> int:
    return int(sum_over_processes(torch.tensor(count)))


@dataclass
class Measurer:
    """Compares sets of scans by some metrics, under the rules of a protocol."""

    metrics: _Metrics
    work: Work = Work()
    rules: Rules = R2FLOW

    def check(self, sets: Iterable[ScanSet]) -> None:
        """Refuse a set without the reflectance that a metric needs, before reading scans."""
        needing = [name for name, metric in self.metrics.items() if metric.needs_reflectance]
        for scans in sets:
            if needing and not scans.about.get("reflectance", True):
                raise InputError(
                    f"{scans.label} has no reflectance, which {', '.join(needing)} needs; leave it "
                    "out."
                )

    def gather(self, real: ScanSet) -> dict[str, Statistics]:
        """Compute each metric's statistics of real scans."""
        groups: dict[str, list[str]] = {}  # of metrics, by their choice of scans
        numbers: dict[str, Sequence[int]] = {}
        for name, metric in self.metrics.items():
            some, choice = self._scans_for(metric, real)
            metric.reset()
            groups.setdefault(choice, []).append(name)
            numbers[choice] = some
        gathered = {}
        for choice, names in groups.items():
            empty = self._update(names, real, numbers[choice], True)
            for name in names:
                states = self.metrics[name].real_state()
                gathered[name] = Statistics(states, len(numbers[choice]), empty, choice)
        return gathered

    def _scans_for(self, metric: ScanMetric, real: ScanSet) -> tuple[Sequence[int], str]:
        """Numbers of the real scans for a metric, and a description of the choice."""
        count = len(real)
        if metric.protocol.extractor is not None or count <= REAL_SCANS:
            return range(count), f"all {count}"
        numbers = self.rules.choose(real, REAL_SCANS)
        return numbers, f"{REAL_SCANS} of {count}, {self.rules.choice}"

    def measure(self, real: Mapping[str, Statistics], generated: ScanSet) -> list[MetricResult]:
        """Compute all metrics of a generated set; `real` are statistics from `gather`."""
        for name, metric in self.metrics.items():
            metric.reset()
            metric.load_real_state(real[name].states)
        before = generated.source.unsolved
        empty = self._update([*self.metrics], generated, range(len(generated)), False)
        unsolved = _of_all_processes(generated.source.unsolved - before)
        sensor = generated.sensor
        rules = self.rules
        described = {
            "name": rules.name,
            "points": {"real": WORDS[rules.real], "generated": WORDS[rules.generated]},
            "sensor": sensor.name,
            "elevations": [max(sensor.elevations), min(sensor.elevations)],
            "image": list(sensor.shape),
        }
        results = []
        for name, metric in self.metrics.items():
            figures = {key: float(value) for key, value in metric.compute().items()}
            remarks = list(metric.remarks)
            if unsolved:
                remarks.append(
                    f"{unsolved} of {len(generated)} scans are not solved to the tolerance."
                )
            truth = real[name]
            sizes = {
                "real": truth.scans,
                "real_chosen": truth.choice,
                "real_empty": truth.empty,
                "generated": len(generated),
                "generated_empty": empty,
            }
            settings = {**described, **asdict(metric.protocol), "sizes": sizes}
            results.append(MetricResult(name, figures, settings, metric.biased, remarks))
        return results

    def _update(
        self, names: Sequence[str], scans: ScanSet, numbers: Sequence[int], real: bool
    ) -> int:
        """Update metrics with this process's share of scans.

        Returns how many of all scans are empty within the mask.
        """
        metrics = [self.metrics[name] for name in names]
        rank, ranks = rank_and_world_size()
        size = self.work.batch_size
        shares = [numbers[i : i + size] for i in range(0, len(numbers), size)][rank::ranks]
        shared = [number for share in shares for number in share]
        side = "real" if real else "generated"
        rays = self.rules.real if real else self.rules.generated
        measured = rays == "measured"
        batches = scans.batches(shared, size, self.work.workers, with_points=measured)
        scan_names = scans.source.names
        empty = 0
        last = torch.empty(0)
        with bar(f"reading {side} scans", len(shared)) as advance, torch.no_grad():
            for share, read in zip(shares, batches, strict=True):
                images, points = read if measured else (read, None)
                if measured or not torch.equal(images, last):  # some baselines repeat one scan
                    labels = [f"{scan_names[number]} of {scans.label}" for number in share]
                    place = self.rules.generated if rays == "measured" else rays
                    there = images.to(metrics[0].device)
                    batch = Scans(there, scans.sensor, place, points, labels)
                    last = images
                empty += int((~batch.nonempty).sum())
                for metric in metrics:
                    metric.update(batch, real)
                advance(len(images))
        return _of_all_processes(empty)


def speed_result(real: ScanSet, generated: ScanSet) -> MetricResult:
    """Mean network evaluations per scan and median seconds per scan, excluding metrics.

    The median is over batches.
    """
    source = generated.source
    assert isinstance(source, SampledScans)
    # A process without a batch has no samples; the first process always has some.
    figures = {
        "evaluations": statistics.fmean(source.evaluations or [math.nan]),
        "seconds": statistics.median(source.seconds or [math.nan]),
    }
    sizes = {"real": len(real), "real_chosen": "none", "generated": len(generated)}
    protocol = {**asdict(Protocol("speed", "network and solver")), "sizes": sizes}
    return MetricResult("speed", figures, protocol, None)
