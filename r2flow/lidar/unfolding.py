"""Scan unfolding: the row of a point is the laser that fired it, taken from the file instead of the elevation."""

import numpy as np

from r2flow.errors import InputError, check
from r2flow.lidar.sensors import Convention, Sensor

SURE = 0.9  # minimum share of neighbouring lasers whose elevations decrease in that order


def unfolded_rows(xyz: np.ndarray, sensor: Sensor, convention: Convention, ring: np.ndarray | None) -> np.ndarray:
    """Row of every point, (N,) int64; outside [0, H) for points outside the image.

    Lasers are found by the first of three ways that works: ring numbers; whole firings of H points each, including rays
    without return, in a fixed order of lasers; or ring after ring (`rings_from_order`), aligned at the bottom because
    rings that see only sky are missing at the top. Other conventions than `centre` use the last way as published: the
    ring above the top row is in the bottom row; those above it, and points before the first ring's start, in the top.
    """
    rows = sensor.shape[0]
    if ring is not None:
        return rows_from_field(xyz, np.asarray(ring, dtype=np.int64), sensor)
    if convention != "centre":
        ring = np.cumsum(_starts(xyz))
        row = ring - ring.max(initial=0) + rows - 1
        return np.where((ring > 0) & (row >= -1), row % rows, 0)
    if (row := rows_from_firings(xyz, sensor)) is not None:
        return row
    order = rings_from_order(xyz)
    rings = int(order.max(initial=-1)) + 1
    if not rows / 2 <= rings <= rows + 1:
        raise InputError(
            f"the scan unfolds into {rings} rings, but sensor '{sensor.name}' has {rows}: it has no ring numbers and "
            f"is stored neither ring after ring nor in whole firings of {rows}. Use the spherical projection, which "
            "finds rows by elevation."
        )
    returned = xyz[order >= 0]
    turn = np.flatnonzero(np.diff(returned[:, 1] < 0))
    jump = np.abs(elevations_of(returned[turn + 1]) - elevations_of(returned[turn]))
    ahead, behind = (np.nanmedian(np.append(jump[at], 0)) for at in (returned[turn, 0] > 0, returned[turn, 0] <= 0))
    check(  # real scans: 1.2 times as far at least
        ahead >= behind / 3,
        "elevations jump behind and not ahead: rings must be stored from azimuth 0 on. Use the spherical projection.",
    )
    return order - rings + rows


def rings_from_order(xyz: np.ndarray) -> np.ndarray:
    """Ring of every point from the order of storage, (N,) int64, 0 for the first ring stored.

    In a scan stored ring after ring, azimuth increases from 0; a new ring starts where it passes from the 4th to the
    1st quadrant. Points at the origin are rays without return (-1).
    """
    returned = np.flatnonzero(xyz[:, :2].any(axis=1))
    ring = np.full(len(xyz), -1, dtype=np.int64)
    starts = _starts(xyz[returned])
    starts[:1] = True
    ring[returned] = np.cumsum(starts) - 1
    return ring


def _starts(xyz: np.ndarray) -> np.ndarray:
    """Whether each point is in the 1st quadrant and the one before it, of the first the last, in the 4th; (N,) bool."""
    x, y = xyz[:, 0], xyz[:, 1]
    return (x >= 0) & (y >= 0) & np.roll((x >= 0) & (y < 0), 1)


def rows_from_field(xyz: np.ndarray, ring: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Rows from a file's ring numbers, (N,) int64, which count from 0 or 1, from the top, the bottom or by laser."""
    rows, first, highest = sensor.shape[0], 0, int(ring.max(initial=0))
    if len(ring) and ring.min() > 0 and highest <= rows:
        # Elevations decide if neither the first nor the last ring has a return.
        means = _means(xyz, ring, rows + 1)
        from_0, from_1 = (_misfit(part, best_order(part, sensor)[0], sensor) for part in (means[:-1], means[1:]))
        first = int(highest == rows or from_1 < from_0 / 2)
    lasers = highest - first + 1
    if not rows / 2 <= lasers <= rows:
        raise InputError(
            f"the scan has ring numbers up to {lasers - 1}, but sensor '{sensor.name}' has {rows} rows. Is it this "
            "sensor's? If so, use the spherical projection, which finds rows by elevation."
        )
    order, share = best_order(_means(xyz, ring - first, rows), sensor)
    if share < SURE:
        raise InputError(
            f"the scan's ring numbers follow neither the elevations of its points nor the firing order of sensor "
            f"'{sensor.name}'. Give the sensor its `firing`, or use the spherical projection."
        )
    return order[ring - first]


def _means(xyz: np.ndarray, ring: np.ndarray, rows: int) -> np.ndarray:
    """Mean elevation of each ring in degrees, (H,); NaN for rings without returns."""
    elevation = elevations_of(xyz)
    seen = np.isfinite(elevation)
    count = np.bincount(ring[seen], minlength=rows)
    total = np.bincount(ring[seen], elevation[seen], minlength=rows)
    with np.errstate(invalid="ignore"):
        return total / count


def _misfit(elevation: np.ndarray, order: np.ndarray, sensor: Sensor) -> float:
    """Median distance in degrees between lasers and their rows in an order; infinite without a return."""
    apart = np.abs(elevation - np.asarray(sensor.elevations)[order])
    return float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf


def rows_from_firings(xyz: np.ndarray, sensor: Sensor) -> np.ndarray | None:
    """The rows of a file of whole firings, (N,) int64; None for other files."""
    rows = sensor.shape[0]
    firings = len(xyz) // rows
    if len(xyz) % rows or firings < 8:
        return None
    sample = np.linspace(0, firings - 1, min(firings, 256)).astype(np.int64)  # enough for their order
    elevation = elevations_of(xyz.reshape(firings, rows, 3)[sample].reshape(-1, 3)).reshape(-1, rows)
    middle, scatter = scatter_of(elevation)
    if not scatter < 0.25:
        return None
    order, share = best_order(middle, sensor)
    return np.tile(order, firings) if share >= SURE else None


def elevations_of(xyz: np.ndarray) -> np.ndarray:
    """Elevation in degrees of every point, (N,); NaN for points at the origin, rays without return."""
    r = np.sqrt(np.einsum("ij,ij->i", xyz, xyz))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.rad2deg(np.arcsin(xyz[:, 2] / r))


def scatter_of(elevation: np.ndarray) -> tuple[np.ndarray, float]:
    """Median elevation of each column of (firings, lasers), NaN without return, and the scatter of the columns.

    The scatter is the median distance from the column's median over the median distance from the overall median: near
    0 if each column is a laser, else near 1. Medians are robust against returns from the vehicle itself.
    """
    middle = median_of_seen(elevation)
    about = np.abs(elevation - middle)
    about_all = np.abs(elevation - median_of_seen(elevation.reshape(-1, 1)))
    within, overall = (float(median_of_seen(distance.reshape(-1, 1))[0]) for distance in (about, about_all))
    return middle, within / overall if overall > 0 else 1.0


def median_of_seen(values: np.ndarray) -> np.ndarray:
    """Upper median of each column without NaN values, (W,); NaN for columns of NaN."""
    ordered = np.sort(values, axis=0)  # NaN last
    seen = np.isfinite(values).sum(axis=0)
    middle = ordered[np.minimum(seen // 2, len(values) - 1), np.arange(values.shape[1])]
    return np.where(seen > 0, middle, np.nan)


def best_order(elevation: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, float]:
    """Row of each laser, (H,) int64, in the order that best fits their elevations, and the quality of the fit.

    Candidates are top-down, bottom-up and the sensor's firing order. The quality is the share of neighbouring lasers
    with decreasing elevations; ties go to the order with the smaller distance to the rows.
    """
    rows = len(elevation)
    orders = [np.arange(rows), np.arange(rows)[::-1]]
    if sensor.firing is not None:
        orders.append(np.asarray(sensor.firing))
    shares = []
    for order in orders:
        falling = elevation[np.argsort(order)]
        steps = np.diff(falling[np.isfinite(falling)])
        shares.append(float((steps < 0).mean()) if len(steps) else 1.0)
    best = max(range(len(orders)), key=lambda n: (shares[n], -_misfit(elevation, orders[n], sensor)))
    return orders[best].astype(np.int64), shares[best]
