"""How alike two sets of scans look from above when each set is added up: the field's JSD."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, Protocol
from r2flow.metrics.birds_eye import BINS, PROTOCOL, js_distance
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric


class JSD(SumMetric):
    """Jensen-Shannon distance between the bird's-eye histograms of all real and of all generated scans.

    sqrt((KL(p || m) + KL(q || m)) / 2), m = (p + q) / 2, natural logarithm: the square root of the divergence, as the
    field prints it (times 100) since Zyrianov et al. (2022). 0 for equal histograms, 0.833 for disjoint ones.

    Args:
        keep: Keep the histogram of every scan, for bootstrap intervals.
        folder: Where to.
    """

    def __init__(self, keep: bool = False, folder: str | Path | None = None) -> None:
        super().__init__(BINS * BINS, keep, folder)

    @property
    def protocol(self) -> Protocol:
        return Protocol("jsd", "bird's-eye histogram", settings={**PROTOCOL, "logarithm": "natural", "root": True})

    def rows(self, scans: Scans) -> Tensor:
        return histograms(scans)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        return {"jsd": js_distance(real, generated)}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        return values, [*remarks, *one_sided("jsd", self.count("real"), self.count("generated"))]


def histograms(scans: Scans) -> Tensor:
    """Counts from above, (B, BINS^2), float64; NaN for a scan without a return there."""
    counts = torch.from_numpy(scans.birds_eye).flatten(1)
    return torch.where(counts.sum(1, keepdim=True) > 0, counts, torch.nan)


def one_sided(name: str, *counts: int) -> list[str]:
    """The remark where one set alone has a return."""
    sides = [side for side, count in zip(SIDES, counts, strict=True) if not count]
    return (
        [f"{name}: no {sides[0]} scan has a return, as far as can be from a set with some."] if len(sides) == 1 else []
    )
