"""Find the beams of a sensor in its scans."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby

import numpy as np
from numpy import ndarray
from scipy.ndimage import fourier_gaussian, median

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import Points
from r2flow.lidar.scan_files.tables import KEPT
from r2flow.lidar.unfolding import (
    FEWEST,
    MOST,
    TIGHT,
    elevations_of,
    few_firings,
    median_of_seen,
    rings_from_order,
    scatter_of,
)

_BANDWIDTHS = np.geomspace(0.015, 2.0, 50)  # degrees
_BIN = 0.005  # degrees
_FAINT = 0.02  # share of the median peak's height below which a peak is not a beam
_SAME = 0.02  # degrees: neighbouring lasers that are nearer are two returns of one
# Successive bandwidths, a factor of 1.6, over which the number of peaks must be constant.
_STABLE = 6
# Variance within rings over that of all, above which they are no beams; a tilt of 15 degrees has
# 0.81.
_RINGLESS = 0.95
# Median gap between elevations over their mean gap, above which a scan has no beams:
# `_is_scattered`.
_SCATTERED = 0.3
_CROWDED = 20  # minimum mean number of points per sector for a comparison of gaps

RINGS = "a ring number at each point"
FIRINGS = "firing after firing, rays without return kept"
RING_AFTER_RING = "ring after ring"
UNORDERED = "beams found by elevation only"


class NoBeamsError(InputError):
    """The scans are of a sensor without beams."""


@dataclass(frozen=True)
class Beams:
    """The beams of some scans."""

    elevations: ndarray  # median elevation of each beam in degrees, from the top, (H,)
    of_point: list[ndarray]  # row of each point of each scan; -1 for a ray without return
    order: str = UNORDERED  # storage order of the scans: `RINGS`, `FIRINGS`, ...
    firing: tuple[int, ...] | None = None  # row of laser 0, 1, ...; None: numbered by elevation

    def off(self, scans: Sequence[Points]) -> ndarray:
        """Distance of each return of the scans from its beam in degrees, (N,)."""
        elevation = np.concatenate([elevations_of(scan.xyz) for scan in scans])
        row = np.concatenate(self.of_point)
        return abs(elevation - self.elevations[row])[row >= 0]


@lru_cache(KEPT)
def find_beams(*scans: Points) -> Beams:
    """Find beams by ring numbers, else by the order of the points, else by their elevations only.

    Beams of the scans last asked for are kept: several judgements of a scan need them.

    Raises:
        NoBeamsError: The points lie on no beams.
        InputError: The beams cannot be told apart.
    """
    files = [scan.with_lost_rays() for scan in scans]
    beams = _beams_of_files(files)
    ends = np.cumsum([len(file.xyz) for file in files])
    rows = np.split(beams.of_point[0], ends[:-1])
    of_point = [
        row if file is scan else row[scan.kept]
        for row, file, scan in zip(rows, files, scans, strict=True)
    ]
    return replace(beams, of_point=of_point)


def check_rings(points: Points) -> None:
    """Refuse ring numbers that contradict the beams: elevations vary within rings as over all.

    Drivers without ring numbers write 0.
    """
    if points.ring is None or not points.ring.any():
        return
    elevation = elevations_of(points.xyz)
    seen = np.isfinite(elevation)
    ring = points.ring[seen]
    values = elevation[seen].astype(float)
    count = np.bincount(ring).clip(1)
    within = values - (np.bincount(ring, values) / count)[ring]
    if len(values) and within.var() >= _RINGLESS * values.var():
        raise InputError(
            "its ring numbers contradict the beams: elevations of a ring differ as those of all "
            "points. Give --columns ring=_ (the field's name), and beams are found without them."
        )


def _beams_of_files(files: Sequence[Points]) -> Beams:
    """`find_beams` for all rows of the files, with lost rays at the origin, as one array."""
    elevations = [elevations_of(file.xyz) for file in files]
    together = np.concatenate(elevations)
    rings = [file.ring for file in files if file.ring is not None and file.ring.any()]
    if len(rings) == len(files):  # drivers without ring numbers write 0
        beams = _beams_of_lasers(together, rings, RINGS)
        if np.mean(beams.off(files) ** 2) < _RINGLESS * np.nanvar(together):
            return beams
    count = _lasers_of_firings(elevations)
    if count:
        middle = median_of_seen(together.reshape(-1, count))
        laser = np.arange(len(together)) % count
        if count % 2 == 0 and np.fmax.reduce(abs(middle[::2] - middle[1::2])) < _SAME:
            laser //= 2
        return _beams_of_lasers(together, [laser], FIRINGS)
    peaks = _beams_of_elevations(together)
    stored = [rings_from_order(file.xyz) for file in files]
    rings = [ring for ring in stored if ring is not None]
    if len(rings) == len(files):
        beams = _beams_of_lasers(together, rings, RING_AFTER_RING)
        apart = -np.diff(beams.elevations).max() >= _SAME
        # A ring with few returns may be merged with the next; elevation peaks separate them.
        if apart and (peaks is None or len(peaks.elevations) <= len(beams.elevations)):
            return beams
        if peaks is not None:
            return replace(peaks, order=RING_AFTER_RING)
    if peaks is not None:
        return peaks
    if all(map(_is_scattered, files)):
        raise NoBeamsError(
            "their points lie on no beams, as those of a Livox or another scanner whose pattern "
            "does not repeat, or of several scans in one file: they are no rows of a range image, "
            "which a spinning LiDAR makes"
        )
    raise InputError(
        "the beams cannot be separated: no ring numbers of beams, no clear order of the points, "
        "and their elevations form no peaks. Are they scans of one sensor, in its own frame? If "
        "so, use a built-in one."
    )


def _is_scattered(scan: Points) -> bool:
    """Whether elevations are spread evenly within sectors of one degree of azimuth."""
    # The median gap between sorted elevations is 0.06 of the mean gap or less in real scans of any
    # order, ln 2 for points drawn at random, and 0.4 or more for scanners without beams.
    xyz = scan.xyz[np.isfinite(elevations_of(scan.xyz))]
    elevation = elevations_of(xyz)
    sector = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])).astype(int)
    order = np.lexsort((elevation, sector))
    gaps = np.diff(elevation[order])[np.diff(sector[order]) == 0]
    crowded = len(sector) >= _CROWDED * max(len(np.unique(sector)), 1)
    return crowded and np.median(gaps) > _SCATTERED * gaps.mean()


def _beams_of_lasers(elevation: ndarray, lasers: Sequence[ndarray], order: str) -> Beams:
    """Beams of points whose laser is known, -1 for none; rays without return are at NaN."""
    laser = np.concatenate(lasers).astype(int)
    highest = laser.max()
    laser[np.isnan(elevation)] = -1
    names = np.unique(laser[laser >= 0])
    if not FEWEST <= len(names) <= MOST:
        raise InputError(
            f"the scans name {len(names)} lasers, not {FEWEST} to {MOST}. Are they of a spinning "
            "LiDAR?"
        )
    middles = median(elevation, laser, names)
    from_top = np.argsort(-middles, kind="stable")
    row = np.argsort(from_top)
    table = np.full(highest + 2, -1)  # the last for laser -1
    table[names] = row
    firing = None
    first = min(names[0], 1) if order == RINGS else 0  # files number rings from 0 or 1
    whole = order != RING_AFTER_RING and len(names) == highest - first + 1
    if whole and len(set(np.diff(row))) > 1:  # not from the top or from the bottom
        firing = tuple(row.tolist())
    return Beams(middles[from_top], [table[laser]], order, firing)


def _lasers_of_firings(elevations: list[ndarray]) -> int | None:
    """Number of lasers of files with whole firings, or None: the smallest period of elevations."""
    points = math.gcd(*map(len, elevations))
    distances = {}
    for count in range(FEWEST, MOST + 1):
        if points % count or points // count < 8:
            continue
        tables = [few_firings(e.reshape(-1, count)) for e in elevations]
        if all(scatter_of(table)[1] < TIGHT for table in tables):
            together = np.concatenate(tables)
            distances[count] = np.nanmean(abs(together - median_of_seen(together)))
    # Half the lasers also match if the others see only sky, but then a few returns are far from the
    # medians.
    most = 1.5 * min(distances.values(), default=0) + 1e-3
    return next((count for count, distance in distances.items() if distance <= most), None)


def _beams_of_elevations(elevation: ndarray) -> Beams | None:
    """Beams as peaks of the density of elevations, or None.

    The bandwidth is the finest at which the number of peaks is stable.
    """
    returned = np.isfinite(elevation)
    seen = elevation[returned]
    low, high = np.quantile(seen, [1e-4, 1 - 1e-4])
    edges = np.arange(low - 3, high + 3 + _BIN, _BIN)
    size = 2 << len(edges).bit_length()  # the FFT of other sizes can be many times slower
    density = np.fft.rfft(np.histogram(seen, edges)[0], size)
    peaks_of = []
    for bandwidth in _BANDWIDTHS:
        smooth = np.fft.irfft(fourier_gaussian(density, bandwidth / _BIN, size))[: len(edges) - 1]
        before, here, after = smooth[:-2], smooth[1:-1], smooth[2:]
        # not scipy.signal.find_peaks, which takes half a second to import
        peaks = np.flatnonzero((before < here) & (here >= after)) + 1
        heights = smooth[peaks]
        # Returns from the vehicle itself have scattered elevations.
        typical = np.median(heights[heights > 0.01 * heights.max()])
        peaks_of.append(edges[peaks[heights > _FAINT * typical]] + _BIN / 2)
    runs = [[*run] for count, run in groupby(peaks_of, len) if FEWEST <= count <= MOST]
    # The finest: wider ones merge weak beams with strong neighbours.
    stable = next((run for run in runs if len(run) >= _STABLE), None)
    if stable is None:
        return None
    peaks = stable[(len(stable) - 1) // 2][::-1]
    row = np.searchsorted(-(peaks[:-1] + peaks[1:]) / 2, -np.nan_to_num(elevation))
    row[~returned] = -1
    elevations = peaks.astype(elevation.dtype)
    found = np.unique(row[returned])
    elevations[found] = median(elevation, row, found)
    return Beams(elevations, [row])
