"""Verdicts over training seeds: holds, does not hold, cannot tell."""

import math
from collections.abc import Collection, Sequence
from statistics import fmean, stdev

HOLDS, FAILS, UNKNOWN = "holds", "does not hold", "cannot tell"
ERROR = 0.05  # at most so often a verdict is given, either way, where there is no difference


def interval(values: Sequence[float], error: float = ERROR) -> tuple[float, float]:
    """The mean's two-sided interval by Student's t at level 1 - error; all numbers for NaN or fewer than two values."""
    from scipy.special import stdtrit  # quantiles of Student's t

    if len(values) < 2 or any(math.isnan(value) for value in values):
        return -math.inf, math.inf
    half = float(stdtrit(len(values) - 1, 1 - error / 2)) * stdev(values) / math.sqrt(len(values))
    return fmean(values) - half, fmean(values) + half


def all_above_0(margins: Collection[Sequence[float]]) -> str:
    """Whether the means of all margins, each a value for every seed, are above 0.

    It holds where each one's interval lies above 0: that all do by chance is rarer than that one does (Berger 1982).
    It fails where one lies below 0, the error shared among them (the first step of Holm 1979).
    """
    if margins and all(interval(one)[0] > 0 for one in margins):
        return HOLDS
    return FAILS if any(interval(one, ERROR / len(margins))[1] < 0 for one in margins) else UNKNOWN


def any_above_0(margins: Collection[Sequence[float]]) -> str:
    """Whether the mean of at least one margin is above 0: that not all of the opposites are."""
    opposite = all_above_0([[-value for value in one] for one in margins])
    return {HOLDS: FAILS, FAILS: HOLDS, UNKNOWN: UNKNOWN}[opposite]
