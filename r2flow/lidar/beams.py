"""The beams of a sensor, found in its scans."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files import Points
from r2flow.lidar.unfolding import elevations_of, median_of_seen, rings_from_order, scatter_of

FEWEST, MOST = 4, 256  # beams of a sensor
SAME = 2e-3  # degrees; two returns of one ray are no farther apart
TIGHT = 0.1  # scatter (`scatter_of`) below which each column is one laser
BANDWIDTHS = np.geomspace(0.015, 2.0, 50)  # degrees
BIN = 0.005  # degrees
FAINT = 0.02  # share of the median peak's height below which a peak is no beam
STABLE = 1.5  # range of bandwidths, as a factor, over which the number of peaks must be constant

SCATTERED = (
    0.3  # median gap between elevations over their mean gap, above which no beams are there; see `_is_scattered`
)
CROWDED = 20  # points of a sector, on average, from which on its gaps tell something

RINGS = "a ring number at each point"
FIRINGS = "firing after firing, rays without return kept"
RING_AFTER_RING = "ring after ring"
LOSSY_FIRINGS = "firing after firing, rays without return left out"
UNORDERED = "in no order"


@dataclass(frozen=True)
class Beams:
    """The beams of a sensor.

    Attributes:
        elevations: Median elevation of each in degrees, the top one first, (H,).
        residuals: Median distance of its points from that, in degrees, (H,).
        counts: Points of each, (H,).
        order: How the scans are stored: `RINGS`, `FIRINGS`, ...
        firing: Row of laser 0, 1, ... of ring numbers or whole firings; None where lasers are counted from the top or
            from the bottom.
        stable: Where the beams are peaks of the elevations: the factor by which the bandwidth can change without
            changing their number; None where the files say which laser fired each point.
        of_point: Row of each point of each scan; -1 for a ray without return.
    """

    elevations: np.ndarray
    residuals: np.ndarray
    counts: np.ndarray
    order: str
    firing: tuple[int, ...] | None
    stable: float | None
    of_point: list[np.ndarray]


class NoBeamsError(InputError):
    """Scans of a sensor without beams."""


def find_beams(scans: Sequence[Points]) -> Beams:
    """The beams by ring numbers, else by the order of the points, else by their elevations alone.

    Raises:
        NoBeamsError: the points lie on no beams at all.
        InputError: no beams can be told apart.
    """
    whole = [scan.with_lost_rays() for scan in scans]
    found = _found(whole)
    pairs = zip(found.of_point, scans, strict=True)
    return replace(found, of_point=[row if len(row) == len(scan.xyz) else row[scan.kept] for row, scan in pairs])


def _found(scans: Sequence[Points]) -> Beams:
    """`find_beams` with all rows of the files, lost rays at the origin."""
    elevations = [elevations_of(scan.xyz) for scan in scans]
    if all(scan.ring is not None for scan in scans):
        lasers = [np.asarray(scan.ring, dtype=np.int64) for scan in scans]
        return _by_laser(elevations, lasers, RINGS)
    if count := _lasers_of_firings(elevations):
        table = _single_returns(elevations, count)
        return _by_laser(elevations, [table[np.arange(len(e)) % count] for e in elevations], FIRINGS)
    if (rings := _rings(scans, elevations)) is not None:
        by_ring = _by_laser(elevations, rings, RING_AFTER_RING)
        peaks = _by_elevation(elevations, RING_AFTER_RING)
        # A ring with few returns may be taken as part of the next; exact elevations separate the two.
        return peaks if peaks is not None and len(peaks.counts) > len(by_ring.counts) else by_ring
    found = _by_elevation(elevations, LOSSY_FIRINGS if _is_swept(scans) else UNORDERED)
    if found is None and all(map(_is_scattered, scans)):
        raise NoBeamsError(
            "their points lie on no beams, as those of a Livox or another scanner whose pattern does not repeat, or of "
            "several scans in one file: they are no rows of a range image, which a spinning LiDAR makes"
        )
    if found is None:
        raise InputError(
            "the beams cannot be told apart: the files have no ring numbers, the points are in no known order, and "
            "their elevations form no peaks. Are they scans of one sensor, in its own frame? If so, use a built-in one."
        )
    return found


def _is_scattered(scan: Points) -> bool:
    """Whether elevations are spread evenly within sectors of one degree of azimuth.

    Points on beams leave many small gaps between sorted elevations and a few wide ones: the median gap is a small part
    of the mean (0.06 and less in real scans, whatever their order). Points that were drawn at random have ln 2 of it,
    and patterns of scanners without beams 0.4 and more.
    """
    elevation = elevations_of(scan.xyz)
    seen = np.isfinite(elevation)
    elevation, sector = elevation[seen], np.degrees(np.arctan2(scan.xyz[seen, 1], scan.xyz[seen, 0])).astype(np.int64)
    if len(elevation) < CROWDED * max(len(np.unique(sector)), 1):
        return False
    order = np.lexsort((elevation, sector))
    gaps = np.diff(elevation[order])[np.diff(sector[order]) == 0]
    return bool(np.median(gaps) > SCATTERED * gaps.mean())


def _by_laser(elevations: list[np.ndarray], lasers: list[np.ndarray], order: str) -> Beams:
    """Beams where the laser of each point is known."""
    together, laser = np.concatenate(elevations), np.concatenate(lasers)
    seen = np.flatnonzero(np.isfinite(together) & (laser >= 0))
    seen = seen[np.argsort(laser[seen], kind="stable")]
    known, starts = np.unique(laser[seen], return_index=True)
    middles = np.array([np.median(together[part]) for part in np.split(seen, starts[1:])])
    if not FEWEST <= len(known) <= MOST:
        raise InputError(f"the scans name {len(known)} lasers, not {FEWEST} to {MOST}. Are they of a spinning LiDAR?")
    row = np.argsort(np.argsort(-middles, kind="stable"), kind="stable")
    table = np.full(int(laser.max()) + 1, -1)
    table[known] = row
    upwards = (row == np.arange(len(row))).all() or (row == np.arange(len(row))[::-1]).all()
    first = min(known[0], 1) if order == RINGS else 0  # files count their rings from 0 or from 1
    whole = order in (RINGS, FIRINGS) and len(known) == laser.max() - first + 1
    firing = tuple(row.tolist()) if whole and not upwards else None
    of_point = [
        np.where(np.isfinite(e) & (one >= 0), table[np.maximum(one, 0)], -1)
        for e, one in zip(elevations, lasers, strict=True)
    ]
    return _measured(elevations, of_point, len(known), order, firing=firing)


def _measured(
    elevations: list[np.ndarray],
    of_point: list[np.ndarray],
    rows: int,
    order: str,
    firing: tuple[int, ...] | None = None,
    stable: float | None = None,
) -> Beams:
    """The beams from the elevation and the row of each point of each scan."""
    elevation, row = np.concatenate(elevations), np.concatenate(of_point)
    middles, residuals, counts = np.zeros(rows), np.zeros(rows), np.bincount(row[row >= 0], minlength=rows)
    by_row = np.argsort(row, kind="stable")[np.count_nonzero(row < 0) :]
    for beam, points in enumerate(np.split(by_row, np.cumsum(counts)[:-1])):
        if len(points):
            middles[beam] = np.median(elevation[points])
            residuals[beam] = np.median(np.abs(elevation[points] - middles[beam]))
    return Beams(middles, residuals, counts, order, firing, stable, of_point)


def _lasers_of_firings(elevations: list[np.ndarray]) -> int | None:
    """Lasers of files that hold whole firings: the smallest period of the elevations; None where there is none."""
    distances = {}
    for count in _divisors(math.gcd(*(len(e) for e in elevations))):
        tables = [_some(e.reshape(-1, count)) for e in elevations]
        if all(scatter_of(table)[1] < TIGHT for table in tables):
            table = np.concatenate(tables)
            distances[count] = float(np.nanmean(np.abs(table - median_of_seen(table))))
    # Half the lasers fit too where the others see only sky, but then a few returns are far from the medians.
    fitting = [count for count, distance in distances.items() if distance <= 1.5 * min(distances.values()) + 1e-3]
    return min(fitting, default=None)


def _single_returns(elevations: list[np.ndarray], count: int) -> np.ndarray:
    """Laser of each of the `count` points of a firing: of two returns of each ray, stored one after the other, one."""
    each = np.arange(count)
    middle = median_of_seen(np.concatenate([_some(e.reshape(-1, count)) for e in elevations]))
    twice = count % 2 == 0 and bool(np.nanmax(np.abs(middle[::2] - middle[1::2]), initial=0) < SAME)
    return each // 2 if twice and count // 2 >= FEWEST else each


def _divisors(number: int) -> list[int]:
    return [count for count in range(FEWEST, MOST + 1) if number % count == 0 and number // count >= 8]


def _some(table: np.ndarray) -> np.ndarray:
    return table[np.linspace(0, len(table) - 1, min(len(table), 256)).astype(np.int64)]


def _rings(scans: Sequence[Points], elevations: list[np.ndarray]) -> list[np.ndarray] | None:
    """Ring of each point, counted from the bottom, where files are stored ring after ring; else None."""
    rings = []
    for scan, elevation in zip(scans, elevations, strict=True):
        ring = rings_from_order(scan.xyz)
        count = int(ring.max(initial=-1)) + 1
        if not FEWEST <= count <= MOST:
            return None
        seen = np.flatnonzero(ring >= 0)
        middles = np.array(
            [np.median(elevation[part]) for part in np.split(seen, np.flatnonzero(np.diff(ring[seen])) + 1)]
        )
        about = np.abs(elevation[seen] - middles[ring[seen]])
        overall = np.median(np.abs(elevation[seen] - np.median(elevation[seen])))
        if np.median(about) > TIGHT * overall:
            return None
        falls = np.mean(np.diff(middles) < 0)
        if 0.1 < falls < 0.9:
            return None
        # Counted from the bottom, since rings that see only sky are missing at the top.
        rings.append(np.where(ring < 0, -1, count - 1 - ring if falls >= 0.9 else ring))
    return rings


def _is_swept(scans: Sequence[Points]) -> bool:
    """Whether points follow each other closely in azimuth."""
    steps = []
    for scan in scans:
        azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])[np.abs(scan.xyz[:, :2]).sum(1) > 0]
        steps.append(np.abs((np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi))
    return float(np.median(np.concatenate(steps))) < math.radians(10)


def _by_elevation(elevations: list[np.ndarray], order: str) -> Beams | None:
    """Beams as peaks of the density of elevations, at bandwidths where their number is most stable; None without."""
    together = np.concatenate(elevations)
    seen = together[np.isfinite(together)]
    low, high = np.quantile(seen, [1e-4, 1 - 1e-4])
    edges = np.arange(low - 3, high + 3 + BIN, BIN)
    size = 2 << len(edges).bit_length()  # other sizes can take many times as long to transform
    density = np.fft.rfft(np.histogram(seen, edges)[0], size)
    frequency = np.fft.rfftfreq(size, BIN)
    found = []
    for bandwidth in BANDWIDTHS:
        smooth = np.fft.irfft(density * np.exp(-2 * (np.pi * bandwidth * frequency) ** 2))[: len(edges) - 1]
        peaks = np.flatnonzero((smooth[1:-1] > smooth[:-2]) & (smooth[1:-1] >= smooth[2:])) + 1
        heights = smooth[peaks]
        # Returns from the vehicle itself have any elevation, few of each.
        peaks = peaks[heights > FAINT * np.median(heights[heights > 0.01 * heights.max()])]
        found.append(edges[peaks] + BIN / 2)
    numbers = np.array([len(peaks) for peaks in found])
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    runs = [(end - start, start) for start, end in zip(starts, [*starts[1:], len(numbers)], strict=True)]
    runs = [(length, start) for length, start in runs if FEWEST <= numbers[start] <= MOST]
    length, start = max(runs, default=(1, 0))
    stable = float(BANDWIDTHS[start + length - 1] / BANDWIDTHS[start])
    if stable < STABLE:
        return None
    peaks = found[start + (length - 1) // 2][::-1]
    edges = (peaks[:-1] + peaks[1:]) / 2
    of_point = [np.where(np.isfinite(e), np.searchsorted(-edges, -np.nan_to_num(e)), -1) for e in elevations]
    return _measured(elevations, of_point, len(peaks), order, stable=stable)
