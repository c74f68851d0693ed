"""Comparisons of sets of scans; those of sampled sets are stored, to resume an evaluation."""

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from r2flow.base.errors import InputError
from r2flow.base.files import read_json, write_file
from r2flow.base.processes import rank_and_world_size
from r2flow.data.sets import ScanSet
from r2flow.evaluation.measuring import Measurer, MetricResult, Statistics, key_of, speed_result
from r2flow.evaluation.sets import baseline_sets, reference_sets
from r2flow.metrics.panel import LACKING, PANEL, REFLECTANCE, mean_distance
from r2flow.store import checksum

_Kind = Literal["judged", "reference", "baseline"]
_Pair = tuple[_Kind, str, ScanSet, ScanSet]  # kind, name, real scans, scans compared with them


@dataclass(frozen=True)
class Comparison:
    """Results of one set against another."""

    name: str
    real: ScanSet
    generated: ScanSet
    measured: Sequence[MetricResult]
    kind: _Kind = "judged"

    @property
    def title(self) -> str:
        return self.name if self.kind == "judged" else f"{self.kind}: {self.name}"


Comparisons = Sequence[Comparison]


def pairs_of(
    real: ScanSet,
    judged: Mapping[str, ScanSet],
    reference: bool | None = None,
    baselines: bool | None = None,
) -> list[_Pair]:
    """The judged sets against the real one, with references and baselines.

    By default (None) these are there if any set is judged.
    """
    pairs: list[_Pair] = [("judged", name, real, scans) for name, scans in judged.items()]
    if reference or (judged and reference is None and len(real) > 1):
        for name, sets in reference_sets(real, judged).items():
            pairs.append(("reference", name, *sets))
    if baselines or (judged and baselines is None):
        num = max(map(len, judged.values()), default=len(real))
        for name, scans in baseline_sets(real, min(num, 1000)).items():
            pairs.append(("baseline", name, real, scans))
    return pairs


def with_equal_panels(comparisons: Comparisons) -> list[Comparison]:
    """Leave reflectance out of every panel's mean if a set lacks it.

    All are then means of the same lines.
    """
    panels = [r.figures for c in comparisons for r in c.measured if r.metric == "panel"]
    if not any(math.isnan(f[REFLECTANCE]) and not math.isnan(f["panel"]) for f in panels):
        return list(comparisons)
    return [replace(c, measured=[*map(_without_reflectance, c.measured)]) for c in comparisons]


def _without_reflectance(result: MetricResult) -> MetricResult:
    """A panel whose mean leaves reflectance out; other results are unchanged."""
    if result.metric != "panel" or math.isnan(result.figures[REFLECTANCE]):
        return result
    mean = mean_distance({line: result.figures[line] for line in PANEL if line != REFLECTANCE})
    figures = {**result.figures, "panel": mean}
    return replace(result, figures=figures, remarks=[*result.remarks, LACKING])


@dataclass
class Comparer(Measurer):
    """Measures pairs of sets; statistics of a real set are gathered once.

    Results of sampled sets are stored in `folder`, if given, in files named by a hash of all that
    they depend on.
    """

    folder: Path | None = None
    _statistics: dict[ScanSet, dict[str, Statistics]] = field(default_factory=dict, init=False)

    def __call__(self, kind: _Kind, name: str, real: ScanSet, other: ScanSet) -> Comparison:
        """Compare two sets, or read the stored results."""
        path = self._stored(real, other)
        if path is not None:
            with suppress(OSError, ValueError, TypeError):  # missing or damaged
                results = [MetricResult(**entry) for entry in read_json(path)]
                return Comparison(name, real, other, results, kind)
        if real not in self._statistics:
            self._statistics[real] = self.gather(real)
        truth = self._statistics[real]
        if kind != "reference" and all(one.empty == one.scans for one in truth.values()):
            raise InputError(f"{real.label}: none of its {len(real)} scans has a return.")
        results = self.measure(truth, other)
        if other.source.drawn:
            results.append(speed_result(real, other))
        if path is not None and rank_and_world_size()[0] == 0:
            write_file(path, json.dumps([asdict(result) for result in results]))
        return Comparison(name, real, other, results, kind)

    def _stored(self, real: ScanSet, other: ScanSet) -> Path | None:
        """File of the results of a sampled set; None for other sets."""
        if self.folder is None or not other.source.drawn:
            return None
        keys = [key_of(metric, real, self.rules.name) for metric in self.metrics.values()]
        recipe = {"real": [real.label, len(real)], "sampled": other.about, "metrics": keys}
        return self.folder / f"{checksum(recipe)[:16]}.json"
