"""JSD of the field: the bird's-eye histograms of two sets, each added up over its scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

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


def histograms(scans: Scans) -> Tensor:
    """Counts from above, (B, BINS^2), float64; NaN for a scan without a return there."""
    counts = torch.from_numpy(scans.birds_eye).flatten(1)
    return torch.where(counts.sum(1, keepdim=True) > 0, counts, torch.nan)
