"""Judge whether scans are of a sensor, of one sensor, and in its own frame."""

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy import ndarray
from numpy.lib.stride_tricks import sliding_window_view

from r2flow.base.errors import InputError
from r2flow.lidar.beams import NoBeamsError, find_beams
from r2flow.lidar.scan_files import Points
from r2flow.lidar.scan_files.tables import KEPT
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of

_FEWEST_RETURNS = 1000  # for a judgement
# Minimum share of returns in the sensor's view; tested real scans have 0.967 or more.
_IN_VIEW = 0.9
_OFF = 1.5  # degrees, by `_distance`: beams at a larger distance are of another sensor
# Share of rows between the beams: KITTI's scans have 0.02 at most, an OS1's .34 degrees off 0.16.
_MOST_VOID = 0.1
# Degrees, by the median, between points and beams: real scans have 0.35 at most, two in one 0.39.
_MOST_OFF = 0.37
_BEATEN = 0.5  # degrees: beyond it, a sensor does not match if another sensor is twice as near
_TILTS = np.arange(-10, 10.5, 0.5)  # degrees
# Degrees: a smaller tilt is not another frame; KITTI's odometry scans have half a degree.
_LEVEL = 1.0
# Beams this much clearer after a larger tilt are of another frame; real scans have 1.03 at most.
_CLEARER = 1.12


class Doubt(NamedTuple):
    """Why scans do not fit a sensor."""

    seen: str  # what was seen in them
    name: str | None  # the nearest built-in sensor within `_OFF`
    hopeless: bool = False  # whether they have no beams
    sure: bool = False  # whether the nearest sensor is within `_BEATEN`
    finer: bool = False  # whether it is the sensor itself, with rows between the scans' beams


def other_sensor(scans: Sequence[Points], sensor: Sensor) -> Doubt | None:
    """The mismatch of some scans and a sensor; None if they match, or if there are too few returns.

    The beams of the scans are compared with the sensor's. Without beams, the share of returns in
    the sensor's view and their distance from its beams decide; if a custom sensor has fewer rows
    than the scans have beams (which may be intended), the share does.
    """
    elevation = np.concatenate([elevations_of(scan.xyz) for scan in scans])
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) < _FEWEST_RETURNS:
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
        fits = share >= _IN_VIEW and off < _MOST_OFF
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
    if share < _IN_VIEW or distance >= _OFF or (distance > _BEATEN and near < distance / 2):
        return Doubt(f"they have {in_words(beams)}, {seen}", name, sure=near < _BEATEN)
    if every > 1:
        seen = f"they have {len(beams)} beams, one of every {every} of its rows"
        return Doubt(seen, None, finer=True)
    filled = np.flatnonzero(count > 0.02 * np.median(count))
    widest = 0
    if len(beams) < rows:
        filled = np.searchsorted(-edges, -beams)
        widest = np.diff(filled).max(initial=1) - 1  # a crop of near points leaves a wide gap
    void = np.diff(filled) - 1
    if void.sum() - widest <= rows * _MOST_VOID or rows > len(whole.elevations):
        return None
    void = void.clip(0).sum()
    return Doubt(f"{void} of its {rows} rows lie between their beams and stay empty", None)


@lru_cache(KEPT)
def is_tilted(*scans: Points) -> bool:
    """Whether beams become clearer if the points are pitched and rolled.

    Then they are not in the sensor's own frame. Beams are clear if few elevations have many points:
    by the sum of squares of their histogram.
    """
    xyz = np.concatenate([scan.xyz for scan in scans])
    xyz = xyz[np.isfinite(elevations_of(xyz))]
    if len(xyz) < _FEWEST_RETURNS:
        return False
    xyz = xyz[np.random.default_rng(0).integers(len(xyz), size=5000)]
    elevation = 110 + elevations_of(xyz)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth)])
    tilts = np.array([*product(_TILTS, _TILTS)])
    bins = [((elevation - tilt @ ahead) / 0.05).astype(int) for tilt in tilts]
    clear = np.array([(np.convolve(np.bincount(one), np.ones(5)) ** 2).sum() for one in bins])
    level = clear[abs(tilts).max(axis=1) <= _LEVEL].max()
    return bool(clear.max() > _CLEARER * level)


def is_unclear(scans: Sequence[Points]) -> bool:
    """Whether points lie far from their beams, as of two sensors in one file, or `is_tilted`."""
    with suppress(InputError):
        if np.median(find_beams(*scans).off(scans)) > _MOST_OFF:
            return True
    return is_tilted(*scans)


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
    `_OFF` (those of KITTI's scans 1.4 degrees at most). Some of the beams are of the same sensor.
    """
    few, many = sorted((one, other), key=len)
    apart = abs(few[:, None] - many).min(axis=1)
    if np.median(apart) < np.median(-np.diff(many)) / 10:
        return False
    names = {nearest_sensor(beams)[0] for beams in (one, other)} - {None}
    return len(names) > 1 or min(_distance(one, other), _distance(other, one)) >= _OFF


def in_words(elevations: Sequence[float] | ndarray) -> str:
    """Beams as '16 beams from +15.0 to -15.0 degrees'."""
    return f"{len(elevations)} beams from {elevations[0]:+.1f} to {elevations[-1]:+.1f} degrees"


def nearest_sensor(elevations: ndarray) -> tuple[str | None, float]:
    """The built-in sensor nearest to beam elevations in degrees, or None, and the distance.

    None is beyond `_OFF`.
    """
    distance, name = min(
        (_distance(elevations, sensor.elevations), name) for name, sensor in SENSORS.items()
    )
    return _family(name) if distance < _OFF else None, distance


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
