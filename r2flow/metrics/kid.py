"""Kernel distance between features: an unbiased relative of the Frechet distance for few scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.metrics.base import SIDES
from r2flow.metrics.features import FeatureMetric
from r2flow.noise import generator

SUBSETS, SUBSET_SIZE = 100, 1000
DRAWS = 2**62  # index of the first subset's draw; indices from 0 on are the noise of scans


class KernelDistance(FeatureMetric):
    """Mean over 100 random subsets of the squared MMD with a cubic kernel, the KID of Binkowski et al. (2018).

    k(a, b) = (a . b / D + 1)^3 on a network's D features. A subset has 1000 scans of each set, or as many as the
    smaller set has, without repetition. The estimate is unbiased, so that it may fall below 0. R2DM's evaluation
    computes the same.
    """

    kind = "kid"
    settings: ClassVar[Mapping[str, Any]] = {
        "kernel": "(a b / D + 1)^3", "subsets": SUBSETS, "subset size": SUBSET_SIZE, "seed": 0
    }  # fmt: skip
    keeping = "always"
    resamples = False  # it is a mean over subsets already
    of_equal_sets = None

    def figures(self) -> tuple[dict[str, float], list[str]]:
        name = self.name
        size = min(SUBSET_SIZE, *(self.count(side) for side in SIDES))
        if size < 2:
            return {name: float("nan")}, [f"{name} needs two scans of each set."]
        both = [self.store(side).tensor() for side in SIDES]
        orders = [own_order(rows.numpy()) for rows in both]
        values = []
        for k in range(SUBSETS):
            draw = generator(0, "evaluation", DRAWS + k)
            chosen = [np.sort(draw.choice(order, size, replace=False)) for order in orders]
            x, y = (rows[torch.from_numpy(which)].double() for rows, which in zip(both, chosen, strict=True))
            values.append(cubic_mmd(x, y))
        return {name: float(np.mean(values))}, []


def own_order(rows: np.ndarray) -> np.ndarray:
    """The order of rows (N, D) by their values, (N), so that the order of the scans does not change the figure.

    The first few columns decide, and more where these are equal: a channel may be 0 in every scan.
    """
    columns = 4
    while True:
        order = np.lexsort(rows[:, :columns].T)
        head = rows[order, :columns]
        if columns >= rows.shape[1] or not (head[1:] == head[:-1]).all(1).any():
            return order
        columns *= 4


def cubic_mmd(x: Tensor, y: Tensor) -> float:
    """Unbiased squared MMD between features (m, D) and (m, D), k(a, b) = (a . b / D + 1)^3."""
    m, dim = x.shape

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        return (a @ b.T / dim + 1) ** 3

    within = sum(k.sum() - k.trace() for k in (kernel(x, x), kernel(y, y)))
    return float(within / (m * (m - 1)) - 2 * kernel(x, y).mean())
