"""Kernel distance between features: an unbiased relative of the Frechet distance for few scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from r2flow.metrics.base import SIDES, blocks
from r2flow.metrics.features import FeatureMetric

BLOCK = 2000  # scans: their kernel takes 32 MB


class KernelDistance(FeatureMetric):
    """Squared MMD with a cubic kernel, the KID of Binkowski et al. (2018), by its unbiased estimate.

    MMD^2 = mean_{i != j} k(x_i, x_j) + mean_{i != j} k(y_i, y_j) - 2 mean k(x_i, y_j), k(a, b) = (a . b / D + 1)^3 on D
    features. It expects the same value from few scans as from many, and may fall below 0 for that. The field takes the
    mean over random subsets of 1000 scans; this is the mean over all subsets, exactly, and no draw decides.
    """

    kind = "kid"
    settings: ClassVar[Mapping[str, Any]] = {"kernel": "(a b / D + 1)^3", "estimate": "unbiased, all pairs"}
    keeping = True
    resamples = False  # scans that are drawn twice would be pairs of equal ones, and the estimate biased

    def figures(self) -> tuple[dict[str, float], list[str]]:
        if any(self.count(side) < 2 for side in SIDES):
            return {self.name: float("nan")}, [f"{self.name} needs two scans of each set."]
        x, y = (self.kept(side) for side in SIDES)
        return {self.name: _mean(x, x) + _mean(y, y) - 2 * _mean(x, y)}, []


def _mean(x: Tensor, y: Tensor) -> float:
    """Mean of k - 1 over all pairs of two sets; of one and the same set, without pairs of a scan and itself."""
    within = x is y
    total = sum(_sum(a, b, within and i == j) for i, a in blocks(x, BLOCK) for j, b in blocks(y, BLOCK))
    return total / (len(x) * (len(y) - within))


def _sum(x: Tensor, y: Tensor, own: bool) -> float:
    """Sum of k - 1 over the pairs of features (m, D) and (n, D); the 1 drops out of MMD^2 and would cost digits."""
    z = x @ y.T / x.shape[1]
    kernel = z * (3 + z * (3 + z))  # (z + 1)^3 - 1
    return float(kernel.sum() - (kernel.trace() if own else 0))
