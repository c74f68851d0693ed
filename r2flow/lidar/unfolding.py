"""Scan unfolding: the row of a point is the laser that fired it, not that of its elevation."""

from math import pi

import numpy as np
from numpy import ndarray
from scipy import ndimage

from r2flow.base.errors import InputError
from r2flow.lidar.sensors import Convention, Sensor

_NOISE = 0.1  # degrees by which a laser may lie above that of the row before it in any case
_FEW = 5  # returns below which the median elevation of a ring is not known
# limits of the number of beams
FEWEST = 4
MOST = 256
TIGHT = 0.1  # scatter below which points of one beam are together
_BACK = 1 / 12  # of a turn, by which azimuths fall back at a new ring; at most half its width
_NEARBY = 1 / 36  # of a turn: neighbouring points are nearer
_CURE = "Use the spherical projection, which finds rows by elevation."


def unfolded_rows(
    xyz: ndarray, sensor: Sensor, convention: Convention, ring: ndarray | None
) -> ndarray:
    """Row of every point, (N,) int64; outside [0, H) for points outside the image.

    Lasers are found by the first of three ways that works: ring numbers; whole firings of H points
    each, including rays without return, in a fixed order of lasers; or ring after ring
    (`rings_from_order`), aligned at the bottom because rings that see only sky are missing at the
    top. Other conventions than `centre` use the last way as published: the ring above the top row
    is in the bottom row; those above it, and points before the first ring's start, in the top.

    Raises:
        InputError: The scan does not unfold into the sensor's rings.
    """
    rows = sensor.shape[0]
    if ring is not None:
        return _rows_from_field(xyz, np.asarray(ring, dtype=int), sensor)
    if convention != "centre":
        ring = np.cumsum(_starts(xyz))
        row = ring - ring.max(initial=0) + rows - 1
        return np.where((ring > 0) & (row >= -1), row % rows, 0)
    firings = _rows_from_firings(xyz, sensor)
    if firings is not None:
        return firings
    order = rings_from_order(xyz)
    if order is None:
        raise InputError(
            "the scan has no ring numbers and is stored neither ring after ring nor in whole "
            f"firings of {rows}, the lasers of sensor '{sensor.name}'. {_CURE}"
        )
    rings = int(order.max()) + 1
    if not rows / 2 <= rings <= rows + 1:
        raise InputError(
            f"the scan unfolds into {rings} rings, but sensor '{sensor.name}' has {rows}. {_CURE}"
        )
    return np.where(order < 0, -1, rows - 1 - order)


def rings_from_order(xyz: ndarray) -> ndarray | None:
    """Ring of every point of a scan stored ring after ring, (N,) int64; None for other scans.

    Rings may begin at any azimuth, turn either way, and follow each other upwards or downwards.
    They are counted from the lowest, because rings that see only sky are missing at the top. Points
    at the origin are rays without return (-1).
    """
    returned = np.flatnonzero(xyz[:, :2].any(axis=1))
    if len(returned) < 2:
        return None
    seen = xyz[returned]
    elevation = elevations_of(seen)
    turn = np.arctan2(seen[:, 1], seen[:, 0]) / np.float32(2 * pi)
    step = np.diff(turn)
    if np.sign(step - np.rint(step)).sum() < 0:  # clockwise, or y to the right
        turn = -turn
    turn = (turn - turn[-1] + _NEARBY) % 1
    every = max(len(turn) // 5000, 1)
    few = elevation[::every]
    # The cut is between the last point and the first.
    places = _NEARBY + (turn[0] - _NEARBY) * np.linspace(0, 1, 19)[1:-1]
    cut = min(places, key=lambda cut: _scatter_of_rings(turn[::every], few, cut))
    ring = _cut_at(turn[::every], cut)
    count = ring[-1] + 1
    if not FEWEST <= count <= MOST:
        return None
    middles = ndimage.median(few, ring, np.arange(count))
    rise = np.diff(middles)
    spread = np.median(abs(few - middles[ring]))
    downwards = np.mean(rise < 0)
    if spread > TIGHT * np.median(abs(few - np.median(few))) or 0.1 < downwards < 0.9:
        return None
    found = _cut_at(turn, _exact_cut(turn, elevation, cut, rise))
    ring = np.full(len(xyz), -1)
    ring[returned] = found[-1] - found if downwards > 0.5 else found
    return ring


def _exact_cut(turn: ndarray, elevation: ndarray, cut: float, rise: ndarray) -> float:
    """The place that lies between two neighbouring points a ring apart in most turns, else `cut`.

    Azimuths are in turns; `rise` is the distance from each ring to the next in degrees.
    """
    step = np.diff(turn)
    step -= np.rint(step)
    edge = (step > 0) & (step < _NEARBY) & (np.diff(elevation) / np.median(rise) > 0.5)
    begin = turn[:-1][edge]
    ends = np.concatenate([begin, begin + step[edge]])
    order = ends.argsort()
    depth = np.cumsum(np.where(order < len(begin), 1, -1))
    if depth.max(initial=0) <= len(rise) / 2:  # a file may begin and end within a ring
        depth[ends[order] > turn[0]] = 0
    if depth.max(initial=0) <= len(rise) / 4:
        return cut
    deepest = depth.argmax()
    return float(ends[order[deepest : deepest + 2]].mean())


def _cut_at(turn: ndarray, cut: float) -> ndarray:
    """Rings of azimuths in turns, (N,) int64: a new one where they fall back past `cut`."""
    phase = (turn - cut) % 1
    # Within a ring azimuths of near points fall back by up to 10 degrees in KITTI's scans.
    back = min(np.ptp(phase) / 2, _BACK)
    return np.cumsum(np.diff(phase, prepend=phase[0]) < -back)


def _scatter_of_rings(turn: ndarray, elevation: ndarray, cut: float) -> float:
    """Mean distance in degrees of the points from the median elevations of their rings."""
    ring = _cut_at(turn, cut)
    middles = ndimage.median(elevation, ring, np.arange(ring[-1] + 1))
    return float(abs(elevation - middles[ring]).mean())


def _starts(xyz: ndarray) -> ndarray:
    """Whether each point is in the 1st quadrant and the one before it in the 4th, (N,) bool.

    Before the first point is the last.
    """
    x, y, _ = xyz.T
    return (x >= 0) & (y >= 0) & np.roll((x >= 0) & (y < 0), 1)


def _rows_from_field(xyz: ndarray, ring: ndarray, sensor: Sensor) -> ndarray:
    """Rows from a file's ring numbers, (N,) int64.

    They count from 0 or 1, from the top, the bottom or by laser; or they have gaps, as those of
    every fourth beam, and elevations decide.
    """
    rows = sensor.shape[0]
    highest = int(ring.max(initial=0))
    elevation = _median_elevations(xyz, ring, max(highest + 1, rows + 1))
    numbers = np.unique(ring)
    first = 0
    if numbers[0] > 0 and highest <= rows:
        # Elevations decide if neither the first nor the last ring has a return.
        from_0, from_1 = (
            _misfit(part, _best_order(part, sensor)[0], sensor)
            for part in (elevation[:rows], elevation[1 : rows + 1])
        )
        first = int(highest == rows or from_1 < from_0 / 2)
    last = highest - first
    if last >= rows >= len(numbers):
        order = abs(elevation[:, None] - np.asarray(sensor.elevations)).argmin(axis=1)
        known = np.isfinite(elevation)
        fits = len(set(order[known])) == known.sum()
    elif rows / 2 <= last + 1 <= rows:
        order, fits = _best_order(elevation[first : first + rows], sensor)
    else:
        raise InputError(
            f"the scan has ring numbers up to {last}, but sensor '{sensor.name}' has {rows} rows. "
            f"Is it this sensor's? {_CURE}"
        )
    if not fits:
        raise InputError(
            "the scan's ring numbers follow neither the elevations of its points nor the firing "
            f"order of sensor '{sensor.name}'. Give the sensor its `firing`. {_CURE}"
        )
    return order[ring - first]


def _median_elevations(xyz: ndarray, ring: ndarray, rings: int) -> ndarray:
    """Median elevation of each ring in degrees, (rings,); NaN for rings with few returns."""
    elevation = elevations_of(xyz)
    seen = np.isfinite(elevation)
    many = np.flatnonzero(np.bincount(ring[seen], minlength=rings) >= _FEW)
    middles = np.full(rings, np.nan)
    middles[many] = ndimage.median(elevation[seen], ring[seen], many)
    return middles


def _misfit(elevation: ndarray, order: ndarray, sensor: Sensor) -> float:
    """Median distance in degrees between lasers and their rows; infinite without a return."""
    apart = abs(elevation - np.asarray(sensor.elevations)[order])
    seen = apart[np.isfinite(apart)]
    return float(np.median(seen)) if len(seen) else np.inf


def _rows_from_firings(xyz: ndarray, sensor: Sensor) -> ndarray | None:
    """The rows of a file of whole firings, (N,) int64; None for other files."""
    rows = sensor.shape[0]
    firings, rest = divmod(len(xyz), rows)
    if rest or firings < 8:
        return None
    table = few_firings(xyz.reshape(firings, rows, 3))
    elevation = elevations_of(table.reshape(-1, 3)).reshape(-1, rows)
    middle, scatter = scatter_of(elevation)
    order, fits = _best_order(middle, sensor)
    return np.tile(order, firings) if scatter < 0.25 and fits else None


def few_firings(firings: ndarray) -> ndarray:
    """256 of the rows of an array at most, evenly spaced: enough for the order of the lasers."""
    count = len(firings)
    return firings[np.linspace(0, count - 1, min(count, 256)).astype(int)]


def elevations_of(xyz: ndarray) -> ndarray:
    """Elevation in degrees of every point, (N,); NaN for rays without return, at the origin."""
    r = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.rad2deg(np.arcsin(xyz[:, 2] / r))


def scatter_of(elevation: ndarray) -> tuple[ndarray, float]:
    """Median elevation of each column of (firings, lasers), and the scatter of the columns.

    The scatter is the median distance from the column's median over the median distance from the
    overall median: near 0 if each column is a laser, else near 1. Medians are robust against
    returns from the vehicle itself. NaN is a ray without return.
    """
    middle = median_of_seen(elevation)
    within = np.nanmedian(abs(elevation - middle))
    overall = np.nanmedian(abs(elevation - np.nanmedian(elevation)))
    return middle, within / overall if overall > 0 else 1.0


def median_of_seen(values: ndarray) -> ndarray:
    """Upper median of each column without NaN values, (W,); NaN for columns of NaN."""
    ordered = np.sort(values, axis=0)  # NaN last
    seen = np.isfinite(values).sum(axis=0)
    middle = ordered[np.minimum(seen // 2, len(values) - 1), np.arange(values.shape[1])]
    return np.where(seen > 0, middle, np.nan)


def _best_order(elevation: ndarray, sensor: Sensor) -> tuple[ndarray, bool]:
    """Row of each laser, (H,) int64, in the order that best fits their elevations.

    Candidates are top-down, bottom-up and the sensor's firing order.

    Returns:
        The order, and whether it fits: no laser lies above that of the row before it by more than
        half the distance of the rows. Ties go to the order with the smaller distance to the rows.
    """
    top_down = np.arange(len(elevation))
    orders = [top_down, top_down[::-1]]
    if sensor.firing is not None:
        orders.append(np.asarray(sensor.firing))
    misfits = []
    for order in orders:
        by_row = elevation[np.argsort(order)]
        seen = np.isfinite(by_row)
        apart = -np.diff(np.asarray(sensor.elevations)[seen])
        wrong = np.diff(by_row[seen]) > np.maximum(apart / 2, _NOISE)
        misfits.append((wrong.sum(), _misfit(elevation, order, sensor)))
    best = misfits.index(min(misfits))
    return orders[best], misfits[best][0] == 0
