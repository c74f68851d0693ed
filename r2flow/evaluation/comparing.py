"""Comparisons of sets of scans; those of sampled sets are stored, so that an interrupted evaluation resumes."""

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from r2flow.data.sets import ScanSet
from r2flow.errors import check
from r2flow.evaluation import measuring
from r2flow.evaluation.measuring import Cache, MetricResult, Statistics, Work, gather_real, measure, speed_result
from r2flow.evaluation.protocols import Rules
from r2flow.evaluation.sets import baseline_sets, reference_sets
from r2flow.files import read_json, write_file
from r2flow.metrics.base import ScanMetric
from r2flow.metrics.panel import LACKING, PANEL, REFLECTANCE, Panel, mean_distance
from r2flow.plugins import plugin_digests
from r2flow.processes import place
from r2flow.store import checksum

Kind = Literal["judged", "reference", "baseline"]
Pair = tuple[Kind, str, ScanSet, ScanSet]  # kind, name, real scans, scans compared with them


@dataclass(frozen=True)
class Comparison:
    """Results of one set against another."""

    name: str
    real: ScanSet
    generated: ScanSet
    measured: Sequence[MetricResult]
    kind: Kind = "judged"

    @property
    def title(self) -> str:
        return self.name if self.kind == "judged" else f"{self.kind}: {self.name}"


def pairs_of(
    real: ScanSet, judged: Mapping[str, ScanSet], reference: bool | None = None, baselines: bool | None = None
) -> list[Pair]:
    """The judged sets against the real one, with references and baselines; by default (None), if any set is judged."""
    pairs: list[Pair] = [("judged", name, real, scans) for name, scans in judged.items()]
    if reference or (judged and reference is None and len(real) > 1):
        pairs += [("reference", name, *sets) for name, sets in reference_sets(real, judged).items()]
    if baselines or (judged and baselines is None):
        num = min(max((len(scans) for scans in judged.values()), default=len(real)), 1000)
        pairs += [("baseline", name, real, scans) for name, scans in baseline_sets(real, num).items()]
    return pairs


def with_equal_panels(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Leave reflectance out of every panel's mean if a set lacks it, so that all are means of the same lines."""
    panels = [result.figures for c in comparisons for result in c.measured if result.metric == Panel.name]
    lacking = any(math.isfinite(figures[Panel.name]) and math.isnan(figures[REFLECTANCE]) for figures in panels)

    def equal(result: MetricResult) -> MetricResult:
        if result.metric != Panel.name or math.isnan(result.figures[REFLECTANCE]):
            return result
        mean = mean_distance({name: result.figures[name] for name in PANEL if name != REFLECTANCE})
        return replace(result, figures={**result.figures, Panel.name: mean}, remarks=[*result.remarks, LACKING])

    return [replace(c, measured=[*map(equal, c.measured)]) for c in comparisons] if lacking else list(comparisons)


@dataclass
class Comparer:
    """Measures pairs of sets; statistics of a real set are gathered once.

    Results of sampled sets are stored in `folder`, if given, in files named by a hash of all that they depend on.
    """

    metrics: Mapping[str, ScanMetric]
    work: Work
    rules: Rules
    cache: Cache | None
    folder: Path | None
    device: str
    _statistics: dict[int, dict[str, Statistics]] = field(default_factory=dict)

    def __call__(self, kind: Kind, name: str, real: ScanSet, other: ScanSet) -> Comparison:
        """Compare two sets, or read the stored results."""
        path = results = None
        if self.folder is not None and other.source.drawn:
            recipe = {
                "real": real.identity or [real.label, len(real)], "sampled": other.about, "format": measuring.FORMAT,
                "metrics": {name: asdict(metric.protocol) for name, metric in self.metrics.items()},
                "protocol": self.rules.name, "plugins": plugin_digests(), "device": self.device,
            }  # fmt: skip
            path = self.folder / f"{checksum(recipe)[:16]}.json"
            with suppress(OSError, ValueError, TypeError):  # missing or damaged
                results = [MetricResult(**entry) for entry in read_json(path)]
        if results is None:
            if id(real) not in self._statistics:
                self._statistics[id(real)] = gather_real(self.metrics, real, self.work, self.cache, self.rules)
            statistics = self._statistics[id(real)]
            filled = kind == "reference" or any(one.empty < one.scans for one in statistics.values())
            check(filled, f"{real.label}: none of its {len(real)} scans has a return.")
            results = measure(self.metrics, statistics, other, self.work, self.rules)
            if other.source.drawn:
                results.append(speed_result(real, other))
            if path is not None and place()[0] == 0:
                write_file(path, json.dumps([asdict(result) for result in results]))
        return Comparison(name, real, other, results, kind)
