"""Estimate a sensor from its scans, and judge whether scans are of a sensor."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import product
from typing import NamedTuple

import numpy as np

from r2flow.errors import InputError, check
from r2flow.lidar.beams import Beams, NoBeamsError, find_beams
from r2flow.lidar.scan_files import FARTHEST_RAY, Points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of

FEWEST_RETURNS = 200  # minimum for an estimate
COLUMNS = 64  # image widths are multiples of it, so that every backbone can halve them
FULL_REFLECTANCE = (1.0, 100.0, 255.0, 256.0, 65535.0)  # common values of full reflectance
SURE = FULL_REFLECTANCE[:1] + FULL_REFLECTANCE[2:]  # bytes up to 100 may be of 255: above it are retroreflectors alone
OUTLIERS = 1e-4  # share of values that may exceed one of them
IN_VIEW = 0.9  # minimum share of returns in the sensor's view; tested real scans have 0.967 or more
OFF = 1.5  # degrees, by `_distance`: beams at a larger distance are of another sensor
MOST_VOID = 0.1  # share of rows between the beams: KITTI's scans have 0.02 at most, an OS1's .34 degrees off 0.16
MOST_OFF = 0.37  # degrees, by the median, between points and beams; real scans have 0.35 at most, two in one 0.39
BEATEN = 0.5  # degrees: beyond it, a sensor does not match if another sensor is twice as near
TILTS = np.arange(-10, 10.5, 0.5)  # degrees
LEVEL = 1.0  # degrees: a smaller tilt is not another frame; KITTI's odometry scans have half a degree
CLEARER = 1.12  # beams this much clearer after a larger tilt are of another frame; real scans have 1.03 at most


class Estimate(NamedTuple):
    """A sensor estimated from its scans, its beams, and its azimuth steps per full turn, not rounded."""

    sensor: Sensor
    beams: Beams
    steps: float
    off: float  # median distance of the points from their beams in degrees
    ground: bool  # whether the height above it was found


class Doubt(NamedTuple):
    """Why scans do not fit a sensor."""

    seen: str  # what was seen in them
    name: str | None  # the nearest built-in sensor within `OFF`
    hopeless: bool = False  # whether they have no beams
    sure: bool = False  # whether the nearest sensor is within `BEATEN`
    finer: bool = False  # whether it is the sensor with rows between its beams (`Sensor.resized`), one of one's own


def other_sensor(scans: Sequence[Points], sensor: Sensor) -> Doubt | None:
    """The mismatch of some scans and a sensor; None if they match, or if there are too few returns.

    The beams of the scans are compared with the sensor's. Without beams, the share of returns in the sensor's view and
    their distance from its beams decide; if a custom sensor has fewer rows than the scans have beams (which may be
    intended), the share does.
    """
    elevation = np.concatenate([elevations_of(scan.xyz) for scan in scans])
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) < 5 * FEWEST_RETURNS:
        return None
    try:
        beams = find_beams(*scans).elevations
    except NoBeamsError as error:
        return Doubt(str(error), None, hopeless=True)
    except InputError:
        beams = None
    edges = sensor.row_edges
    share = float(((elevation <= edges[0]) & (elevation >= edges[-1])).mean())
    seen = f"{share:.0%} of the returns lie in its view"
    whole = SENSORS[sensor.name] if sensor.name in SENSORS else sensor  # noqa: SIM401
    if beams is None:
        own = np.asarray(whole.elevations)
        off = float(np.median(np.abs(elevation - own[np.searchsorted(-(own[:-1] + own[1:]) / 2, -elevation)])))
        return None if share >= IN_VIEW and off < MOST_OFF else Doubt(f"{seen}, {off:.1f} degrees off its beams", None)
    (name, near), distance, every = nearest_sensor(beams), 0.0, 1
    if sensor.name in SENSORS or len(beams) <= len(sensor.elevations):
        # A sensor at another size is the same sensor: `resized` makes one of every few rows a beam.
        most = 1 if sensor.name in SENSORS else len(sensor.elevations) // len(beams)
        tables = [(sensor.elevations[n // 2 :: n], n) for n in range(1, most + 1)]
        tables += [(other.elevations, 1) for name, other in SENSORS.items() if _family(name) == _family(sensor.name)]
        distance, every = min((_distance(beams, np.asarray(table)), n) for table, n in tables)
    if share >= IN_VIEW and distance < OFF and not (distance > BEATEN and near < distance / 2):
        if every > 1:
            return Doubt(f"they have {len(beams)} beams, one of every {every} of its rows", None, finer=True)
        rows, count = len(sensor.elevations), np.histogram(-elevation, -edges)[0]
        filled = np.flatnonzero(count > 0.02 * np.median(count))
        void = np.diff(filled if len(beams) >= rows else np.searchsorted(-edges, -beams)) - 1
        less = 0 if len(beams) >= rows else void.max(initial=0)  # a crop of near points leaves a wide gap
        seen = f"{void.clip(0).sum()} of its {rows} rows lie between their beams and stay empty"
        return Doubt(seen, None) if void.sum() - less > rows * MOST_VOID and rows <= len(whole.elevations) else None
    seen = f"they have {len(beams)} beams from {beams[0]:+.1f} to {beams[-1]:+.1f} degrees, {seen}"
    return Doubt(seen, name, sure=near < BEATEN)


def is_tilted(scans: Sequence[Points]) -> bool:
    """Whether beams become clearer if the points are pitched and rolled: they are not in the sensor's own frame.

    Beams are clear if few elevations have many points: by the sum of squares of their histogram.
    """
    xyz = np.concatenate([scan.xyz[np.isfinite(elevations_of(scan.xyz))] for scan in scans])
    if len(xyz) < 5 * FEWEST_RETURNS:
        return False
    xyz = xyz[np.random.default_rng(0).integers(len(xyz), size=5000)]
    elevation, azimuth = 110 + elevations_of(xyz), np.arctan2(xyz[:, 1], xyz[:, 0])
    ahead, clear = np.stack([np.cos(azimuth), np.sin(azimuth)]), {}
    for tilt in product(TILTS, TILTS):
        count = np.bincount(((elevation - tilt @ ahead) / 0.05).astype(np.int64))
        clear[tilt] = float((np.convolve(count, np.ones(5)) ** 2).sum())
    return max(clear.values()) > CLEARER * max(clear[tilt] for tilt in clear if max(map(abs, tilt)) <= LEVEL)


def is_unclear(scans: Sequence[Points]) -> bool:
    """Whether scans are of two sensors, or points lie far from their beams, as of two in one file, or `is_tilted`."""
    with suppress(InputError):
        if len({nearest_sensor(find_beams(scan).elevations)[0] for scan in scans} - {None}) > 1:
            return True
    with suppress(InputError):
        if np.median(find_beams(*scans).off(scans)) > MOST_OFF:
            return True
    return is_tilted(scans)


def nearest_sensor(elevations: np.ndarray) -> tuple[str | None, float]:
    """The built-in sensor nearest to beam elevations in degrees, or None beyond `OFF`, and the distance."""
    distance, name = min((_distance(elevations, np.asarray(s.elevations)), name) for name, s in SENSORS.items())
    return (_family(name) if distance < OFF else None), distance


def _family(name: str) -> str:
    return name.partition("_rings")[0]


def _distance(beams: np.ndarray, table: np.ndarray) -> float:
    """Distance in degrees: the 80th percentile over beams, paired in order at the best offset, as scans may be cropped.

    With beams missing between, later pairs are wrong: then the median distance to the nearest beams, if most fit.
    """
    longer, shorter = (table, beams) if len(table) >= len(beams) else (beams, table)
    if len(longer) > 1.05 * len(table) + 1:
        return math.inf
    shifts = range(len(longer) - len(shorter) + 1)
    paired = min(float(np.quantile(np.abs(longer[s : s + len(shorter)] - shorter), 0.8)) for s in shifts)
    gap = float(np.median(-np.diff(table)))
    spanned = int(np.count_nonzero((table <= beams[0] + gap / 2) & (table >= beams[-1] - gap / 2)))
    off = np.abs(beams[:, None] - table).min(axis=1)
    fits = np.median(off) <= gap / 10 and np.count_nonzero(off < gap / 4) >= 0.75 * max(spanned, len(beams))
    return min(paired, float(np.median(off))) if fits else paired


def estimate_sensor(scans: Sequence[Points], name: str = "mine") -> Estimate:
    """Estimate a sensor from scans in its frame; the range limits exclude one return in 10,000, and are rounded.

    The minimum is not above that of the nearest built-in sensor, else 0.5 m: the scans may hold nothing near.
    """
    xyz = np.concatenate([scan.xyz[scan.xyz.any(axis=1)] for scan in scans])
    if len(xyz) < FEWEST_RETURNS:
        raise InputError(f"{len(xyz)} returns are too few for an estimate: give scans with at least {FEWEST_RETURNS}.")
    beams = find_beams(*scans)
    steps = steps_of_a_turn(scans, beams.of_point)
    elevations = (beams.elevations.astype(float).round(3) + 0.0).tolist()  # no -0.0
    for row in range(1, len(elevations)):  # equal after rounding
        elevations[row] = min(elevations[row], round(elevations[row - 1] - 1e-3, 3))
    near, middle, far = np.quantile(np.linalg.norm(xyz, axis=1), [1e-4, 0.5, 1 - 1e-4])
    check(middle <= FARTHEST_RAY, f"half the returns are {middle:,.0f} or more away: are the points in metres?")
    nearest, ground = nearest_sensor(beams.elevations)[0], _height(xyz)
    near = min(near, SENSORS[nearest].min_range if nearest else 0.5)
    sensor = Sensor(
        name,
        tuple(elevations),
        max(int((steps + 0.5) // COLUMNS), 1) * COLUMNS,
        max(math.floor(near * 10) / 10, 0.1),
        float(math.ceil(far)),
        ground or Sensor.height,
        beams.firing,
        full_reflectance(scans),
    )
    return Estimate(sensor, beams, steps, float(np.median(beams.off(scans))), ground is not None)


def _height(xyz: np.ndarray) -> float | None:
    """The lowest frequent height of returns 3 to 20 m away, or None; the most frequent may be of hedges and cars."""
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    z = xyz[(distance > 3) & (distance < 20) & (xyz[:, 2] < -0.2), 2]
    counts, edges = np.histogram(z, np.arange(-6, -0.1, 0.1))
    smooth = np.convolve(counts, np.ones(3), "same")
    if smooth.max() < FEWEST_RETURNS / 4:
        return None
    ground = edges[np.argmax(smooth > 0.7 * smooth.max())] + 0.05
    return round(-float(np.median(z[np.abs(z - ground) < 0.3])), 2)


def steps_of_a_turn(scans: Sequence[Points], rows: Sequence[np.ndarray]) -> float:
    """Azimuth steps per full turn, 360 / step, from the row of each point of each scan.

    The first estimate of the step is the 30th percentile of the gaps between neighbouring returns of a beam, since most
    neighbours of a return are returns. It is refined as the sum of all gaps up to three steps over their steps.
    """
    gaps = []
    for scan, row in zip(scans, rows, strict=True):
        azimuth = np.rad2deg(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(np.float64))
        order = np.lexsort((azimuth, row))
        order = order[row[order] >= 0]
        gaps.append(np.diff(azimuth[order])[np.diff(row[order]) == 0])
    gap = np.concatenate(gaps)
    apart = gap[gap > 1e-2]  # two returns of a ray have the same azimuth
    check(len(apart), "no beam returned at two azimuths in these scans. Are they whole?")
    step = float(np.quantile(apart, 0.3))
    for _ in range(3):
        near = gap[gap < 3.5 * step]
        step = float(near.sum() / (near / step).round().sum())
    return 360 / step


def full_reflectance(scans: Iterable[Points], usual: float | None = None) -> float | None:
    """Estimate the value of full reflectance; None if no file has reflectance, or only 0.

    It is `usual`, if given, unless more than 1 % of the values exceed it; else 1 if at most one in 10,000 exceeds 1, or
    the first common value that none exceeds, or the highest value, rounded up, if that is below a tenth of it.
    """
    values = np.concatenate([np.zeros(0), *(scan.reflectance for scan in scans if scan.reflectance is not None)])
    highest = float(values.max(initial=0))
    if highest <= 0:
        return None
    if usual and np.mean(values > usual) <= 0.01:
        return usual
    few = np.mean(values > 1.001) <= OUTLIERS  # bytes above 100 are retroreflectors, and as few
    common = 1.0 if few else next((full for full in FULL_REFLECTANCE if highest <= full * 1.001), math.inf)
    if highest >= 0.1 * common:  # else the values would fill less than a tenth of the scale
        return common
    return float(f"{highest:.1g}") if float(f"{highest:.1g}") >= highest else float(f"{highest * 1.05:.2g}")
