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
    at = np.arange(count)
    left, right = nearest_known(known)
    fillable = (left >= 0) & (right < count)
    nearest = np.where(right - at < at - left, right, left).clip(0, count - 1)
    returned = known & (values[0] > 0)
    filled = np.take_along_axis(values.astype(float), nearest[None], axis=2)
    returns = fillable & (filled[0] > 0)
    if rule != "nearest":
        for line in np.flatnonzero(returned.any(axis=1)):
            places = np.flatnonzero(returned[line])
            stored = values[:, line, places].astype(float)
            if rule == "inverse":
                stored[0] = 1 / stored[0]
            filled[:, line] = [np.interp(at, places, channel) for channel in stored]
            if rule == "inverse":
                filled[0, line] = 1 / filled[0, line]
    return np.where(known, values, np.where(returns, filled, 0)), known | fillable


def nearest_known(known: ndarray) -> tuple[ndarray, ndarray]:
    """The nearest known positions of each position of a line, (..., L).

    Returns:
        The one at or before it, or -1, and the one at or after it, or L.
    """
    at = np.arange(known.shape[-1])
    left = np.maximum.accumulate(np.where(known, at, -1), axis=-1)
    right = np.where(known, at, len(at))[..., ::-1]
    return left, np.minimum.accumulate(right, axis=-1)[..., ::-1]
