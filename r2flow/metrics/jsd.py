"""JSD of the field: the bird's-eye histograms of two sets, each added up over its scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, ScanMetric
from r2flow.metrics.birds_eye import BINS, PROTOCOL, js_distance
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric


class JSD(SumMetric):
    """Jensen-Shannon distance between the bird's-eye histograms of all real and of all generated scans.

    sqrt((KL(p || m) + KL(q || m)) / 2), m = (p + q) / 2, natural logarithm: the square root of the divergence, as the
    field prints it (times 100) since Zyrianov et al. (2022). 0 for equal histograms, 0.833 for disjoint ones.
    """

    name = "jsd"
    representation = "bird's-eye histogram"
    settings: ClassVar[Mapping[str, Any]] = {**PROTOCOL, "logarithm": "natural", "root": True}
    width = BINS * BINS

    def rows(self, scans: Scans) -> Tensor:
        return histograms(scans)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        return {self.name: js_distance(real, generated)}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        return values, [*remarks, *one_sided(self)]


class JSDExtrapolated(JSD):
    """The JSD that infinitely many scans of both kinds would have, as far as the present ones can tell.

    Counts of few scans are uneven, which adds c / n to the squared distance of n scans, to first order in 1 / n. Both
    sets are parted into halves; with d(n / 2)^2 the mean over the four pairs of halves, of twice that error,
    d^2 = 2 d(n)^2 - d(n / 2)^2. Whether a scan has an even or an odd number of returns decides its half, so that
    neither the order of the scans nor the number of processes does. Scans of one drive that are alike make the halves
    alike: what is extrapolated is more of the same places, not other ones.
    """

    name = "jsd_extrapolated"
    settings: ClassVar[Mapping[str, Any]] = {**JSD.settings, "extrapolated": "2 d(n)^2 - d(n / 2)^2"}
    width = 2 * BINS * BINS
    resamples = False  # the halves of a resampled set share scans

    def rows(self, scans: Scans) -> Tensor:
        counts = histograms(scans)
        odd = counts.sum(1, keepdim=True) % 2 == 1
        rows = torch.cat([torch.where(odd, 0, counts), torch.where(odd, counts, 0)], 1)
        return torch.where(counts.isfinite().all(1, keepdim=True), rows, torch.nan)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        sides = [side.reshape(2, -1) for side in (real, generated)]
        if not all(half.any() for side in sides for half in side):
            return {self.name: float("nan")}
        whole = js_distance(sides[0].sum(0), sides[1].sum(0)) ** 2
        halves = float(np.mean([js_distance(a, b) ** 2 for a in sides[0] for b in sides[1]]))
        return {self.name: float(np.sqrt(max(2 * whole - halves, 0.0)))}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        value = values[self.name]
        counts = " and ".join(str(self.count(side)) for side in SIDES)
        if np.isnan(value) and all(self.given(side) for side in SIDES):
            remarks.append(
                f"{self.name}: no figure: one half of a set has no scan with a return; halves are the scans with an "
                "even and with an odd number of returns."
            )
        elif value == 0:
            remarks.append(f"{self.name}: 0 is a distance too small for {counts} scans to tell.")
        return values, remarks


def histograms(scans: Scans) -> Tensor:
    """Counts from above, (B, BINS^2), float64; NaN for a scan without a return there."""
    counts = torch.from_numpy(scans.birds_eye).flatten(1)
    return torch.where(counts.sum(1, keepdim=True) > 0, counts, torch.nan)


def one_sided(metric: ScanMetric) -> list[str]:
    """The remark for a comparison in which only one set has a return."""
    empty = [side for side in SIDES if not metric.count(side)]
    if len(empty) != 1:
        return []
    return [f"{metric.name}: no {empty[0]} scan has a return: the largest distance that there is."]
