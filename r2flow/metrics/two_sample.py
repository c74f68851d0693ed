"""A two-sample test: can a classifier tell generated scans from real ones?"""

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, Side
from r2flow.metrics.features import FeatureMetric

RIDGE = 1.0  # of the squared weights of standardised features
STEPS = 25  # of Newton's method
SAME = 1e-5  # scores so near are equal


class TwoSample(FeatureMetric):
    """Area under the ROC curve of a logistic regression between two sets (Lopez-Paz and Oquab 2017).

    Each half of both sets, in the order of the scans, is judged by the classifier of the other half, so that
    neighbouring scans of a drive do not stand on both sides. 0.5: it cannot tell them apart; 1: it always can. The
    interval resamples the judged scans.
    """

    kind = "auc"
    names: ClassVar[Mapping[str, str]] = {"handcrafted": "auc", "handcrafted_range": "auc_range"}
    settings: ClassVar[Mapping[str, Any]] = {"classifier": "logistic regression, ridge 1", "folds": "two halves"}
    keeping = True
    fewest = 4  # two to learn from, two to judge

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
    """P(positive > negative) + P(equal) / 2 for scores, (N,) and (M,), that count (R, N) and (R, M) times: (R,)."""
    apart = positive[None] - negative[:, None]
    equal = apart.abs() < SAME * (1 + positive.abs())  # a scan's features differ by rounding from batch to batch
    above = torch.where(equal, 0.5, (apart > 0).double())
    return ((weights @ above) * others).sum(1) / (weights.sum(1) * others.sum(1))


def _halves(count: int) -> tuple[slice, slice]:
    return slice(0, count // 2), slice(count // 2, count)


def _classifier(real: Tensor, generated: Tensor) -> Callable[[Tensor], Tensor]:
    """Scores of features, (N, D) to (N,), by a logistic regression on two sets of equal weight."""
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
