"""Scans completed by interpolation: the baselines of every model that completes scans.

An unknown ray lies between known ones of its column, or, where these are not on both sides, of its row, whose ring is
closed. Whether it returned is that of the nearest known ray there; its range is interpolated between the known returns.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np

Rule = Literal["nearest", "linear", "inverse"]  # inverse: linear in 1 / range


def interpolated(image: np.ndarray, measured: np.ndarray, rule: Rule = "inverse") -> np.ndarray:
    """The image with its unknown rays filled, float32; 0 where nothing at all is known.

    Along a column that meets a plane, such as the ground, 1 / range is nearly linear in elevation.

    Args:
        image: Range in metres and reflectance, (2 or 1, H, W); 0 without a return. Unknown rays are not read.
        measured: Which rays are known, (H, W) bool.
        rule: How ranges are interpolated; reflectance is nearest or linear.
    """
    if measured.all() or not measured.any():
        return image * measured
    filled, done = (array.swapaxes(-1, -2) for array in _along((image * measured).swapaxes(1, 2), measured.T, rule))
    if not done.all():
        columns = image.shape[2]
        ring = np.concatenate([filled] * 3, axis=2), np.concatenate([done] * 3, axis=1)
        wide = _along(*ring, rule, extend=True)[0][..., columns : 2 * columns]
        filled = _rows_beyond(np.where(done, filled, wide), done)
    return filled.astype(np.float32)


INTERPOLATIONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "nearest": partial(interpolated, rule="nearest"),
    "linear": partial(interpolated, rule="linear"),
    "linear, 1/r": interpolated,
}


def _rows_beyond(image: np.ndarray, done: np.ndarray) -> np.ndarray:
    """The image with the nearest filled row in the place of each row of which nothing is known."""
    empty = ~done.any(1)
    if empty.any() and done.any():
        rows = np.flatnonzero(~empty)
        image[:, empty] = image[:, rows[np.abs(np.flatnonzero(empty)[:, None] - rows).argmin(1)]]
    return image


def _along(values: np.ndarray, known: np.ndarray, rule: Rule, extend: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Fill between the known places of each line, (C, lines, places); and which places are known then.

    With `extend` a line with one known place has its values everywhere.
    """
    count = known.shape[1]
    at, lines = np.arange(count), np.arange(len(known))[:, None]
    left, right = _neighbours(known, at)
    inside = (left >= 0) & (right < count)
    held = (left >= 0) | (right < count) if extend else inside & (known.sum(1, keepdims=True) > 1)
    nearest = np.where((left < 0) | ((right < count) & (right - at < at - left)), right, left).clip(0, count - 1)
    returned = known & (values[0] > 0)
    back = returned[lines, nearest]
    if rule == "nearest":
        filled = values[:, lines, nearest]
    else:
        a, b = _neighbours(returned, at)
        one, other = np.where(a < 0, b, a).clip(0, count - 1), np.where(b >= count, a, b).clip(0, count - 1)
        share = np.where(other > one, (at - one) / np.maximum(other - one, 1), 0.0)
        invert = rule == "inverse"
        with np.errstate(divide="ignore", invalid="ignore"):
            source = np.concatenate([1 / values[:1].astype(np.float64) if invert else values[:1], values[1:]])
            filled = (1 - share) * source[:, lines, one] + share * source[:, lines, other]
            filled[0] = 1 / filled[0] if invert else filled[0]
    return np.where(known, values, np.where(back & held, filled, 0)), known | held


def _neighbours(known: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The known place at or before each place of a line, -1 where there is none, and the one at or after, or L."""
    count = len(at)
    left = np.maximum.accumulate(np.where(known, at, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, at, count)[:, ::-1], axis=1)[:, ::-1]
    return left, right
