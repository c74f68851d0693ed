"""Intervals of a metric's figures, from weighing the scans anew: a weighted bootstrap."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.metrics.base import SIDES, ScanMetric, Side
from r2flow.noise import generator

LEVEL = 0.95  # share of cases that an interval is to hold what is expected in
DRAWS = 2**63  # index of the first draw; indices from 0 on are the noise of scans
AT_ONCE = 20  # sets that a metric is asked for together
A = 0.25  # by how much a scan's weight changes


def bootstrap(
    metric: ScanMetric, draws: int = 200, seed: int = 0, advance: Callable[[int], None] | None = None
) -> dict[str, tuple[float, float]]:
    """Intervals of a metric's figures for what is expected of sets of this size: d times or over exp(t sigma / d).

    Every scan's weight becomes 1 + a e, then 1 - a e, with random signs e that add up to 0: figures d_+ and d_-. Of a
    figure that is smooth in its scans, with a linear part of variance L and a part of pairs of scans of variance Q,

        l = (d_+ - d_-) / (2 a),  Var l = L + 2 Q,        q = (d_+ + d_-) / (2 a^2),  Var q = Q,

    so that sigma^2 = Var l - Var q estimates its variance, L + Q (Efron and Stein 1981). Scans drawn with repetition,
    Efron's bootstrap, spread it by L + 3 Q: near equal sets, where L vanishes, such intervals are 1.7 times too wide.
    Small weights, because sets with some scans left out or repeated have other distances, not only more widely spread
    ones. t is Student's quantile. Where t sigma > d, the interval is d +- t sigma, cut off at 0.

    Weights act on the kept rows, those of all processes: nothing is copied and no network runs again.

    Args:
        metric: Built with `keep=True`, after both sets.
        draws: Weighted sets, two for each draw of signs; draw r of signs depends on the seed and on r alone.
        advance: Called with the number of weighted sets that are done.

    Returns:
        (low, high) of each figure that exists and can be resampled (`ScanMetric.resamples`, `resampled`, `fewest`).
    """
    if not metric.resamples:
        return {}
    assert metric.keeps, "build the metric with keep=True"
    if draws < 4:
        raise InputError(f"an interval needs 4 draws, found {draws}.")
    with metric.sync_context():
        values = {name: value for name, value in metric.figures()[0].items() if not np.isnan(value)}
        sizes = {side: len(metric.kept(side)) for side in SIDES}
        if not values or min(sizes.values()) < max(metric.fewest, 2):
            return {}
        drawn: dict[str, list[Tensor]] = {}
        for start in range(0, draws // 2, AT_ONCE // 2):
            signs = range(start, min(start + AT_ONCE // 2, draws // 2))
            for name, figures in metric.resampled(_weights(sizes, signs, seed)).items():
                drawn.setdefault(name, []).append(figures.view(2, -1))
            if advance:
                advance(2 * len(signs))
    return {name: _interval(values[name], torch.cat(drawn[name], 1).numpy()) for name in values if name in drawn}


def _weights(sizes: dict[Side, int], draws: range, seed: int) -> dict[Side, Tensor]:
    """1 + a e for each draw of signs, then 1 - a e, (2 R, N) of each side."""
    signs: dict[Side, list[np.ndarray]] = {side: [] for side in sizes}
    for r in draws:
        draw = generator(seed, "evaluation", DRAWS + r)
        for side, n in sizes.items():
            balanced = np.resize([1.0, -1.0], n)
            balanced[: n % 2] = 0.0  # the odd one keeps its weight
            signs[side].append(draw.permutation(balanced))
    changes = {side: A * torch.from_numpy(np.stack(rows)) for side, rows in signs.items()}
    return {side: torch.cat([1 + change, 1 - change]) for side, change in changes.items()}


def _interval(value: float, drawn: np.ndarray) -> tuple[float, float]:
    """Around a figure, from those of weighted sets, (2, R)."""
    from scipy.special import stdtrit  # quantiles of Student's t

    linear = np.square(drawn[0] - drawn[1]).mean() / (2 * A) ** 2
    paired = drawn.mean(0).var(ddof=1) / A**4
    sigma = math.sqrt(max(linear - paired, linear / 2))  # L + Q is at least half of L + 2 Q
    half = float(stdtrit(drawn.shape[1], (1 + LEVEL) / 2)) * sigma
    if half < value:  # a distance spreads by factors: larger ones more than smaller ones
        return value * math.exp(-half / value), value * math.exp(half / value)
    return max(value - half, min(value, 0.0)), value + half
