"""The time at which a spinning LiDAR would have measured a ray, from those of measured points."""

from math import pi
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError

FEWEST = 8  # points of a row whose times are used
APART = 10  # degrees between points from which the rate of turning is found
CYCLE = 4  # rows after which an Ouster's beams look the same way again
LEAST_STEP = np.radians(0.5)  # by which they look further in each
MOST_ODD = 0.1  # share of such points whose times may contradict the turning


class _Turning(NamedTuple):
    """Measured points of a scan, sorted by row and azimuth."""

    key: ndarray  # 2 pi row + azimuth, ascending
    azimuth: ndarray  # in [0, 2 pi)
    time: ndarray  # since the first point
    start: ndarray  # of each row the place of its first point, (H + 1,)
    rate: float  # time per radian, negative for a clockwise turn


def times_of(
    time: ndarray,
    row: ndarray,
    azimuth: ndarray,
    asked_row: ndarray,
    asked_azimuth: ndarray,
    name: str = "time",
) -> ndarray:
    """The times of rays, (K,), in the type, unit and zero of the measured times.

    In a row with measured points, a ray's time is interpolated in azimuth between its neighbours;
    at the turn's start, where they are a turn apart, it continues the nearer one's at the rate of
    turning. In a row without, it is the mean of those in the measured rows above and below, by
    their distance; of an Ouster, at the azimuths at which they fire with it (`_ahead`). No time is
    outside the sweep.

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
    if time.dtype.kind not in "iuf" or time.ndim != 1:
        raise InputError(f"its field {name} is {time.dtype}, no time a point.{_cure(name)}")
    kind = time.dtype
    usable = np.isfinite(time) if kind.kind == "f" else np.ones(len(time), bool)
    if not usable.any():
        raise InputError(f"its field {name} has no finite time.{_cure(name)}")
    native = time.astype(kind.newbyteorder("="))
    first = native[usable].min()
    since = np.where(usable, native - first, 0).astype(float)  # exact in integers
    last = since.max()
    if last == 0:
        raise InputError(f"its field {name} is {first} for every point.{_cure(name)}")
    turning = _turning(since, row, azimuth, usable & (row >= 0), name)
    found = np.clip(_in_turn(turning, asked_row, asked_azimuth), 0, last)
    if kind.kind == "f":
        return np.minimum(float(first) + found, float(native[usable].max())).astype(kind)
    return (first + np.rint(found).astype(native.dtype)).astype(kind)


def _cure(name: str) -> str:
    return f" Give --columns {name}=_, and it is kept for measured points alone."


def _turning(time: ndarray, row: ndarray, azimuth: ndarray, usable: ndarray, name: str) -> _Turning:
    azimuth = azimuth % (2 * pi)
    count = np.bincount(row[usable], minlength=1)
    usable = usable & (count[row.clip(0, len(count) - 1)] >= FEWEST)
    chosen = np.flatnonzero(usable)
    key = 2 * pi * row[chosen] + azimuth[chosen]
    order = chosen[np.argsort(key, kind="stable")]
    start = np.searchsorted(row[order], np.arange(len(count) + 1))
    turn, clock = azimuth[order], time[order]
    step = max(1, round(len(order) / max((count >= FEWEST).sum(), 1) * APART / 360))
    turned = turn[step:] - turn[:-step]
    passed = clock[step:] - clock[:-step]
    within = (row[order][step:] == row[order][:-step]) & (turned > 1e-4)
    if not within.any():
        raise InputError(f"its field {name} has too few times a row.{_cure(name)}")
    rate = float(np.median(passed[within] / turned[within]))
    whole = 2 * pi * abs(rate)
    odd = passed[within] - rate * turned[within]
    odd -= whole * np.rint(odd / whole) if whole else 0
    if not whole or np.mean(abs(odd) > whole / 8) > MOST_ODD:
        raise InputError(
            f"its field {name} does not follow the azimuth in its rows: times run backwards or "
            f"jump.{_cure(name)}"
        )
    return _Turning(2 * pi * row[order] + turn, turn, clock, start, rate)


def _in_turn(turning: _Turning, row: ndarray, azimuth: ndarray) -> ndarray:
    """Times of rays, (K,), before they are limited to the sweep."""
    filled = np.flatnonzero(np.diff(turning.start))
    after = np.searchsorted(filled, row)
    above = filled[(after - 1).clip(0)]
    below = filled[after.clip(max=len(filled) - 1)]
    above = np.where(below <= row, below, above)  # a measured row is both
    ahead = _ahead(turning, max(int(row.max(initial=0)) + 1, len(turning.start)))
    upper = _in_row(turning, above, azimuth + ahead[row] - ahead[above])
    other = _in_row(turning, below, azimuth + ahead[row] - ahead[below])
    lower = np.where(below == above, upper, other)
    up, down = abs(row - above), abs(below - row)
    return _between(upper, lower, up, down, 2 * pi * abs(turning.rate))


def _ahead(turning: _Turning, rows: int) -> ndarray:
    """How far each row looks ahead of the sensor's azimuth in radians, (H,), if rows are those of
    an Ouster: each looks further than the one above, and every `CYCLE`-th as the first. Else 0.

    So rows without measured points, between others, are known too.
    """
    filled = np.flatnonzero(np.diff(turning.start) >= FEWEST)
    place = np.repeat(np.arange(len(turning.start) - 1), np.diff(turning.start))
    look = np.exp(1j * (turning.time / turning.rate - turning.azimuth))
    of_row = np.bincount(place, look.real) + 1j * np.bincount(place, look.imag)
    looks = np.angle(of_row[filled] / of_row[filled].sum())
    phase = filled % CYCLE
    if len(set(phase)) < 2:
        return np.zeros(rows)
    step, first = np.polyfit(phase, looks, 1)
    off = abs(looks - first - step * phase)
    if abs(step) < LEAST_STEP or np.median(off) > abs(step) / 10:
        return np.zeros(rows)
    return step * (np.arange(rows) % CYCLE)


def _in_row(turning: _Turning, row: ndarray, azimuth: ndarray) -> ndarray:
    azimuth = azimuth % (2 * pi)
    first, end = turning.start[row], turning.start[row + 1]
    place = np.searchsorted(turning.key, 2 * pi * row + azimuth).clip(first, end)
    right = np.where(place == end, first, place)
    left = np.where(place == first, end, place) - 1
    before = (azimuth - turning.azimuth[left]) % (2 * pi)
    after = (turning.azimuth[right] - azimuth) % (2 * pi)
    rate = turning.rate
    return _between(
        turning.time[left] + rate * before,
        turning.time[right] - rate * after,
        before,
        after,
        2 * pi * abs(rate),
    )


def _between(one: ndarray, other: ndarray, near: ndarray, far: ndarray, turn: float) -> ndarray:
    """Times between two, by the distances to them; a turn apart, that of the nearer one."""
    apart = near + far
    share = np.where(apart > 0, near / np.where(apart > 0, apart, 1), 0)
    split = abs(one - other) > turn / 2
    return np.where(split & (near > far), other, np.where(split, one, one + share * (other - one)))
