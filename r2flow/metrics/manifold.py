"""Precision, recall, density and coverage of generated scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, blocks
from r2flow.metrics.features import FeatureMetric

NEIGHBOURS = 5  # k
BLOCK = 2000  # scans per block: the distances take 32 MB
TIE = 1e-9  # relative tolerance: neighbours at exactly the radius count as inside
NAMES = ("precision", "recall", "density", "coverage")


class Manifold(FeatureMetric):
    """Precision, recall, density and coverage of generated scans in a network's feature space.

    A set is represented by balls around its scans, with the distance to the k-th nearest neighbour in the set as
    radius. Kynkaanniemi et al. (2019): precision is the share of generated scans inside a real ball, recall the share
    of real scans inside a generated ball. Naeem et al. (2020): density is the mean number of real balls that contain a
    generated scan, over k (it may exceed 1 and is robust to outliers), coverage the share of real balls that contain a
    generated scan.

    There are no bootstrap intervals: balls around repeated scans have radius 0, and with fixed balls, 95 % intervals
    had a coverage of 76 to 81 %.

    The values are named `precision_<network>` and so on.
    """

    kind = "manifold"
    settings: ClassVar[Mapping[str, Any]] = {"neighbours": NEIGHBOURS, "distance": "Euclidean"}
    keeping = True
    resamples = False

    def figures(self) -> tuple[dict[str, float], list[str]]:
        names = [f"{name}_{self.name.removeprefix('manifold_')}" for name in NAMES]
        few = [side for side in SIDES if self.count(side) <= NEIGHBOURS]
        if few:
            remark = f"{self.name}: too few {' and '.join(few)} scans to have {NEIGHBOURS} neighbours each."
            return dict.fromkeys(names, float("nan")), [remark]
        real, generated = self.kept("real"), self.kept("generated")
        middle = real[:BLOCK].double().mean(0)
        in_real, in_generated = (radii(rows, NEIGHBOURS, middle) * (1 + TIE) for rows in (real, generated))
        balls = torch.zeros(len(generated), dtype=torch.float64)
        recalled, covered = (torch.zeros(len(real), dtype=torch.bool) for _ in range(2))
        for i, x in blocks(real, BLOCK):
            for j, y in blocks(generated, BLOCK):
                d = squared_distances(x - middle, y - middle)
                within = d <= in_real[i, None]
                balls[j] += within.sum(0)
                covered[i] |= within.any(1)
                recalled[i] |= (d <= in_generated[j]).any(1)
        values = (balls > 0, recalled, balls / NEIGHBOURS, covered)
        return {name: float(value.double().mean()) for name, value in zip(names, values, strict=True)}, []


def radii(rows: Tensor, k: int, middle: Tensor) -> Tensor:
    """Squared distance of each row to its k-th nearest neighbour, (N,); `middle` is subtracted for accuracy."""
    squared = []
    for i, x in blocks(rows, BLOCK):
        nearest = torch.full((len(x), k), torch.inf, dtype=torch.float64)
        for j, y in blocks(rows, BLOCK):
            d = squared_distances(x - middle, y - middle)
            if i == j:
                d.fill_diagonal_(torch.inf)
            nearest = torch.cat([nearest, d], 1).topk(k, largest=False).values
        squared.append(nearest.amax(1))
    return torch.cat(squared)


def squared_distances(x: Tensor, y: Tensor) -> Tensor:
    """|x - y|^2 of all pairs, (N, M), by matrix products; rounding errors of equal rows are set to 0."""
    size = x.square().sum(1)[:, None] + y.square().sum(1)
    d = size - 2 * x @ y.T
    return d.masked_fill_(d <= 1e-12 * size, 0)
