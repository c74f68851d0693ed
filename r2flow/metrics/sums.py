"""Metrics computed from sums over the scans of a set: histograms, counts."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import check
from r2flow.metrics.base import SIDES, ScanMetric, Side


class SumMetric(ScanMetric):
    """A metric of the sum of rows of a set, in float64; sums of integers are exact in any order."""

    width: ClassVar[int]  # length of a row

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for side in SIDES:
            self.add_state(f"{side}_sum", torch.zeros(self.width, dtype=torch.float64), dist_reduce_fx="sum")

    @abstractmethod
    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        """Compute values from the two sums of rows, (width,) each; zeros if a set has nothing to compare."""

    def accumulate(self, rows: Tensor, side: Side) -> None:
        check(rows.shape[1] == self.width, f"rows of '{self.name}' must be (B, {self.width}), found {(*rows.shape,)}.")
        total: Tensor = getattr(self, f"{side}_sum")
        total += rows.sum(0, dtype=torch.float64).to(total)

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values = self.figures_of(*(getattr(self, f"{side}_sum").cpu().numpy() for side in SIDES))
        if not all(self.given(side) for side in SIDES):
            return dict.fromkeys(values, float("nan")), []
        return values, []
