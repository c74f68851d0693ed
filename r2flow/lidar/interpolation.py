"""Scans filled by plain interpolation: the opponents of every model that completes scans.

An unknown ray lies between known ones of its column, or, where these are not on both sides, of its row, whose ring is
closed. Whether it returned is that of the nearest known ray there; its range is interpolated between the known returns.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from r2flow.registry import Registry

Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # known places, their values (n, C), places wanted


def nearest(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The value of the nearest place, the lower one of two as near; (m, C)."""
    right = np.searchsorted(places, wanted).clip(1, max(len(places) - 1, 1))
    left = right - 1
    right = right.clip(max=len(places) - 1)
    return values[np.where(wanted - places[left] <= places[right] - wanted, left, right)]


def linear(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """On the straight line between the two neighbours; beyond the ends, the last value."""
    return np.stack([np.interp(wanted, places, channel) for channel in values.T], axis=1)


def cubic(places: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """On the natural cubic spline, kept within the values of the two neighbours' span by a factor of two."""
    if len(places) < 4:
        return linear(places, values, wanted)
    found = CubicSpline(places, values, bc_type="natural")(wanted.clip(places[0], places[-1]))
    right = np.searchsorted(places, wanted).clip(1, len(places) - 1)
    pair = np.stack([values[right - 1], values[right]])
    middle, span = pair.mean(0), np.ptp(pair, axis=0)
    return found.clip(middle - span, middle + span)


RULES: Registry[Rule] = Registry("interpolation", nearest=nearest, linear=linear, cubic=cubic)


def interpolated(image: np.ndarray, measured: np.ndarray, rule: str, inverse: bool = False) -> np.ndarray:
    """The image with its unknown rays filled; what was measured is as it was.

    Args:
        image: Range in metres and reflectance, (2 or 1, H, W); 0 without a return. Unknown rays are not read.
        measured: Which rays are known, (H, W) bool.
        rule: Name in `RULES`.
        inverse: Whether 1 / range is interpolated: along a column that meets a plane, such as the ground, it is nearly
            linear in elevation.
    """
    fill = RULES[rule]
    done, filled = measured.copy(), image * measured
    for w in range(image.shape[2]):  # along columns
        rows = np.flatnonzero(measured[:, w])
        if len(rows) > 1:
            inner = np.arange(rows[0], rows[-1] + 1)
            wanted = inner[~measured[inner, w]]
            filled[:, wanted, w] = _line(image[:, :, w], rows, wanted, fill, inverse)
            done[wanted, w] = True
    columns = image.shape[2]
    for h in range(image.shape[1]):  # along rows, which are rings
        known, wanted = np.flatnonzero(done[h]), np.flatnonzero(~done[h])
        if len(known) and len(wanted):
            around = np.concatenate([known - columns, known, known + columns])
            filled[:, h, wanted] = _line(filled[:, h], around, wanted, fill, inverse, columns)
    return _rows_beyond(filled, done)


def interpolated_both_ways(image: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Linear in 1 / range, along the column or the row, by which fits the measured rays better (`surfaces`)."""
    filled = interpolated(image, measured, "linear", inverse=True)
    r, error = surfaces(image[0] * measured, measured)
    filled[0] = np.where(np.isfinite(error) & (filled[0] > 0), r, filled[0])
    return filled


OPPONENTS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "nearest": partial(interpolated, rule="nearest"),
    "linear": partial(interpolated, rule="linear"),
    "linear, 1/r": partial(interpolated, rule="linear", inverse=True),
    "linear, 1/r, both ways": interpolated_both_ways,
    "cubic": partial(interpolated, rule="cubic"),
    "cubic, 1/r": partial(interpolated, rule="cubic", inverse=True),
}


def guess(image: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """`interpolated(image, measured, "linear", inverse=True)`, for all lines at once: what a model is told beside.

    An image without any measured ray is 0.
    """
    if measured.all() or not measured.any():
        return image * measured
    filled, done = _along(image * measured, measured, 1)
    if done.all():
        return filled.astype(np.float32)
    columns = image.shape[2]
    ring = np.concatenate([filled] * 3, axis=2), np.concatenate([done] * 3, axis=1)
    wide = _along(*ring, 2, extend=True)[0][..., columns : 2 * columns]
    filled = np.where(done, filled, wide)
    return _rows_beyond(filled, done).astype(np.float32)


def surfaces(r: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ranges where measured returns lie on a surface, and how well they do.

    Along columns and along rows, whose ring is closed, 1 / range of an unknown ray is taken on the straight line
    between the two measured rays next to it, which a plane nearly follows. How well that holds is seen at these two:
    each is predicted by the same rule from its own two neighbours, over a wider gap. The lesser error counts, and of
    the two directions the one with the lesser.

    Args:
        r: Range in metres, (H, W); 0 without a return.
        known: Which rays are measured, (H, W) bool.

    Returns:
        Range in metres and its error, |log(predicted / measured)|, (H, W) each; an infinite error where the neighbours
        did not return, or are not enough.
    """
    columns = r.shape[1]
    upright = [found.T for found in _lines(r.T, known.T)]
    ring = _lines(np.concatenate([r] * 3, axis=1), np.concatenate([known] * 3, axis=1))
    level = [found[:, columns : 2 * columns] for found in ring]
    nearer = level[1] < upright[1]
    return np.where(nearer, level[0], upright[0]), np.where(nearer, level[1], upright[1])


def _lines(r: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`surfaces` along lines, (lines, places)."""
    count = r.shape[1]
    at, lines = np.arange(count), np.arange(len(r))[:, None]
    inverse = np.where(r > 0, 1 / np.where(r > 0, r.astype(np.float64), 1), np.nan)
    left, right = _neighbours(known, at)
    before, after = np.pad(left, ((0, 0), (1, 0)))[:, :-1], np.pad(right, ((0, 0), (0, 1)))[:, 1:]
    before[:, 0], after[:, -1] = -1, count

    def there(values: np.ndarray, places: np.ndarray) -> np.ndarray:
        inside = (places >= 0) & (places < count)
        return np.where(inside, values[lines, places.clip(0, count - 1)], np.nan)

    def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return there(inverse, a) + (there(inverse, b) - there(inverse, a)) * (at - a) / np.maximum(b - a, 1)

    with np.errstate(invalid="ignore"):
        missed = np.where(known, np.abs(np.log(between(before, after) / inverse)), np.nan)
    error = np.fmin(there(missed, left), there(missed, right))
    found = between(left, right)
    said = ~known & np.isfinite(error) & np.isfinite(found)
    return np.where(said, 1 / np.where(said, found, 1), 0.0), np.where(said, error, np.inf)


def _rows_beyond(image: np.ndarray, done: np.ndarray) -> np.ndarray:
    """The image with the nearest filled row in the place of each row of which nothing is known."""
    empty = ~done.any(1)
    if empty.any() and done.any():
        rows = np.flatnonzero(~empty)
        image[:, empty] = image[:, rows[np.abs(np.flatnonzero(empty)[:, None] - rows).argmin(1)]]
    return image


def _along(image: np.ndarray, known: np.ndarray, axis: int, extend: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Fill between known rays along an axis (1 for columns' rows, 2 for rows' columns); and what is known then.

    Args:
        extend: Whether a line with one known ray has that everywhere.
    """
    flat = known.T if axis == 1 else known  # lines, places
    values = np.moveaxis(image, axis, 2) if axis == 1 else image
    count = flat.shape[1]
    at = np.arange(count)
    left, right = _neighbours(flat, at)
    inside = (left >= 0) & (right < count)
    held = (left >= 0) | (right < count) if extend else inside & (flat.sum(1, keepdims=True) > 1)
    lines = np.arange(len(flat))[:, None]
    nearer = np.where((left < 0) | ((right < count) & (right - at < at - left)), right, left).clip(0, count - 1)
    returned = flat & (values[0] > 0)
    back = returned[lines, nearer]
    a, b = _neighbours(returned, at)
    one, other = np.where(a < 0, b, a).clip(0, count - 1), np.where(b >= count, a, b).clip(0, count - 1)
    share = np.where(other > one, (at - one) / np.maximum(other - one, 1), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(values[0] > 0, 1 / values[0].astype(np.float64), 0)
        r = 1 / ((1 - share) * inverse[lines, one] + share * inverse[lines, other])
    rest = [(1 - share) * channel[lines, one] + share * channel[lines, other] for channel in values[1:]]
    found = np.where(back & held, np.stack([np.where(back, r, 0), *rest]), 0)
    found = np.where(flat, values, found)
    done = flat | held
    return (np.moveaxis(found, 2, 1), done.T) if axis == 1 else (found, done)


def _neighbours(known: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The known place at or before each place of a line, -1 where there is none, and the one at or after, or L."""
    count = len(at)
    left = np.maximum.accumulate(np.where(known, at, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, at, count)[:, ::-1], axis=1)[:, ::-1]
    return left, right


def _line(
    values: np.ndarray, places: np.ndarray, wanted: np.ndarray, fill: Rule, inverse: bool, turn: int | None = None
) -> np.ndarray:
    """Values (C, m) at the places wanted from those (C, L) of a line at known places, which may pass a turn's ends."""
    at = places if turn is None else places % turn
    held = values[:, at].T.astype(np.float64)
    returned = nearest(places, held[:, :1] > 0, wanted)[:, 0]
    back = held[:, 0] > 0
    found = np.zeros((len(wanted), len(values)))
    if back.any():
        known = held[back]
        if inverse:
            known[:, 0] = 1 / known[:, 0]
        found = fill(places[back], known, wanted)
        if inverse:
            found[:, 0] = 1 / found[:, 0].clip(known[:, 0].min())  # no farther than the farthest that is known
    return np.where(returned[:, None], found, 0).T
