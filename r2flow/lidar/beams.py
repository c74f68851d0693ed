"""Find the beams of a sensor in its scans."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files import Points
from r2flow.lidar.unfolding import elevations_of, median_of_seen, rings_from_order, scatter_of

FEWEST, MOST = 4, 256  # limits of the number of beams
TIGHT = 0.1  # scatter (`scatter_of`) below which each column is one laser
BANDWIDTHS = np.geomspace(0.015, 2.0, 50)  # degrees
BIN = 0.005  # degrees
FAINT = 0.02  # share of the median peak's height below which a peak is not a beam
SAME = 0.02  # degrees: neighbouring lasers that are nearer are two returns of one
STABLE = 1.5  # range of bandwidths, as a factor, over which the number of peaks must be constant
RINGLESS = 0.95  # variance within rings over that of all, above which rings are no beams; 15 degrees of tilt have 0.81
SCATTERED = 0.3  # median gap between elevations over their mean gap, above which a scan has no beams: `_is_scattered`
CROWDED = 20  # minimum mean number of points per sector for a comparison of gaps

RINGS = "a ring number at each point"
FIRINGS = "firing after firing, rays without return kept"
RING_AFTER_RING = "ring after ring"
UNORDERED = "beams found by elevation only"


class NoBeamsError(InputError):
    """The scans are of a sensor without beams."""


@dataclass(frozen=True)
class Beams:
    elevations: np.ndarray  # median elevation of each beam in degrees, from the top, (H,)
    of_point: list[np.ndarray]  # row of each point of each scan; -1 for a ray without return
    order: str = UNORDERED  # storage order of the scans: `RINGS`, `FIRINGS`, ...
    firing: tuple[int, ...] | None = None  # row of laser 0, 1, ...; None if lasers are numbered by elevation

    def off(self, scans: Sequence[Points]) -> np.ndarray:
        """Distance of each return of the scans from its beam in degrees, (N,)."""
        pairs = zip(scans, self.of_point, strict=True)
        return np.concatenate([np.abs(elevations_of(s.xyz) - self.elevations[row])[row >= 0] for s, row in pairs])


def find_beams(*scans: Points) -> Beams:
    """Find beams by ring numbers, else by the order of the points, else by their elevations only."""
    beams = _beams([scan.with_lost_rays() for scan in scans])
    pairs = zip(beams.of_point, scans, strict=True)
    return replace(beams, of_point=[row if len(row) == len(scan.xyz) else row[scan.kept] for row, scan in pairs])


def _beams(scans: Sequence[Points]) -> Beams:
    """`find_beams` for all rows of the files, with lost rays at the origin."""
    elevations = [elevations_of(scan.xyz) for scan in scans]
    if all(scan.ring is not None and scan.ring.any() for scan in scans):  # drivers without ring numbers write 0
        by_ring = _by_laser(elevations, [np.asarray(scan.ring, dtype=np.int64) for scan in scans], RINGS)
        if np.mean(by_ring.off(scans) ** 2) < RINGLESS * np.nanvar(np.concatenate(elevations)):
            return by_ring
    if count := _lasers_of_firings(elevations):
        middle = median_of_seen(np.concatenate([e.reshape(-1, count) for e in elevations]))
        twice = count % 2 == 0 and np.fmax.reduce(np.abs(middle[::2] - middle[1::2])) < SAME
        return _by_laser(elevations, [np.arange(len(e)) % count // (1 + twice) for e in elevations], FIRINGS)
    peaks = _by_elevation(elevations)
    if (rings := _rings(scans, elevations)) is not None:
        beams = _by_laser(elevations, rings, RING_AFTER_RING)
        # A ring with few returns may be merged with the next; elevation peaks separate them.
        if peaks is not None and len(peaks.elevations) > len(beams.elevations):
            return replace(peaks, order=RING_AFTER_RING)
        return beams
    if peaks is not None:
        return peaks
    if all(map(_is_scattered, scans)):
        raise NoBeamsError(
            "their points lie on no beams, as those of a Livox or another scanner whose pattern does not repeat, or of "
            "several scans in one file: they are no rows of a range image, which a spinning LiDAR makes"
        )
    raise InputError(
        "the beams cannot be separated: no ring numbers of beams, no clear order of the points, and "
        "their elevations form no peaks. Are they scans of one sensor, in its own frame? If so, use a built-in one."
    )


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
