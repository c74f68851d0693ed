"""Estimate a sensor from its scans: beams, azimuth steps, limits, height, reflectance, and the nearest of `SENSORS`."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from r2flow.errors import InputError, check
from r2flow.lidar.scan_files import FARTHEST_RAY, Points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of, median_of_seen, rings_from_order, scatter_of

FEWEST, MOST = 4, 256  # limits of the number of beams
FEWEST_RETURNS = 200  # minimum for an estimate
TIGHT = 0.1  # scatter (`scatter_of`) below which each column is one laser
BANDWIDTHS = np.geomspace(0.015, 2.0, 50)  # degrees
BIN = 0.005  # degrees
FAINT = 0.02  # share of the median peak's height below which a peak is not a beam
SAME = 0.02  # degrees: neighbouring lasers that are nearer are two returns of one
STABLE = 1.5  # range of bandwidths, as a factor, over which the number of peaks must be constant
RINGLESS = 0.95  # variance within rings over that of all, above which rings are no beams; 15 degrees of tilt have 0.81
SCATTERED = 0.3  # median gap between elevations over their mean gap, above which a scan has no beams: `_is_scattered`
CROWDED = 20  # minimum mean number of points per sector for a comparison of gaps
COLUMNS = 64  # image widths are multiples of it, so that every backbone can halve them
FULL_REFLECTANCE = (1.0, 100.0, 255.0, 256.0, 65535.0)  # common values of full reflectance
IN_VIEW = 0.9  # minimum share of returns in the sensor's view; tested real scans have 0.967 or more
OFF = 1.5  # degrees, by `_distance`: beams at a larger distance are of another sensor
MOST_VOID = 0.1  # share of rows between the beams: KITTI's scans have 0.02 at most, an OS1's .34 degrees off 0.16
MOST_OFF = 0.37  # degrees, by the median, between points and beams; real scans have 0.35 at most, two in one 0.39
BEATEN = 0.5  # degrees: beyond it, a sensor does not match if another sensor is twice as near
TILTS = np.arange(-10, 10.5, 0.5)  # degrees
LEVEL = 1.0  # degrees: a smaller tilt is not another frame; KITTI's odometry scans have half a degree
CLEARER = 1.12  # beams this much clearer after a larger tilt are of another frame; real scans have 1.03 at most

RINGS = "a ring number at each point"
FIRINGS = "firing after firing, rays without return kept"
RING_AFTER_RING = "ring after ring"
UNORDERED = "beams found by elevation only"


class NoBeamsError(InputError):
    """The scans are of a sensor without beams."""


@dataclass(frozen=True)
class Beams:
    """The beams of a sensor."""

    elevations: np.ndarray  # median elevation of each beam in degrees, from the top, (H,)
    of_point: list[np.ndarray]  # row of each point of each scan; -1 for a ray without return
    order: str = UNORDERED  # storage order of the scans: `RINGS`, `FIRINGS`, ...
    firing: tuple[int, ...] | None = None  # row of laser 0, 1, ...; None if lasers are numbered by elevation

    def off(self, elevations: Sequence[np.ndarray]) -> np.ndarray:
        """Distance of each return from its beam in degrees, (N,), from the elevations of the points of each scan."""
        pairs = zip(elevations, self.of_point, strict=True)
        return np.concatenate([np.abs(e - self.elevations[row])[row >= 0] for e, row in pairs])


class Estimate(NamedTuple):
    """A sensor estimated from its scans, its beams, and its azimuth steps per full turn, not rounded."""

    sensor: Sensor
    beams: Beams
    steps: float
    off: float  # median distance of the points from their beams in degrees
    ground: bool  # whether the height above it was found


class Doubt(NamedTuple):
    """What was `seen` in scans that do not fit a sensor; hopeless: they have no beams.

    `name` is the nearest built-in sensor within `OFF`; sure: it is within `BEATEN`; finer: it is the sensor with rows
    between its beams (`Sensor.resized`), a sensor of one's own.
    """

    seen: str
    name: str | None
    hopeless: bool = False
    sure: bool = False
    finer: bool = False


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
        beams = find_beams(scans).elevations
    except NoBeamsError as error:
        return Doubt(str(error), None, hopeless=True)
    except InputError:
        beams = None
    edges = sensor.row_edges
    share = float(((elevation <= edges[0]) & (elevation >= edges[-1])).mean())
    seen = f"{share:.0%} of the returns lie in its view"
    if beams is None:
        whole = SENSORS[sensor.name] if sensor.name in SENSORS else sensor  # noqa: SIM401
        own = np.asarray(whole.elevations)
        off = float(np.median(np.abs(elevation - own[np.searchsorted(-(own[:-1] + own[1:]) / 2, -elevation)])))
        return None if share >= IN_VIEW and off < MOST_OFF else Doubt(f"{seen}, {off:.1f} degrees off its beams", None)
    name, near = nearest_sensor(beams)
    distance, every = 0.0, 1
    if sensor.name in SENSORS or len(beams) <= len(sensor.elevations):
        # A sensor at another size is the same sensor: `resized` makes one of every few rows a beam.
        most = 1 if sensor.name in SENSORS else len(sensor.elevations) // len(beams)
        tables = [(sensor.elevations[n // 2 :: n], n) for n in range(1, most + 1)]
        tables += [(other.elevations, 1) for name, other in SENSORS.items() if _family(name) == _family(sensor.name)]
        distance, every = min((_distance(beams, np.asarray(table)), n) for table, n in tables)
    if share >= IN_VIEW and distance < OFF and not (distance > BEATEN and near < distance / 2):
        if every > 1:
            return Doubt(f"they have {len(beams)} beams, one of every {every} of its rows", None, finer=True)
        void = _rows_between_beams(elevation, edges) if len(beams) >= len(sensor.elevations) else 0
        seen = f"{void} of its {len(sensor.elevations)} rows lie between their beams and stay empty"
        return Doubt(seen, None) if void > len(sensor.elevations) * MOST_VOID else None
    seen = f"they have {len(beams)} beams from {beams[0]:+.1f} to {beams[-1]:+.1f} degrees, {seen}"
    return Doubt(seen, name, sure=near < BEATEN)


def _rows_between_beams(elevation: np.ndarray, edges: np.ndarray) -> int:
    """The number of rows without returns between rows with returns."""
    count = np.histogram(-elevation, -edges)[0]
    seen = np.flatnonzero(count > 0.02 * np.median(count))
    return int(seen[-1] - seen[0] + 1 - len(seen)) if len(seen) else 0


def is_tilted(scans: Sequence[Points]) -> bool:
    """Whether beams become clearer if the points are pitched and rolled: they are not in the sensor's own frame.

    Beams are clear if few elevations have many points: by the sum of squares of their histogram.
    """
    xyz = np.concatenate([scan.xyz[scan.xyz.any(axis=1)] for scan in scans])
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
    """Whether points lie far from their beams, as of two sensors in one file, or `is_tilted`."""
    with suppress(InputError):
        if np.median(find_beams(scans).off([elevations_of(scan.xyz) for scan in scans])) > MOST_OFF:
            return True
    return is_tilted(scans)


def nearest_sensor(elevations: np.ndarray) -> tuple[str | None, float]:
    """The built-in sensor nearest to beam elevations in degrees, or None beyond `OFF`, and the distance."""
    distance, name = min((_distance(elevations, np.asarray(s.elevations)), name) for name, s in SENSORS.items())
    return (_family(name) if distance < OFF else None), distance


def _family(name: str) -> str:
    return name.removesuffix("_rings")


def _distance(beams: np.ndarray, table: np.ndarray) -> float:
    """Distance between beams and a table in degrees: the 80th percentile over beams, paired in order.

    The offset of the pairing minimises the distance, since a scan may be cropped and rings above the horizon may see
    only sky. If beams are missing in between, later pairs are wrong: for tables with widely spaced beams, the median
    distance to the nearest beam is used instead.
    """
    longer, shorter = (table, beams) if len(table) >= len(beams) else (beams, table)
    if len(longer) > 1.05 * len(table) + 1:
        return math.inf
    shifts = range(len(longer) - len(shorter) + 1)
    paired = min(float(np.quantile(np.abs(longer[s : s + len(shorter)] - shorter), 0.8)) for s in shifts)
    gap = float(np.median(-np.diff(table)))
    spanned = np.count_nonzero((table <= beams[0] + gap / 2) & (table >= beams[-1] - gap / 2))
    nearest = float(np.median(np.abs(beams[:, None] - table).min(axis=1)))
    return min(paired, nearest) if nearest <= gap / 10 and len(beams) >= 0.75 * spanned else paired


def estimate_sensor(scans: Sequence[Points], name: str = "mine") -> Estimate:
    """Estimate a sensor from scans in its frame; the range limits exclude one return in 10,000, and are rounded.

    The minimum is not above that of the nearest built-in sensor, else 0.5 m: the scans may hold nothing near.
    """
    xyz = np.concatenate([scan.xyz[scan.xyz.any(axis=1)] for scan in scans])
    if len(xyz) < FEWEST_RETURNS:
        raise InputError(f"{len(xyz)} returns are too few for an estimate: give scans with at least {FEWEST_RETURNS}.")
    beams = find_beams(scans)
    steps = steps_of_a_turn(scans, beams.of_point)
    elevations = beams.elevations.astype(float).round(3).tolist()
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
    off = float(np.median(beams.off([elevations_of(scan.xyz) for scan in scans])))
    return Estimate(sensor, beams, steps, off, ground is not None)


def _height(xyz: np.ndarray) -> float | None:
    """Height above the ground: the lowest frequent height of returns 3 to 20 m away, or None. The most frequent one
    may be that of hedges and cars."""
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
    if not len(apart):
        raise InputError("no beam returned at two azimuths in these scans. Are they whole?")
    step = float(np.quantile(apart, 0.3))
    for _ in range(3):
        near = gap[gap < 3.5 * step]
        step = float(near.sum() / (near / step).round().sum())
    return 360 / step


def full_reflectance(scans: Sequence[Points], usual: float | None = None) -> float | None:
    """Estimate the value of full reflectance; None if a file has no reflectance, or only one value.

    It is `usual`, if given, unless more than 1 % of the values exceed it.
    """
    if any(scan.reflectance is None for scan in scans):
        return None
    values = np.concatenate([scan.reflectance for scan in scans])
    highest = float(values.max())
    if highest <= max(0.0, float(values.min())):
        return None
    if usual and np.mean(values > usual) <= 0.01:
        return usual
    common = next((full for full in FULL_REFLECTANCE if highest <= full * (1 + 1e-3)), math.inf)
    if highest >= 0.1 * common:  # else the values would fill less than a tenth of the scale
        return common
    return float(f"{highest:.1g}") if float(f"{highest:.1g}") >= highest else float(f"{highest * 1.05:.2g}")


def find_beams(scans: Sequence[Points]) -> Beams:
    """Find beams by ring numbers, else by the order of the points, else by their elevations only."""
    beams = _beams([scan.with_lost_rays() for scan in scans])
    pairs = zip(beams.of_point, scans, strict=True)
    return replace(beams, of_point=[row if len(row) == len(scan.xyz) else row[scan.kept] for row, scan in pairs])


def _beams(scans: Sequence[Points]) -> Beams:
    """`find_beams` for all rows of the files, with lost rays at the origin."""
    elevations = [elevations_of(scan.xyz) for scan in scans]
    if all(scan.ring is not None for scan in scans):
        by_ring = _by_laser(elevations, [np.asarray(scan.ring, dtype=np.int64) for scan in scans], RINGS)
        if np.mean(by_ring.off(elevations) ** 2) < RINGLESS * np.nanvar(np.concatenate(elevations)):
            return by_ring
    if count := _lasers_of_firings(elevations):
        middle = median_of_seen(np.concatenate([e.reshape(-1, count) for e in elevations]))
        twice = count % 2 == 0 and np.nanmax(np.abs(middle[::2] - middle[1::2])) < SAME
        return _by_laser(elevations, [np.arange(len(e)) % count // (1 + twice) for e in elevations], FIRINGS)
    peaks = _by_elevation(elevations)
    if (rings := _rings(scans, elevations)) is not None:
        beams = _by_laser(elevations, rings, RING_AFTER_RING)
        # A ring with few returns may be merged with the next; elevation peaks separate them.
        more = peaks is not None and len(peaks.elevations) > len(beams.elevations)
        return replace(peaks, order=RING_AFTER_RING) if more and peaks is not None else beams
    if peaks is None and all(map(_is_scattered, scans)):
        raise NoBeamsError(
            "their points lie on no beams, as those of a Livox or another scanner whose pattern does not repeat, or of "
            "several scans in one file: they are no rows of a range image, which a spinning LiDAR makes"
        )
    if peaks is None:
        raise InputError(
            "the beams cannot be told apart: no ring numbers of beams, no known order of the points, and "
            "their elevations form no peaks. Are they scans of one sensor, in its own frame? If so, use a built-in one."
        )
    return peaks


def _is_scattered(scan: Points) -> bool:
    """Whether elevations are spread evenly within sectors of one degree of azimuth."""
    # The median gap between sorted elevations is 0.06 of the mean gap or less in real scans of any order, ln 2 for
    # points drawn at random, and 0.4 or more for scanners without beams.
    elevation = elevations_of(scan.xyz)
    seen = np.isfinite(elevation)
    elevation, sector = elevation[seen], np.degrees(np.arctan2(scan.xyz[seen, 1], scan.xyz[seen, 0])).astype(np.int64)
    order = np.lexsort((elevation, sector))
    gaps = np.diff(elevation[order])[np.diff(sector[order]) == 0]
    crowded = len(elevation) >= CROWDED * max(len(np.unique(sector)), 1)
    return crowded and bool(np.median(gaps) > SCATTERED * gaps.mean())


def _by_laser(elevations: list[np.ndarray], lasers: list[np.ndarray], order: str) -> Beams:
    """Beams from the laser of each point."""
    together, laser = np.concatenate(elevations), np.concatenate(lasers)
    seen = np.flatnonzero(np.isfinite(together) & (laser >= 0))
    seen = seen[np.argsort(laser[seen], kind="stable")]
    names, starts = np.unique(laser[seen], return_index=True)
    if not FEWEST <= len(names) <= MOST:
        raise InputError(f"the scans name {len(names)} lasers, not {FEWEST} to {MOST}. Are they of a spinning LiDAR?")
    middles = np.array([np.median(together[part]) for part in np.split(seen, starts[1:])])
    row = np.argsort(np.argsort(-middles, kind="stable"), kind="stable")
    table = np.full(int(laser.max()) + 1, -1)
    table[names] = row
    sorted_rows = len(set(np.diff(row))) == 1  # from the top or from the bottom
    first = min(names[0], 1) if order == RINGS else 0  # files number rings from 0 or 1
    whole = order != RING_AFTER_RING and len(names) == laser.max() - first + 1
    pairs = zip(elevations, lasers, strict=True)
    of_point = [np.where(np.isfinite(e) & (n >= 0), table[np.maximum(n, 0)], -1) for e, n in pairs]
    firing = tuple(row.tolist()) if whole and not sorted_rows else None
    return Beams(np.sort(middles)[::-1], of_point, order, firing)


def _lasers_of_firings(elevations: list[np.ndarray]) -> int | None:
    """Number of lasers of files with whole firings, the smallest period of the elevations; None for other files."""
    points, distances = math.gcd(*(len(e) for e in elevations)), {}
    for count in range(FEWEST, MOST + 1):
        if points % count or points // count < 8:
            continue
        tables = [e.reshape(-1, count) for e in elevations]
        tables = [table[np.linspace(0, len(table) - 1, min(len(table), 256)).astype(np.int64)] for table in tables]
        if all(scatter_of(table)[1] < TIGHT for table in tables):
            together = np.concatenate(tables)
            distances[count] = float(np.nanmean(np.abs(together - median_of_seen(together))))
    # Half the lasers also match if the others see only sky, but then a few returns are far from the medians.
    return next((count for count, d in distances.items() if d <= 1.5 * min(distances.values()) + 1e-3), None)


def _rings(scans: Sequence[Points], elevations: list[np.ndarray]) -> list[np.ndarray] | None:
    """Ring of each point, counted from the bottom, of files stored ring after ring; None for other files."""
    rings = []
    for scan, elevation in zip(scans, elevations, strict=True):
        ring = rings_from_order(scan.xyz)
        count = int(ring.max(initial=-1)) + 1
        if not FEWEST <= count <= MOST:
            return None
        seen = elevation[ring >= 0]
        starts = np.flatnonzero(np.diff(ring[ring >= 0])) + 1
        middles = np.array([np.median(part) for part in np.split(seen, starts)])
        falls = np.mean(np.diff(middles) < 0)
        spread = np.median(np.abs(seen - middles[ring[ring >= 0]]))
        if spread > TIGHT * np.median(np.abs(seen - np.median(seen))) or 0.1 < falls < 0.9:
            return None
        # Counted from the bottom, since rings that see only sky are missing at the top.
        rings.append(np.where(ring < 0, -1, count - 1 - ring if falls >= 0.9 else ring))
    return rings


def _by_elevation(elevations: list[np.ndarray]) -> Beams | None:
    """Beams as peaks of the density of elevations, at the bandwidth where their number is most stable, or None."""
    seen = np.concatenate(elevations)
    seen = seen[np.isfinite(seen)]
    low, high = np.quantile(seen, [1e-4, 1 - 1e-4])
    edges = np.arange(low - 3, high + 3 + BIN, BIN)
    size = 2 << len(edges).bit_length()  # the FFT of other sizes can be many times slower
    density = np.fft.rfft(np.histogram(seen, edges)[0], size)
    frequency = np.fft.rfftfreq(size, BIN)
    peaks_of = []
    for bandwidth in BANDWIDTHS:
        smooth = np.fft.irfft(density * np.exp(-2 * (np.pi * bandwidth * frequency) ** 2))[: len(edges) - 1]
        peaks = np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:])) + 1
        heights = smooth[peaks]
        # Returns from the vehicle itself have scattered elevations.
        peaks = peaks[heights > FAINT * np.median(heights[heights > 0.01 * heights.max()])]
        peaks_of.append(edges[peaks] + BIN / 2)
    numbers = np.array([len(peaks) for peaks in peaks_of])
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    runs = [(end - start, start) for start, end in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    length, start = max(((length, s) for length, s in runs if FEWEST <= numbers[s] <= MOST), default=(1, 0))
    if BANDWIDTHS[start + length - 1] < STABLE * BANDWIDTHS[start]:
        return None
    peaks = peaks_of[start + (length - 1) // 2][::-1]
    edges = (peaks[:-1] + peaks[1:]) / 2
    of_point = [np.where(np.isfinite(e), np.searchsorted(-edges, -np.nan_to_num(e)), -1) for e in elevations]
    together, row = np.concatenate(elevations), np.concatenate(of_point)
    medians = [np.median(together[row == beam]) if (row == beam).any() else peaks[beam] for beam in range(len(peaks))]
    return Beams(np.array(medians), of_point)
