"""Completion of scans by interpolation: baselines for completion models.

An unknown ray is interpolated between known rays of its column or, without known rays on both sides, of its row, which
is periodic. It returns if the nearest known ray does; its range is interpolated between known returns.
"""

from typing import Literal

import numpy as np

Rule = Literal["nearest", "linear", "inverse"]  # inverse: linear in 1 / range


def interpolated(image: np.ndarray, measured: np.ndarray, rule: Rule = "inverse") -> np.ndarray:
    """Fill the unknown rays of an image, (2 or 1, H, W) float32; an image without known rays is 0.

    1 / range is nearly linear in elevation along a column on a plane, such as the ground, and so in the row for even
    beams. `measured` marks known rays, (H, W) bool. The rule is that of ranges; reflectance is nearest or linear.
    """
    if measured.all() or not measured.any():
        return image * measured
    filled, done = (array.swapaxes(-1, -2) for array in _along((image * measured).swapaxes(1, 2), measured.T, rule))
    if not done.all():
        columns = image.shape[2]
        ring = np.concatenate([filled] * 3, axis=2), np.concatenate([done] * 3, axis=1)
        wide = _along(*ring, rule)[0][..., columns : 2 * columns]
        filled, empty = np.where(done, filled, wide), ~done.any(1)
        rows = np.flatnonzero(~empty)  # a row without known rays takes the nearest filled row
        filled[:, empty] = filled[:, rows[np.abs(np.flatnonzero(empty)[:, None] - rows).argmin(1)]]
    return filled.astype(np.float32)


def _along(values: np.ndarray, known: np.ndarray, rule: Rule) -> tuple[np.ndarray, np.ndarray]:
    """Values and known mask of lines, (C, lines, positions), between their known positions; 0 beyond."""
    count = known.shape[1]
    at, lines = np.arange(count), np.arange(len(known))[:, None]
    left, right = nearest_known(known)
    fillable = (left >= 0) & (right < count)
    nearest = np.where(right - at < at - left, right, left).clip(0, count - 1)
    returned = known & (values[0] > 0)
    back = returned[lines, nearest]
    if rule == "nearest":
        filled = values[:, lines, nearest]
    else:
        a, b = nearest_known(returned)
        low, high = np.where(a < 0, b, a).clip(0, count - 1), np.where(b >= count, a, b).clip(0, count - 1)
        share = np.where(high > low, (at - low) / np.maximum(high - low, 1), 0.0)
        invert = rule == "inverse"
        with np.errstate(divide="ignore", invalid="ignore"):
            source = np.concatenate([1 / values[:1].astype(np.float64) if invert else values[:1], values[1:]])
            filled = (1 - share) * source[:, lines, low] + share * source[:, lines, high]
            filled[0] = 1 / filled[0] if invert else filled[0]
    return np.where(known, values, np.where(back & fillable, filled, 0)), known | fillable


def nearest_known(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest known positions at or before each position of a line, (..., L), or -1, and at or after it, or L."""
    at = np.arange(known.shape[-1])
    left = np.maximum.accumulate(np.where(known, at, -1), axis=-1)
    right = np.minimum.accumulate(np.where(known, at, len(at))[..., ::-1], axis=-1)[..., ::-1]
    return left, right
