"""JSD and MMD of bird's-eye histograms, of whole sets and of single scans."""

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial.distance import jensenshannon
from torch import Tensor

from r2flow.metrics.base import Figures, StoredMetric, SumMetric, blocks
from r2flow.metrics.scans import BINS, EXTENT, FAR, NEAR, Scans

_SIGMA = 0.5
_HISTOGRAM = {"bins": BINS, "metres": [-EXTENT, EXTENT], "range": [NEAR, FAR]}


def js_distance(a: ndarray, b: ndarray) -> float:
    """Square root of the Jensen-Shannon divergence (natural logarithm) of two histograms.

    0 if equal, sqrt(ln 2) = 0.833 if disjoint. An empty histogram (a set without returns) has the
    maximum distance to any other.
    """
    if not a.any() or not b.any():
        return math.sqrt(math.log(2)) if a.any() or b.any() else 0.0
    with np.errstate(invalid="ignore"):  # rounding may make the divergence of equal ones negative
        return float(np.nan_to_num(jensenshannon(a.ravel(), b.ravel())))


def _histograms(scans: Scans) -> Tensor:
    """Bird's-eye histograms, (B, BINS^2), float64; NaN for a scan without returns in them."""
    counts = torch.from_numpy(scans.birds_eye).flatten(1)
    return torch.where(counts.any(1, keepdim=True), counts, torch.nan)


class JSD(SumMetric):
    """Jensen-Shannon distance between the bird's-eye histograms of all real and generated scans.

    sqrt((KL(p || m) + KL(q || m)) / 2), m = (p + q) / 2, natural logarithm: the square root of the
    divergence, published times 100 since Zyrianov et al. (2022). 0 for equal histograms, 0.833 for
    disjoint ones.
    """

    name = "jsd"
    representation = "bird's-eye histogram"
    settings: ClassVar = {**_HISTOGRAM, "logarithm": "natural", "root": True}
    width = BINS * BINS
    biased = True

    def rows(self, scans: Scans) -> Tensor:
        return _histograms(scans)

    def figures_of(self, real: ndarray, generated: ndarray) -> Figures:
        return {self.name: js_distance(real, generated)}


class MMD(StoredMetric):
    """Maximum mean discrepancy between bird's-eye histograms of single scans, normalised to sum 1.

    MMD^2 = mean k(p, p') + mean k(q, q') - 2 mean k(p, q), k(a, b) = exp(-|a - b|^2 / (2 sigma^2)),
    sigma = 0.5: the biased estimate of Gretton et al. (2012), without a root and including each
    scan against itself, published times 10^4 since Zyrianov et al. (2022). Computed in float64,
    since float32 would lose the first digits.

    Histograms are stored, 40 kB per scan. 10,000 scans against 10,000 take minutes on one core.
    """

    name = "mmd"
    representation = "bird's-eye histogram"
    settings: ClassVar = {**_HISTOGRAM, "kernel": "Gaussian", "sigma": _SIGMA, "estimate": "biased"}
    biased = True
    fewest = 1

    def rows(self, scans: Scans) -> Tensor:
        return _histograms(scans)

    def value(self, real: Tensor, generated: Tensor) -> float:
        return max(squared_mmd(real, generated, _gaussian_kernel, biased=True), 0.0)


def _gaussian_kernel(a: Tensor, b: Tensor) -> Tensor:
    """k - 1 of histograms (N, D) and (M, D): 1 would cost four digits, since k is close to it."""
    used = (a.sum(0) + b.sum(0)) > 0  # over half of the cells are beyond the mask or always empty
    p = a[:, used] / a.sum(1, keepdim=True)
    q = b[:, used] / b.sum(1, keepdim=True)
    return torch.expm1(squared_distances(p, q).div_(-2 * _SIGMA**2))


def squared_mmd(
    x: Tensor, y: Tensor, kernel: Callable[[Tensor, Tensor], Tensor], biased: bool
) -> float:
    """Squared maximum mean discrepancy of two sets, (N, D) and (M, D), by blocks of rows.

    mean k(x, x') + mean k(y, y') - 2 mean k(x, y); the biased estimate (Gretton et al. 2012)
    includes each row against itself. A constant part of the kernel cancels.
    """

    def mean(a, b):
        total = 0.0
        for i, rows in blocks(a):
            k = kernel(rows, b)
            total += float(k.sum())
            if a is b and not biased:
                total -= float(k.diagonal(i.start).sum())
        others = len(b) - 1 if a is b and not biased else len(b)
        return total / len(a) / others

    x = x.double()
    y = y.double()
    return mean(x, x) + mean(y, y) - 2 * mean(x, y)


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    """|x - y|^2 of all pairs, (N, M), by matrix products; rounding errors of equal rows are 0."""
    size = x.square().sum(1)[:, None] + y.square().sum(1)
    d = size - 2 * x @ y.T
    return d.masked_fill_(d <= 1e-12 * size, 0)
