"""Mean and scatter of features, added up in float64 batch by batch, in any order, in any number of processes.

Sums of x x^T lose the variance of features that lie far from 0: (1e4)^2 leaves 1e-8 of float64's digits to a variance
of 1e-4. So the scatter is kept about the mean, and two parts are joined by the parallel formula of Chan, Golub and
LeVeque (1979),

    n = n_a + n_b,  mean = mean_a + n_b / n delta,  M = M_a + M_b + n_a n_b / n delta delta^T,  delta = mean_b - mean_a.

One matrix holds all three, so that processes exchange one tensor: n in the corner, the mean in the rest of the first
row, the scatter M = sum (x - mean)(x - mean)^T below it, (1 + D, 1 + D).
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Moments(NamedTuple):
    """The parts of a matrix of moments: n scans, and views of their mean (D) and scatter (D, D)."""

    n: int
    mean: Tensor
    scatter: Tensor

    @property
    def covariance(self) -> Tensor:
        """M / (n - 1), the unbiased estimate, as numpy.cov; needs two scans."""
        return self.scatter / (self.n - 1)


def no_moments(dim: int) -> Tensor:
    """Of no scan at all, (1 + D, 1 + D)."""
    return torch.zeros(1 + dim, 1 + dim, dtype=torch.float64)


def moments(matrix: Tensor) -> Moments:
    """The parts of a matrix of moments."""
    return Moments(int(matrix[0, 0]), matrix[0, 1:], matrix[1:, 1:])


def add_moments(matrix: Tensor, rows: Tensor) -> None:
    """Add features (B, D) of any precision to a matrix of moments, in place."""
    if not len(rows):
        return
    x = rows.to(matrix)
    mean = x.mean(0)
    _join(matrix, len(x), mean, x - mean)


def merge_moments(parts: Tensor) -> Tensor:
    """Moments of several processes, (P, 1 + D, 1 + D), as those of one."""
    merged = parts[0].clone()
    for part in parts[1:]:
        other = moments(part)
        if other.n:
            merged[1:, 1:] += other.scatter
            _join(merged, other.n, other.mean, other.mean.new_zeros(0, len(other.mean)))
    return merged


def _join(matrix: Tensor, n: int, mean: Tensor, centred: Tensor) -> None:
    """Add n rows with a mean and the scatter of the `centred` rows, (B, D)."""
    old = moments(matrix)
    total = old.n + n
    delta = mean - old.mean
    # The means' own difference is one more row: one product in place, where D = 4096 makes every copy 134 MB.
    rows = torch.cat([centred, delta[None] * (old.n * n / total) ** 0.5])
    old.scatter.addmm_(rows.T, rows)
    old.mean.add_(delta, alpha=n / total)
    matrix[0, 0] = total
