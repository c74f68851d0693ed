"""Kernel distance between features: an unbiased relative of the Frechet distance for few scans."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, Protocol, ScanMetric
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.features import extract
from r2flow.metrics.frechet import loaded
from r2flow.metrics.scans import Scans
from r2flow.noise import generator

SUBSETS, SUBSET_SIZE = 100, 1000
DRAWS = 2**62  # index of the first subset's draw: those from 0 on are the noise of scans


class KernelDistance(ScanMetric):
    """Mean over 100 random subsets of the squared MMD with a cubic kernel, the KID of Binkowski et al. (2018).

    k(a, b) = (a . b / D + 1)^3 on a network's D features, 1000 scans of each set in a subset, or as many as the smaller
    set has, without repetition; unbiased, so that it may fall below 0. The field's R2DM evaluation computes the same.

    Args:
        extractor: The network, or its name in `EXTRACTORS`.
        keep: Features are always kept.
        folder: Where to.

    Raises:
        InputError: no network of that name, or no weights for it on this machine.
    """

    resamples = False  # it is a mean over subsets already

    def __init__(
        self, extractor: Extractor | str = "embedded", keep: bool = True, folder: str | Path | None = None
    ) -> None:
        super().__init__(True, folder)
        self.extractor = loaded(extractor)
        self.needs_reflectance = self.extractor.needs_reflectance
        self.own_group()

    @property
    def protocol(self) -> Protocol:
        network = self.extractor
        return Protocol(
            metric=f"kid_{network.name}" + ("_random" if network.weights == "random" else ""),
            representation="features of a network",
            extractor=network.name,
            weights=network.weights,
            layer=f"{network.layer}, {network.dim}",
            settings={"kernel": "(a b / D + 1)^3", "subsets": SUBSETS, "subset size": SUBSET_SIZE, "seed": 0},
        )

    def rows(self, scans: Scans) -> Tensor:
        return extract(self.extractor, scans)

    def figures(self) -> tuple[dict[str, float], list[str]]:
        name = self.protocol.metric
        size = min(SUBSET_SIZE, *(self.count(side) for side in SIDES))
        if size < 2:
            return {name: float("nan")}, [f"{name}: needs two scans a side."]
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
    """Numbers of rows (N, D) as their values sort them, (N): that of the scans is nothing to the figure.

    The first few columns decide, and more where they are equal: a channel may be 0 in every scan.
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
