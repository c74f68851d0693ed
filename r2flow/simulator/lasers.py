"""The lasers of a sensor: positions, inclinations, and the image rows of their returns.

The rows of a range image are evenly spaced; the lasers of a real sensor are not, and fire from two blocks of lenses
above the origin of the points. A return at range r from a laser of inclination E and height z has the elevation

    e = asin((z + s tan E) / r),    s the horizontal distance,

which depends on r: near returns move up by whole rows. Therefore rows of real projected scans are empty in some places
and full in others.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from r2flow.lidar.sensors import Sensor


@dataclass(frozen=True, eq=False)  # compared and hashed by identity
class Lasers:
    """B lasers on a spinning head."""

    elevation: np.ndarray  # inclination E in radians, decreasing, (B,)
    height: np.ndarray  # height z of each laser above the sensor's origin in metres, (B,)
    side: np.ndarray  # distance of each laser to the left of the axis, seen outwards, in metres, (B,)
    block: np.ndarray  # number of the lens block of each laser, (B,); the lasers of a block are close together
    phase: np.ndarray  # position of each laser's first firing in its azimuth bin, as a share of half a bin, (B,)
    bias: np.ndarray  # error of each laser's range in metres, (B,)
    gain: np.ndarray  # error of each laser's reflectance, (B,)
    straight: bool  # whether laser b fires along the bin centres of image row b


# Inclinations in degrees of an HDL-64E S2, fitted by z = z_i + s tan E_i to the 64 rings of a drive's scans. Residuals:
# 0.001 degrees for the upper block, 0.005 for the lower.
_HDL64E_UPPER = (
    1.94, 1.57, 1.30, 0.87, 0.58, 0.18, -0.09, -0.45, -0.80, -1.20, -1.49, -1.83, -2.21, -2.55, -2.87, -3.24,
    -3.54, -3.94, -4.22, -4.59, -4.91, -5.25, -5.61, -5.96, -6.33, -6.68, -7.00, -7.29, -7.68, -8.06, -8.31, -8.71,
)  # fmt: skip
_HDL64E_LOWER = (
    -9.03, -9.57, -10.06, -10.47, -10.96, -11.60, -12.12, -12.56, -13.04, -13.48, -14.05, -14.60, -15.19, -15.66,
    -16.18, -16.55, -17.19, -17.73, -18.32, -18.80, -19.32, -19.74, -20.22, -20.79, -21.32, -21.94, -22.44, -22.86,
    -23.32, -23.97, -24.51, -25.00,
)  # fmt: skip
# Difference of each laser's reflectance from its neighbours', on the same road and walls.
_HDL64E_GAIN = (
    0.00, -0.04, -0.06, -0.10, -0.01, -0.04, 0.04, -0.02, 0.05, -0.04, 0.02, 0.04, 0.08, 0.03, -0.01, 0.00,
    0.01, 0.00, 0.04, -0.05, 0.00, -0.13, 0.00, 0.01, -0.05, -0.02, 0.00, 0.02, 0.02, -0.06, 0.02, 0.03,
    -0.01, -0.02, 0.00, -0.11, -0.18, 0.00, 0.05, 0.04, -0.03, 0.00, -0.15, 0.00, 0.00, 0.00, 0.01, -0.02,
    -0.06, 0.03, 0.06, -0.21, 0.00, -0.06, -0.07, 0.00, 0.02, 0.04, -0.11, -0.10, -0.11, -0.02, 0.02, 0.00,
)  # fmt: skip

# Error of each laser's range in metres. Upper block: summed steps between neighbouring rings on upright walls; drives
# agree (correlation 0.96). Lower block, which rarely sees walls: distances of the rings from a smooth surface through
# the road 4 to 11 metres away, medians over three drives, which agree within a centimetre.
_HDL64E_BIAS = (
    0.006, -0.025, 0.024, -0.031, 0.007, -0.085, 0.051, -0.015, -0.022, 0.012, 0.046, 0.006, 0.042, 0.015, -0.012,
    -0.021, 0.036, -0.005, 0.064, -0.005, 0.003, -0.033, -0.023, -0.027, 0.022, -0.022, 0.009, -0.050, 0.035,
    -0.006, 0.003, 0.000,
    0.015, -0.004, 0.005, -0.012, 0.002, -0.025, 0.054, 0.027, -0.007, 0.022, -0.059, -0.059, 0.005, -0.062, -0.050,
    -0.060, -0.012, 0.018, -0.023, -0.036, -0.002, 0.040, -0.015, 0.004, 0.004, 0.010, 0.023, 0.006, 0.003, 0.049,
    0.090, 0.098,
)  # fmt: skip


HDL64E = Lasers(
    elevation=np.deg2rad(np.array(_HDL64E_UPPER + _HDL64E_LOWER)),
    height=np.concatenate([np.linspace(0.209, 0.198, 32), np.linspace(0.126, 0.116, 32)]),
    side=np.tile([0.026, -0.026], 32),  # neighbours are left and right of the axis
    block=np.repeat([0, 1], 32),
    phase=np.modf(0.618 * np.arange(64))[0],  # unknown; neighbours differ
    bias=np.array(_HDL64E_BIAS),
    gain=np.array(_HDL64E_GAIN),
    straight=False,
)


@lru_cache(maxsize=16)
def lasers_of(sensor: Sensor) -> Lasers:
    """The lasers of a sensor: the calibrated lasers of an HDL-64E for any image size, else a laser along each row."""
    return HDL64E if sensor.name == "hdl64e" else along_rows(sensor)


def along_rows(sensor: Sensor) -> Lasers:
    """Lasers along `sensor.rays("centre")`, all at the origin."""
    elevation = np.deg2rad(np.asarray(sensor.elevations, dtype=np.float64))
    zero = np.zeros_like(elevation)
    return Lasers(elevation, zero, zero, zero.astype(int), zero, zero, zero, straight=True)


def rows_of(sensor: Sensor, slope: np.ndarray) -> np.ndarray:
    """Row of each return by its apparent slope tan e; -1 outside the field of view."""
    edges = np.tan(np.deg2rad(sensor.row_edges))[::-1].astype(np.float32)  # ascending, for searchsorted
    h = len(sensor.elevations)
    row = h - np.searchsorted(edges, slope, side="right")
    return np.where((row >= 0) & (row < h), row, -1)


class Rays:
    """B lasers by W azimuths; `ground` is the height of the sensor's origin above the scene's z = 0, in metres.

    Every ray is p(s) = (s cos a, s sin a, z + s T) with horizontal distance s, azimuth a of the column, slope T = tan E
    and height z of the laser. The s of an intersection with an upright surface depends on the column only.
    """

    def __init__(self, lasers: Lasers, columns: int, ground: float) -> None:
        self.lasers, self.columns, self.ground = lasers, columns, ground
        self.shape = len(lasers.elevation), columns
        self.azimuth = np.pi - 2 * np.pi * (np.arange(columns) + 0.5) / columns  # a in radians, (W,), float64
        self.cos, self.sin = np.cos(self.azimuth).astype(np.float32), np.sin(self.azimuth).astype(np.float32)
        self.slope = np.tan(lasers.elevation).astype(np.float32)  # T, decreasing, (B,)
        self.height = (lasers.height + ground).astype(np.float32)  # z of each laser above the scene's z = 0, (B,)


def expand(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers first_k <= j < first_k + count_k: (k, j), each (sum of counts,), int32."""
    count = np.maximum(count, 0)
    k = np.repeat(np.arange(len(count), dtype=np.int32), count)
    start = np.cumsum(count) - count
    return k, np.arange(len(k), dtype=np.int32) - (start - first)[k].astype(np.int32)


def column_windows(azimuth: np.ndarray, half: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (object k, column w) with an azimuth within half_k of azimuth_k, (N,) each, int32."""
    to_column = columns / (2 * np.pi)
    half = np.minimum(half, np.pi * (1 - 1e-9))
    first = np.ceil((np.pi - azimuth - half) * to_column - 0.5).astype(np.int64)
    last = np.floor((np.pi - azimuth + half) * to_column - 0.5).astype(np.int64)
    k, w = expand(first, np.minimum(last - first + 1, columns))
    return k, w % columns


def row_windows(
    rays: Rays, near: np.ndarray, far: np.ndarray, bottom: np.ndarray, top: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, laser b) that may intersect [bottom, top] between distances near and far, (F,) each, int32."""
    low, high = rays.height.min(), rays.height.max()
    falling, rising = bottom - high, top - low
    least = falling / np.where(falling < 0, near, far)
    most = rising / np.where(rising > 0, near, far)
    descending = -rays.slope
    first = np.searchsorted(descending, -most, side="left")
    last = np.searchsorted(descending, -least, side="right")
    return expand(first, last - first)


class Silhouette(NamedTuple):
    """A part of the ego vehicle, from two KITTI drives: |across|^p + |up|^p < 1 in degrees; `grounded`: straight down.

    It is about a metre away, nearer than any valid return, so that scans show only its shadow. Lasers next to the axis
    see it displaced: neighbouring rings are occluded alternately to the left and right.
    """

    azimuth: float
    elevation: float
    half_width: float
    half_height: float
    away: float  # distance in metres from the axis, which determines the shift of neighbouring rings
    grounded: bool = False
    power: int = 2


_ROOF = (
    Silhouette(0, -26.5, 22, 5.0, 1.2, grounded=True),
    Silhouette(34, -26.2, 6, 2.6, 0.8, grounded=True),
    Silhouette(-34, -26.2, 6, 2.6, 0.8, grounded=True),
    Silhouette(131, -23.2, 5.0, 2.4, 0.7, grounded=True),
    Silhouette(-128, -23.2, 5.0, 2.4, 0.7, grounded=True),
    Silhouette(142, -26.5, 14, 2.9, 0.8, grounded=True),
    Silhouette(-142, -26.5, 14, 2.9, 0.8, grounded=True),
    Silhouette(163, -26, 15, 6.2, 1.2, grounded=True),
    Silhouette(-163, -26, 15, 6.2, 1.2, grounded=True),
    Silhouette(180, -26, 18, 6.6, 1.5, grounded=True, power=6),
    Silhouette(161, -17.0, 4.2, 4.0, 1.0, power=4),
    Silhouette(-158.5, -17.0, 4.2, 4.0, 1.0, power=4),
)
# A roof with its posts; with an instrument next to the sensor, and without.
RIGS = ((*_ROOF, Silhouette(-69, -20.0, 11.0, 4.4, 0.55)), _ROOF)


@lru_cache(maxsize=16)
def hidden(lasers: Lasers, columns: int, rig: int) -> np.ndarray:
    """Rays that the ego vehicle occludes, (B, W), bool, for one of `RIGS`."""
    azimuth = 180 - 360 * (np.arange(columns) + 0.5) / columns
    e = np.rad2deg(lasers.elevation)[:, None]
    hidden = np.zeros((len(e), columns), bool)
    for s in RIGS[rig]:
        shift = np.rad2deg(np.arctan2(lasers.side, s.away))[:, None]
        across = ((azimuth - shift - s.azimuth + 180) % 360 - 180) / s.half_width
        up = (e - s.elevation) / s.half_height
        up = np.maximum(up, 0) if s.grounded else up
        hidden |= np.abs(across) ** s.power + np.abs(up) ** s.power < 1
    hidden.setflags(write=False)
    return hidden
