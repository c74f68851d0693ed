"""Kernel distance between features, unbiased for few scans unlike the Frechet distance."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, Side, blocks
from r2flow.metrics.features import FeatureMetric

BLOCK = 2000  # scans per block: the kernel takes 32 MB


class KernelDistance(FeatureMetric):
    """Unbiased estimate of squared MMD with a cubic kernel, the KID of Binkowski et al. (2018).

    MMD^2 = mean_{i != j} k(x_i, x_j) + mean_{i != j} k(y_i, y_j) - 2 mean k(x_i, y_j), k(a, b) = (a . b / D + 1)^3 on D
    features. The expectation does not depend on the number of scans; values may be negative. The usual mean over random
    subsets of 1000 scans is replaced by the exact mean over all subsets.
    """

    kind = "kid"
    settings: ClassVar[Mapping[str, Any]] = {"kernel": "(a b / D + 1)^3", "estimate": "unbiased, all pairs"}
    keeping = True
    resamples = False  # repeated scans would form pairs of equal scans and bias the estimate

    def resampled(self, weights: Mapping[Side, Tensor]) -> dict[str, Tensor]:
        x, y = (self.kept(side) for side in SIDES)
        return {self.name: _mean(x, x) + _mean(y, y) - 2 * _mean(x, y)}


def _mean(x: Tensor, y: Tensor) -> Tensor:
    """Mean of k - 1 over all pairs of two sets, which cancels the 1 in MMD^2; if x is y, without pairs of a scan with
    itself."""
    total = x.new_zeros((), dtype=torch.float64)
    for i, a in blocks(x, BLOCK):
        for j, b in blocks(y, BLOCK):
            z = a @ b.T / x.shape[1]
            kernel = z * (3 + z * (3 + z))  # (z + 1)^3 - 1
            total += kernel.sum() - (kernel.trace() if x is y and i == j else 0)
    return total / (len(x) * (len(y) - (x is y)))
