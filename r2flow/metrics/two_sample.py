"""Classifier two-sample test between generated and real scans."""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, Side
from r2flow.metrics.features import FeatureMetric

RIDGE = 1.0  # L2 penalty on the weights of standardised features
STEPS = 25  # iterations of Newton's method
SAME = 1e-5  # relative tolerance of equal scores


class TwoSample(FeatureMetric):
    """Area under the ROC curve of a logistic regression between two sets (Lopez-Paz and Oquab 2017).

    Each contiguous half of both sets is scored by the classifier trained on the other half, so that neighbouring scans
    of a drive do not leak. 0.5: the sets cannot be distinguished; 1: always distinguished. The interval resamples
    the scored scans for these two classifiers: it contains the mean over new sets of 30 to 100 scans in 70 to 86 %.
    """

    kind = "auc"
    names: ClassVar[Mapping[str, str]] = {"handcrafted": "auc", "handcrafted_range": "auc_range"}
    settings: ClassVar[Mapping[str, Any]] = {"classifier": "logistic regression, ridge 1", "folds": "two halves"}
    keeping = True
    fewest = 4  # two to train on, two to test
    highest = 1.0

    def resampled(self, weights: Mapping[Side, Tensor]) -> dict[str, Tensor]:
        real, generated = (self.kept(side).double() for side in SIDES)
        areas = []
        for turn in (1, -1):
            (learn_real, judge_real), (learn_made, judge_made) = (_halves(len(x))[::turn] for x in (real, generated))
            score = _classifier(real[learn_real], generated[learn_made])
            areas.append(
                area(
                    score(real[judge_real]), score(generated[judge_made]),
                    weights["real"][:, judge_real], weights["generated"][:, judge_made],
                )
            )  # fmt: skip
        return {self.name: torch.stack(areas).mean(0)}


def area(negative: Tensor, positive: Tensor, weights: Tensor, others: Tensor) -> Tensor:
    """P(positive > negative) + P(equal) / 2, (R,), for scores (N,) and (M,) with weights (R, N) and (R, M)."""
    difference = positive[None] - negative[:, None]
    equal = difference.abs() < SAME * (1 + positive.abs())  # features of a scan differ by rounding between batches
    above = torch.where(equal, 0.5, (difference > 0).double())
    return ((weights @ above) * others).sum(1) / (weights.sum(1) * others.sum(1))


def _halves(count: int) -> tuple[slice, slice]:
    return slice(0, count // 2), slice(count // 2, count)


def _classifier(real: Tensor, generated: Tensor) -> Callable[[Tensor], Tensor]:
    """Fit a logistic regression to two sets of equal total weight; return its score function, (N, D) to (N,)."""
    x = torch.cat([real, generated])
    centre, spread = x.mean(0), x.std(0).clamp(min=1e-9)
    x = torch.cat([(x - centre) / spread, x.new_ones(len(x), 1)], 1)
    y = torch.cat([x.new_zeros(len(real)), x.new_ones(len(generated))])
    each = torch.cat([x.new_full((len(part),), len(y) / 2 / len(part)) for part in (real, generated)])
    ridge = torch.eye(x.shape[1], dtype=x.dtype) * RIDGE
    ridge[-1, -1] = 1e-9
    w = x.new_zeros(x.shape[1])
    for _ in range(STEPS):
        p = (x @ w).sigmoid()
        curvature = (x * (each * p * (1 - p))[:, None]).mT @ x + ridge
        w = w - torch.linalg.solve(curvature, x.mT @ (each * (p - y)) + ridge @ w)
    return lambda rows: torch.cat([(rows - centre) / spread, rows.new_ones(len(rows), 1)], 1) @ w
