"""The time at which a spinning LiDAR would have measured a ray, from those of measured points."""

from math import pi

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError

_TURN = 2 * pi
_CYCLE = 4  # rows after which an Ouster's beams look the same way again
_MOST_ODD = 0.1  # share of points whose times may contradict the turning, by an eighth of a turn


def times_of(
    time: ndarray,
    row: ndarray,
    azimuth: ndarray,
    asked_row: ndarray,
    asked_azimuth: ndarray,
    name: str = "time",
) -> ndarray:
    """The times of rays, (K,), in the type, unit and zero of the measured times.

    A row looks some angle ahead of the sensor's head (`_ahead`). A ray's time is that of the
    measured point nearest by the angle of the head, in its row or else in the nearest measured
    one, plus the turn between them over the speed. No time is outside the sweep.

    Args:
        time: Times of the measured points, (N,), of any unit: absolute or relative, integer or not.
        row: Their rows in the answer's image, (N,); -1 for points outside it.
        azimuth: Their azimuths in radians, (N,).
        asked_row: Rows of the rays, (K,).
        asked_azimuth: Azimuths of the rays in radians, (K,).
        name: Of the field, for messages.

    Raises:
        InputError: The times are constant, do not follow the azimuth, or are no numbers.
    """
    cure = f" Give --columns {name}=_, and it is kept for measured points alone."
    if time.dtype.kind not in "iuf" or time.ndim != 1:
        raise InputError(f"its field {name} is {time.dtype}, no time a point.{cure}")
    usable = np.isfinite(time)
    if not usable.any():
        raise InputError(f"its field {name} has no finite time.{cure}")
    native = time.astype(time.dtype.newbyteorder("="))
    first = native[usable].min()
    last = native[usable].max()
    if first == last:
        raise InputError(f"its field {name} is {first} for every point.{cure}")
    usable &= row >= 0
    since = (native[usable] - first).astype(float)  # exact in integers
    row = row[usable]
    azimuth = azimuth[usable]
    rate = _rate(since, row, azimuth)
    if not rate:
        raise InputError(f"its field {name} has too few times a row.{cure}")
    rows = max(row.max(initial=0), asked_row.max(initial=0)) + 1
    head = since / rate
    ahead = _ahead(azimuth - head, row, rows)
    angle = azimuth - ahead[row]
    if np.mean(np.cos(angle - head) < np.cos(pi / 4)) > _MOST_ODD:
        raise InputError(
            f"its field {name} does not follow the azimuth in its rows: times run backwards or "
            f"jump.{cure}"
        )
    asked = asked_azimuth - ahead[asked_row]
    near = _nearest(row, angle, asked_row, asked)
    turned = (asked - angle[near] + pi) % _TURN - pi
    found = (since[near] + rate * turned).clip(0, last - first)
    if time.dtype.kind == "f":
        return np.minimum(float(first) + found, float(last)).astype(time.dtype)
    return (first + np.rint(found).astype(native.dtype)).astype(time.dtype)


def _rate(time: ndarray, row: ndarray, azimuth: ndarray) -> float:
    """Time per radian, negative for a clockwise turn: the median of points a sixth of a row apart;
    0 without such points.
    """
    azimuth = azimuth % _TURN
    order = np.lexsort((azimuth, row))
    step = len(row) // (6 * max(len(np.unique(row)), 1)) + 1
    turned = azimuth[order][step:] - azimuth[order][:-step]
    passed = time[order][step:] - time[order][:-step]
    within = (row[order][step:] == row[order][:-step]) & (turned > 1e-4)
    return float(np.median(passed[within] / turned[within])) if within.any() else 0.0


def _ahead(angle: ndarray, row: ndarray, rows: int) -> ndarray:
    """How far each row looks ahead of the head in radians, (H,), by the mean of its points.

    That of a row without points lies between those of its neighbours; of an Ouster, each of
    `_CYCLE` rows looks further than the one before it, by equal steps.
    """
    known, place = np.unique(row, return_inverse=True)
    look = np.exp(1j * angle)
    mean = look.sum()
    turned = look / mean
    ahead = np.angle(np.bincount(place, turned.real) + 1j * np.bincount(place, turned.imag))
    phase = known % _CYCLE
    cycle = np.zeros(rows)
    if np.ptp(phase):
        step, first = np.polyfit(phase, ahead, 1)
        if np.median(abs(ahead - first - step * phase)) < abs(step) / 10:
            cycle = step * (np.arange(rows) % _CYCLE)
    return np.angle(mean) + cycle + np.interp(np.arange(rows), known, ahead - cycle[known])


def _nearest(row: ndarray, angle: ndarray, asked_row: ndarray, asked: ndarray) -> ndarray:
    """The point of each ray, (K,), that is nearest by angle, in the nearest row with points."""
    known = np.unique(row)
    rows = np.arange(asked_row.max(initial=0) + 1)
    instead = known[abs(rows[:, None] - known).argmin(axis=1)]
    # Every row takes three turns: its points, and the same a turn before and after.
    key = 3 * _TURN * row + angle % _TURN
    keys = np.concatenate([key - _TURN, key, key + _TURN])
    order = np.argsort(keys)
    keys = keys[order]
    wanted = 3 * _TURN * instead[asked_row] + asked % _TURN
    after = np.searchsorted(keys, wanted)
    before_is_nearer = wanted - keys[after - 1] < keys[after] - wanted
    return order[after - before_is_nearer] % len(row)
