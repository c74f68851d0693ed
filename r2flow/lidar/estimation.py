"""Estimate a sensor from its scans."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from r2flow.base.errors import check
from r2flow.lidar.beams import Beams, find_beams
from r2flow.lidar.matching import nearest_sensor
from r2flow.lidar.scan_files import FARTHEST_RAY, Points
from r2flow.lidar.sensors import SENSORS, Sensor

_FEWEST_RETURNS = 200  # minimum for an estimate
COLUMNS = 64  # image widths are multiples of it, so that every backbone can halve them
FULL_REFLECTANCE = (1.0, 100.0, 255.0, 256.0, 65535.0)  # common values of full reflectance
# Bytes up to 100 may be of 255: above it are retroreflectors alone.
SURE = FULL_REFLECTANCE[:1] + FULL_REFLECTANCE[2:]
OUTLIERS = 0.05  # share of values beyond full reflectance, which are clipped
_STRAY = 1e-4  # the same, of values up to 4 times as large, as of a larger scale
_MOST_SIDES = 36  # azimuth sectors, in which the ground is looked for
_NARROWEST = 70.0  # degrees of azimuth: less is no turn, but the patch of a camera


class Estimate(NamedTuple):
    """A sensor estimated from its scans."""

    sensor: Sensor
    beams: Beams
    steps: float  # azimuth steps per full turn, not rounded
    off: tuple[float, float]  # median and 95th percentile of the points' distance from their beams
    ground: bool  # whether the height above it was found


def estimate_sensor(scans: Sequence[Points], name: str = "mine") -> Estimate:
    """Estimate a sensor from scans in its frame.

    The range limits exclude one return in 10,000, and are rounded. The minimum is not above that of
    the nearest built-in sensor, else 0.5 m: the scans may hold nothing near.

    Raises:
        InputError: The scans have too few returns, no beams, no metres, or show no turn.
    """
    xyz = np.concatenate([scan.xyz[scan.xyz.any(axis=1)] for scan in scans])
    check(
        len(xyz) >= _FEWEST_RETURNS,
        f"{len(xyz)} returns are too few for an estimate: give at least {_FEWEST_RETURNS}.",
    )
    seen = len(np.unique(np.arctan2(xyz[:, 1], xyz[:, 0]) // np.radians(5))) * 5
    check(
        seen >= _NARROWEST,
        f"the returns lie within {seen} degrees of azimuth: a scan is a turn of a spinning "
        "LiDAR, not the patch of a camera or a solid-state sensor.",
    )
    beams = find_beams(*scans)
    steps = steps_of_a_turn(scans, beams.of_point)
    fall = 1e-3 * np.arange(len(beams.elevations))  # of rows that are equal after rounding
    elevations = np.minimum.accumulate(beams.elevations.astype(float).round(3) + fall) - fall
    r = np.linalg.norm(xyz, axis=1)
    near, middle, far = np.quantile(r, [1e-4, 0.5, 1 - 1e-4])
    metres = middle <= FARTHEST_RAY
    check(metres, f"half the returns are beyond {middle:,.0f}: are the points in metres?")
    nearest, _ = nearest_sensor(beams.elevations)
    near = min(near, SENSORS[nearest].min_range if nearest else 0.5)
    ground = None if hangs(scans) else _height(xyz)
    sensor = Sensor(
        name,
        tuple((elevations.round(3) + 0.0).tolist()),  # no -0.0
        max(int((steps + 0.5) // COLUMNS), 1) * COLUMNS,
        max(math.floor(near * 10) / 10, 0.1),
        float(math.ceil(far)),
        ground or Sensor.height,
        beams.firing,
        full_reflectance(scans),
    )
    middle, most = np.quantile(beams.off(scans), [0.5, 0.95])
    return Estimate(sensor, beams, steps, (float(middle), float(most)), ground is not None)


def hangs(scans: Sequence[Points]) -> bool:
    """Whether the ground lies above the sensor, as in scans of one that hangs upside down.

    Then the level with most returns 1 to 20 m away is above, on all sides, with half as many again
    as that below; of tested real scans, the level below has 1.5 times as many.
    """
    xyz = np.concatenate([scan.xyz for scan in scans])
    below, _ = _level(xyz)
    above, sides = _level(xyz * np.array([1, 1, -1]))
    return above > max(1.4 * below, _FEWEST_RETURNS / 4) and sides >= _MOST_SIDES / 2


def _level(xyz: ndarray) -> tuple[int, int]:
    """Returns within 0.15 m of the most frequent height below the sensor, 1 to 20 m away, and the
    number of `_MOST_SIDES` azimuth sectors that they lie in.
    """
    low, frequency, heights = _heights(xyz, nearest=1.0)  # a low robot's floor ends at 3 m
    x, y, _ = low[abs(low[:, 2] - heights[frequency.argmax()]) < 0.15].T
    sides = np.floor(np.arctan2(y, x) * (_MOST_SIDES / (2 * np.pi)))
    return len(x), len(np.unique(sides))


def _height(xyz: ndarray) -> float | None:
    """The lowest frequent height of returns 3 to 20 m away, or None.

    The most frequent may be of hedges and cars.
    """
    low, frequency, heights = _heights(xyz)
    most = frequency.max()
    if most < _FEWEST_RETURNS / 4:
        return None
    ground = heights[np.argmax(frequency > 0.7 * most)]
    z = low[:, 2]
    return round(-float(np.median(z[abs(z - ground) < 0.3])), 2)


def _heights(xyz: ndarray, nearest: float = 3.0) -> tuple[ndarray, ndarray, ndarray]:
    """Returns below the sensor, `nearest` to 20 m away, (M, 3), and how many are near heights."""
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    low = xyz[(distance > nearest) & (distance < 20) & (xyz[:, 2] < -0.2)]
    counts, edges = np.histogram(low[:, 2], np.arange(-6, -0.1, 0.1))
    return low, np.convolve(counts, np.ones(3), "same"), edges[:-1] + 0.05


def steps_of_a_turn(scans: Sequence[Points], rows: Sequence[ndarray]) -> float:
    """Azimuth steps per full turn, 360 / step, from the row of each point of each scan.

    The first estimate of the step is the 30th percentile of the gaps between neighbouring returns
    of a beam, since most neighbours of a return are returns. It is refined as the sum of all gaps
    up to three steps over their steps.
    """
    gaps = []
    for scan, row in zip(scans, rows, strict=True):
        x, y, _ = scan.xyz.T
        azimuth = np.rad2deg(np.arctan2(y, x).astype(float))
        order = np.lexsort((azimuth, row))
        order = order[row[order] >= 0]
        gaps.append(np.diff(azimuth[order])[np.diff(row[order]) == 0])
    gap = np.concatenate(gaps)
    apart = gap[gap > 1e-2]  # two returns of a ray have the same azimuth
    check(len(apart), "no beam returned at two azimuths in these scans. Are they whole?")
    step = np.quantile(apart, 0.3)
    check(step <= 180, "neighbouring returns of a beam are no step of a turn apart.")
    for _ in range(3):
        near = gap[gap < 3.5 * step]
        step = near.sum() / (near / step).round().sum()
    return 360 / float(step)


def full_reflectance(scans: Iterable[Points], expected: float | None = None) -> float | None:
    """Estimate the value of full reflectance; None if no file has reflectance, or only 0.

    Up to 5 % of the values may be outliers: Waymo's fractions of 1 reach 40,000. It is `expected`
    if given and beyond the others; else 1 of fractions; else the first common value beyond the
    others; or the highest of them, rounded up, if that is below a tenth of it.
    """
    stored = [scan.reflectance for scan in scans if scan.reflectance is not None]
    values = np.concatenate([np.zeros(0), *stored])
    values = values[values > 0]
    if not len(values):
        return None
    if expected and np.mean(values > expected) <= OUTLIERS:
        return expected
    bulk = np.quantile(values, 1 - OUTLIERS)
    full = next((full for full in FULL_REFLECTANCE if _is_full(full, values)), math.inf)
    inside = values[values <= full * 1.001].max()
    # Of bytes a few retroreflectors are bright; counts of photons may be saturated.
    if (bulk if full > 256 else inside) >= 0.1 * full:  # else the values would fill less than that
        return full
    highest = inside if inside <= 10 * bulk else bulk
    rounded = float(f"{highest:.1g}")
    return rounded if rounded >= highest else float(f"{highest * 1.05:.2g}")


def _is_full(full: float, values: ndarray) -> bool:
    """Whether a common value is full reflectance of values above 0, (N,), but for outliers."""
    beyond = values > full * 1.001
    if full == 1:
        fractions = np.mean(values % 1 > 0) > 0.5
        return bool(beyond.mean() <= OUTLIERS and (fractions or not beyond.any()))
    # Bytes above 100 are retroreflectors, and as few as outliers.
    stray = np.mean(beyond & (values <= 4 * full))
    return bool(beyond.mean() <= OUTLIERS and stray <= (_STRAY if full > 100 else 0))
