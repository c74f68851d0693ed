"""Completion of scans by interpolation: baselines for completion models.

An unknown ray is interpolated between known rays of its column or, without known rays on both
sides, of its row, which is periodic. It returns if the nearest known ray does; its range is
interpolated between known returns.
"""

from typing import Literal

import numpy as np
from numpy import ndarray

Rule = Literal["nearest", "linear", "inverse"]  # inverse: linear in 1 / range


def interpolated(image: ndarray, measured: ndarray, rule: Rule = "inverse") -> ndarray:
    """Fill the unknown rays of an image, (2 or 1, H, W) float32; without known rays it is 0.

    1 / range is nearly linear in elevation along a column on a plane, such as the ground, and so in
    the row for even beams.

    Args:
        measured: Known rays, (H, W) bool.
        rule: The rule of ranges; reflectance is nearest or linear.
    """
    image = image * measured
    if measured.all() or not measured.any():
        return image
    along_columns, done = _along(image.swapaxes(1, 2), measured.T, rule)
    filled = along_columns.swapaxes(1, 2)
    done = done.T
    if not done.all():
        columns = image.shape[2]
        ring, _ = _along(np.tile(filled, 3), np.tile(done, 3), rule)
        filled = np.where(done, filled, ring[..., columns : 2 * columns])
        empty = ~done.any(1)
        rows = np.flatnonzero(~empty)  # a row without known rays takes the nearest filled row
        nearest = abs(np.flatnonzero(empty)[:, None] - rows).argmin(1)
        filled[:, empty] = filled[:, rows[nearest]]
    return filled.astype(np.float32)


def _along(values: ndarray, known: ndarray, rule: Rule) -> tuple[ndarray, ndarray]:
    """Values and known mask of lines between their known positions; 0 beyond.

    Values are (C, lines, positions).
    """
    count = known.shape[1]
    last = count - 1
    at = np.arange(count)
    lines = np.arange(len(known))[:, None]
    left, right = nearest_known(known)
    fillable = (left >= 0) & (right < count)
    nearest = np.where(right - at < at - left, right, left).clip(0, last)
    returned = known & (values[0] > 0)
    low = nearest
    high = nearest
    if rule != "nearest":
        a, b = nearest_known(returned)
        low = np.where(a < 0, b, a).clip(0, last)
        high = np.where(b >= count, a, b).clip(0, last)
    share = np.where(high > low, (at - low) / np.maximum(high - low, 1), 0)
    source = values.astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        if rule == "inverse":
            source[0] = 1 / source[0]
        filled = (1 - share) * source[:, lines, low] + share * source[:, lines, high]
        if rule == "inverse":
            filled[0] = 1 / filled[0]
    filled = np.where(fillable & returned[lines, nearest], filled, 0)
    return np.where(known, values, filled), known | fillable


def nearest_known(known: ndarray) -> tuple[ndarray, ndarray]:
    """The nearest known positions of each position of a line, (..., L).

    Returns:
        The one at or before it, or -1, and the one at or after it, or L.
    """
    at = np.arange(known.shape[-1])
    left = np.maximum.accumulate(np.where(known, at, -1), axis=-1)
    right = np.where(known, at, len(at))[..., ::-1]
    return left, np.minimum.accumulate(right, axis=-1)[..., ::-1]
