"""Estimate a sensor from its scans, and judge whether scans are of a sensor."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from numpy.lib.stride_tricks import sliding_window_view

from r2flow.base.errors import InputError
from r2flow.lidar.beams import Beams, NoBeamsError, find_beams
from r2flow.lidar.scan_files import FARTHEST_RAY, Points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of

FEWEST_RETURNS = 200  # minimum for an estimate
COLUMNS = 64  # image widths are multiples of it, so that every backbone can halve them
FULL_REFLECTANCE = (1.0, 100.0, 255.0, 256.0, 65535.0)  # common values of full reflectance
# Bytes up to 100 may be of 255: above it are retroreflectors alone.
SURE = FULL_REFLECTANCE[:1] + FULL_REFLECTANCE[2:]
OUTLIERS = 0.05  # share of values beyond full reflectance, which are clipped
STRAY = 1e-4  # the same, of values up to 4 times as large, as of a larger scale
IN_VIEW = 0.9  # minimum share of returns in the sensor's view; tested real scans have 0.967 or more
OFF = 1.5  # degrees, by `_distance`: beams at a larger distance are of another sensor
# Share of rows between the beams: KITTI's scans have 0.02 at most, an OS1's .34 degrees off 0.16.
MOST_VOID = 0.1
# Degrees, by the median, between points and beams: real scans have 0.35 at most, two in one 0.39.
MOST_OFF = 0.37
BEATEN = 0.5  # degrees: beyond it, a sensor does not match if another sensor is twice as near
MOST_SIDES = 36  # azimuth sectors, in which the ground is looked for
NARROWEST = 70.0  # degrees of azimuth: less is no turn, but the patch of a camera
TILTS = np.arange(-10, 10.5, 0.5)  # degrees
# Degrees: a smaller tilt is not another frame; KITTI's odometry scans have half a degree.
LEVEL = 1.0
# Beams this much clearer after a larger tilt are of another frame; real scans have 1.03 at most.
CLEARER = 1.12


class Estimate(NamedTuple):
    """A sensor estimated from its scans."""

    sensor: Sensor
    beams: Beams
    steps: float  # azimuth steps per full turn, not rounded
    off: tuple[float, float]  # median and 95th percentile of the points' distance from their beams
    ground: bool  # whether the height above it was found


class Doubt(NamedTuple):
    """Why scans do not fit a sensor."""

    seen: str  # what was seen in them
    name: str | None  # the nearest built-in sensor within `OFF`
    hopeless: bool = False  # whether they have no beams
    sure: bool = False  # whether the nearest sensor is within `BEATEN`
    finer: bool = False  # whether it is the sensor itself, with rows between the scans' beams


def other_sensor(scans: Sequence[Points], sensor: Sensor) -> Doubt | None:
    """The mismatch of some scans and a sensor; None if they match, or if there are too few returns.

    The beams of the scans are compared with the sensor's. Without beams, the share of returns in
    the sensor's view and their distance from its beams decide; if a custom sensor has fewer rows
    than the scans have beams (which may be intended), the share does.
    """
    elevation = np.concatenate([elevations_of(scan.xyz) for scan in scans])
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) < 5 * FEWEST_RETURNS:
        return None
    edges = sensor.row_edges
    count, _ = np.histogram(-elevation, -edges)
    share = count.sum() / len(elevation)
    seen = f"{share:.0%} of the returns lie in its view"
    built_in = sensor.name in SENSORS
    whole = SENSORS[sensor.name] if built_in else sensor
    try:
        beams = find_beams(*scans).elevations
    except NoBeamsError as error:
        return Doubt(str(error), None, hopeless=True)
    except InputError:
        nearest = np.searchsorted(-whole.row_edges[1:-1], -elevation)
        off = np.median(abs(elevation - np.asarray(whole.elevations)[nearest]))
        fits = share >= IN_VIEW and off < MOST_OFF
        return None if fits else Doubt(f"{seen}, {off:.1f} degrees off its beams", None)
    name, near = nearest_sensor(beams)
    rows = len(sensor.elevations)
    distance = 0.0
    every = 1
    if built_in or len(beams) <= rows:
        # A sensor at another size is the same sensor: `resized` makes one of every few rows a beam.
        most = 1 if built_in else rows // len(beams)
        tables = [(sensor.elevations[n // 2 :: n], n) for n in range(1, most + 1)]
        family = _family(sensor.name)
        tables += [
            (other.elevations, 1) for other in SENSORS.values() if _family(other.name) == family
        ]
        distance, every = min((_distance(beams, table), n) for table, n in tables)
    if share < IN_VIEW or distance >= OFF or (distance > BEATEN and near < distance / 2):
        return Doubt(f"they have {in_words(beams)}, {seen}", name, sure=near < BEATEN)
    if every > 1:
        seen = f"they have {len(beams)} beams, one of every {every} of its rows"
        return Doubt(seen, None, finer=True)
    filled = np.flatnonzero(count > 0.02 * np.median(count))
    widest = 0
    if len(beams) < rows:
        filled = np.searchsorted(-edges, -beams)
        widest = np.diff(filled).max(initial=1) - 1  # a crop of near points leaves a wide gap
    void = np.diff(filled) - 1
    if void.sum() - widest <= rows * MOST_VOID or rows > len(whole.elevations):
        return None
    void = void.clip(0).sum()
    return Doubt(f"{void} of its {rows} rows lie between their beams and stay empty", None)


def is_tilted(scans: Sequence[Points]) -> bool:
    """Whether beams become clearer if the points are pitched and rolled.

    Then they are not in the sensor's own frame. Beams are clear if few elevations have many points:
    by the sum of squares of their histogram.
    """
    xyz = np.concatenate([scan.xyz for scan in scans])
    xyz = xyz[np.isfinite(elevations_of(xyz))]
    if len(xyz) < 5 * FEWEST_RETURNS:
        return False
    xyz = xyz[np.random.default_rng(0).integers(len(xyz), size=5000)]
    elevation = 110 + elevations_of(xyz)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth)])
    clear = {}
    for tilt in product(TILTS, TILTS):
        count = np.bincount(((elevation - tilt @ ahead) / 0.05).astype(int))
        clear[tilt] = (np.convolve(count, np.ones(5)) ** 2).sum()
    level = max(value for tilt, value in clear.items() if max(map(abs, tilt)) <= LEVEL)
    return bool(max(clear.values()) > CLEARER * level)


def is_unclear(scans: Sequence[Points]) -> bool:
    """Whether points lie far from their beams, as of two sensors in one file, or `is_tilted`."""
    with suppress(InputError):
        if np.median(find_beams(*scans).off(scans)) > MOST_OFF:
            return True
    return is_tilted(scans)


def differing(scans: Sequence[Points]) -> list[tuple[int, ndarray]]:
    """Number and elevations of the first scan with beams and of the first of another sensor; empty
    if all are of one.
    """
    seen: list[tuple[int, ndarray]] = []
    for number, scan in enumerate(scans):
        with suppress(InputError):
            beams = find_beams(scan).elevations
            if seen and _differ(seen[0][1], beams):
                return [seen[0], (number, beams)]
            seen.append((number, beams))
    return []


def _differ(one: ndarray, other: ndarray) -> bool:
    """Whether beams are of two sensors: the built-in ones nearest to them are others, or they are
    `OFF` (those of KITTI's scans 1.4 degrees at most). Some of the beams are of the same sensor.
    """
    few, many = sorted((one, other), key=len)
    apart = abs(few[:, None] - many).min(axis=1)
    if np.median(apart) < np.median(-np.diff(many)) / 10:
        return False
    names = {nearest_sensor(beams)[0] for beams in (one, other)} - {None}
    return len(names) > 1 or min(_distance(one, other), _distance(other, one)) >= OFF


def in_words(elevations: Sequence[float] | ndarray) -> str:
    """Beams as '16 beams from +15.0 to -15.0 degrees'."""
    return f"{len(elevations)} beams from {elevations[0]:+.1f} to {elevations[-1]:+.1f} degrees"


def nearest_sensor(elevations: ndarray) -> tuple[str | None, float]:
    """The built-in sensor nearest to beam elevations in degrees, or None, and the distance.

    None is beyond `OFF`.
    """
    distance, name = min(
        (_distance(elevations, sensor.elevations), name) for name, sensor in SENSORS.items()
    )
    return _family(name) if distance < OFF else None, distance


def _family(name: str) -> str:
    return name.partition("_rings")[0]


def _distance(beams: ndarray, elevations: Sequence[float] | ndarray) -> float:
    """Distance in degrees of beams from those of a sensor.

    It is the 80th percentile over beams, paired in order at the best offset, as scans may be
    cropped. With beams missing between, later pairs are wrong: then it is the median distance to
    the nearest beams, if most fit.
    """
    table = np.asarray(elevations)
    if len(beams) > 1.05 * len(table) + 1:
        return math.inf
    shorter, longer = sorted((beams, table), key=len)
    offsets = abs(sliding_window_view(longer, len(shorter)) - shorter)
    paired = float(np.quantile(offsets, 0.8, axis=1).min())
    gap = np.median(-np.diff(table))
    spanned = ((table <= beams[0] + gap / 2) & (table >= beams[-1] - gap / 2)).sum()
    off = abs(beams[:, None] - table).min(axis=1)
    middle = float(np.median(off))
    fits = middle <= gap / 10 and (off < gap / 4).sum() >= 0.75 * max(spanned, len(beams))
    return min(paired, middle) if fits else paired


def estimate_sensor(scans: Sequence[Points], name: str = "mine") -> Estimate:
    """Estimate a sensor from scans in its frame.

    The range limits exclude one return in 10,000, and are rounded. The minimum is not above that of
    the nearest built-in sensor, else 0.5 m: the scans may hold nothing near.

    Raises:
        InputError: The scans have too few returns, no beams, no metres, or show no turn.
    """
    xyz = np.concatenate([scan.xyz[scan.xyz.any(axis=1)] for scan in scans])
    if len(xyz) < FEWEST_RETURNS:
        raise InputError(
            f"{len(xyz)} returns are too few for an estimate: give at least {FEWEST_RETURNS}."
        )
    seen = len(np.unique(np.arctan2(xyz[:, 1], xyz[:, 0]) // np.radians(5))) * 5
    if seen < NARROWEST:
        raise InputError(
            f"the returns lie within {seen} degrees of azimuth: a scan is a turn of a spinning "
            "LiDAR, not the patch of a camera or a solid-state sensor."
        )
    beams = find_beams(*scans)
    steps = steps_of_a_turn(scans, beams.of_point)
    fall = 1e-3 * np.arange(len(beams.elevations))  # of rows that are equal after rounding
    elevations = np.minimum.accumulate(beams.elevations.astype(float).round(3) + fall) - fall
    r = np.linalg.norm(xyz, axis=1)
    near, middle, far = np.quantile(r, [1e-4, 0.5, 1 - 1e-4])
    if middle > FARTHEST_RAY:
        raise InputError(f"half the returns are beyond {middle:,.0f}: are the points in metres?")
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

    Then the level with most returns 3 to 20 m away is above, on all sides, with half as many again
    as that below; of tested real scans, the level below has 1.5 times as many.
    """
    xyz = np.concatenate([scan.xyz for scan in scans])
    below, _ = _level(xyz)
    above, sides = _level(xyz * np.array([1, 1, -1]))
    return above > max(1.4 * below, FEWEST_RETURNS / 4) and sides >= MOST_SIDES / 2


def _level(xyz: ndarray) -> tuple[int, int]:
    """Returns within 0.15 m of the most frequent height below the sensor, 3 to 20 m away, and the
    number of `MOST_SIDES` azimuth sectors that they lie in.
    """
    x, y, z = xyz.T
    distance = np.hypot(x, y)
    near = (distance > 3) & (distance < 20) & (z < -0.2)
    counts, edges = np.histogram(z[near], np.arange(-6, -0.1, 0.1))
    middle = edges[np.argmax(np.convolve(counts, np.ones(3), "same"))] + 0.05
    level = near & (abs(z - middle) < 0.15)
    sides = np.floor(np.arctan2(y[level], x[level]) * (MOST_SIDES / (2 * np.pi)))
    return int(level.sum()), len(np.unique(sides))


def _height(xyz: ndarray) -> float | None:
    """The lowest frequent height of returns 3 to 20 m away, or None.

    The most frequent may be of hedges and cars.
    """
    x, y, z = xyz.T
    distance = np.hypot(x, y)
    z = z[(distance > 3) & (distance < 20) & (z < -0.2)]
    counts, edges = np.histogram(z, np.arange(-6, -0.1, 0.1))
    smooth = np.convolve(counts, np.ones(3), "same")
    most = smooth.max()
    if most < FEWEST_RETURNS / 4:
        return None
    ground = edges[np.argmax(smooth > 0.7 * most)] + 0.05
    return round(-float(np.median(z[abs(z - ground) < 0.3])), 2)


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
    if not len(apart):
        raise InputError("no beam returned at two azimuths in these scans. Are they whole?")
    step = np.quantile(apart, 0.3)
    if step > 180:
        raise InputError("neighbouring returns of a beam are no step of a turn apart.")
    for _ in range(3):
        near = gap[gap < 3.5 * step]
        step = near.sum() / (near / step).round().sum()
    return 360 / float(step)


def full_reflectance(scans: Iterable[Points], usual: float | None = None) -> float | None:
    """Estimate the value of full reflectance; None if no file has reflectance, or only 0.

    Up to 5 % of the values may be outliers: Waymo's fractions of 1 reach 40,000. It is `usual`, if
    given and beyond the others; else 1 of fractions; else the first common value beyond the others;
    or the highest of them, rounded up, if that is below a tenth of it.
    """
    stored = [scan.reflectance for scan in scans if scan.reflectance is not None]
    values = np.concatenate([np.zeros(0), *stored])
    values = values[values > 0]
    if not len(values):
        return None
    if usual and np.mean(values > usual) <= OUTLIERS:
        return usual
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
    return bool(beyond.mean() <= OUTLIERS and stray <= (STRAY if full > 100 else 0))
