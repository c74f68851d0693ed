"""Confidence intervals of a metric by a weighted bootstrap over scans."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from r2flow.metrics.base import SIDES, ScanMetric, Side
from r2flow.noise import generator

LEVEL = 0.95  # nominal coverage
DRAWS = 2**63  # random index of the first draw; scans use indices from 0
AT_ONCE = 20  # weighted sets per call of the metric
A = 0.25  # change of a scan's weight


def bootstrap(
    metric: ScanMetric, draws: int = 200, seed: int = 0, advance: Callable[[int], None] | None = None
) -> dict[str, tuple[float, float]]:
    """Intervals of a metric's values d for their expectation at this set size: d exp(-+ t sigma / d).

    Every scan gets the weight 1 + a e, then 1 - a e, with random signs e of sum 0, which gives values d_+ and d_-. For
    a value smooth in its scans, with a linear part of variance L and a part from pairs of scans of variance Q,

        l = (d_+ - d_-) / (2 a),  Var l = L + 2 Q,        q = (d_+ + d_-) / (2 a^2),  Var q = Q,

    so that sigma^2 = Var l - Var q estimates its variance, L + Q (Efron and Stein 1981). Efron's bootstrap, which
    repeats scans, has variance L + 3 Q: for nearly equal sets, where L vanishes, its intervals are 1.7 times too wide.
    The weights change little, because repeated or missing scans also bias the distance. t is Student's quantile. The
    interval is d +- t sigma if t sigma > d, for positive d cut off at 0.

    Weights act on the stored rows of all processes (`keep=True`), without copies or further network evaluations. Of the
    `draws` weighted sets, two are made per draw r of signs, which depends only on the seed and r; `advance` is called
    with the number of finished ones. The result has (low, high) by name. A value that cannot be resampled
    (`ScanMetric.resamples`, `resampled`, `fewest`) has no interval.
    """
    if not metric.resamples:
        return {}
    assert metric.keeps, "build the metric with keep=True"
    assert draws >= 4, f"an interval needs 4 draws, found {draws}"
    with metric.sync_context():
        values = {name: value for name, value in metric.figures()[0].items() if not np.isnan(value)}
        sizes = {side: metric.count(side) for side in SIDES}
        if not values or min(sizes.values()) < max(metric.fewest, 2):
            return {}
        drawn: dict[str, list[Tensor]] = {}
        for start in range(0, draws // 2, AT_ONCE // 2):
            signs = range(start, min(start + AT_ONCE // 2, draws // 2))
            for name, figures in metric.resampled(_weights(sizes, signs, seed)).items():
                drawn.setdefault(name, []).append(figures.view(2, -1))
            if advance:
                advance(2 * len(signs))
    intervals = {name: _interval(values[name], torch.cat(drawn[name], 1).numpy()) for name in values if name in drawn}
    return {name: (low, min(high, metric.highest)) for name, (low, high) in intervals.items()}


def _weights(sizes: dict[Side, int], draws: range, seed: int) -> dict[Side, Tensor]:
    """Weights 1 + a e for each draw of signs, then 1 - a e, (2 R, N) per side."""
    signs: dict[Side, list[np.ndarray]] = {side: [] for side in sizes}
    for r in draws:
        draw = generator(seed, "evaluation", DRAWS + r)
        for side, n in sizes.items():
            balanced = np.resize([1.0, -1.0], n)
            balanced[: n % 2] = 0.0  # an odd scan keeps its weight
            signs[side].append(draw.permutation(balanced))
    changes = {side: A * torch.from_numpy(np.stack(rows)) for side, rows in signs.items()}
    return {side: torch.cat([1 + change, 1 - change]) for side, change in changes.items()}


def _interval(value: float, drawn: np.ndarray) -> tuple[float, float]:
    """Interval around a value, from the values of weighted sets, (2, R)."""
    from scipy.special import stdtrit  # quantiles of Student's t

    linear = np.square(drawn[0] - drawn[1]).mean() / (2 * A) ** 2
    paired = drawn.mean(0).var(ddof=1) / A**4
    sigma = math.sqrt(max(linear - paired, linear / 2))  # L + Q is at least half of L + 2 Q
    half = float(stdtrit(drawn.shape[1], (1 + LEVEL) / 2)) * sigma
    if half < value:  # distances vary by factors
        return value * math.exp(-half / value), value * math.exp(half / value)
    return value - half if value < 0 else max(value - half, 0.0), value + half
