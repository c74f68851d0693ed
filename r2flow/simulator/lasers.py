"""The lasers of a sensor: positions, inclinations, and the image rows of their returns.

The rows of a range image are evenly spaced; the lasers of a real sensor are not, and fire from two
blocks of lenses above the origin of the points. A return at range r from a laser of inclination E
and height z has the elevation

    e = asin((z + s tan E) / r),    s the horizontal distance,

which depends on r: near returns move up by whole rows. Therefore rows of real projected scans are
empty in some places and full in others.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.lidar.sensors import Sensor
from r2flow.simulator.tables import TABLES

Arrays = tuple[ndarray, ...]


@dataclass(frozen=True, eq=False)  # compared and hashed by identity
class _Lasers:
    """B lasers on a spinning head."""

    elevation: ndarray  # inclination E in radians, decreasing, (B,)
    height: ndarray  # height z of each laser above the sensor's origin in metres, (B,)
    side: ndarray  # distance of each laser to the left of the axis, seen outwards, in metres, (B,)
    # number of the lens block of each laser, (B,); the lasers of a block are close together
    block: ndarray
    phase: ndarray  # place of the first firing in the azimuth bin, as a share of half a bin, (B,)
    bias: ndarray | float  # error of each laser's range in metres, (B, 1)
    gain: ndarray | float  # error of each laser's reflectance, (B, 1)
    straight: bool  # whether laser b fires along the bin centres of image row b


_BELOW, _BIAS, _GAIN = np.loadtxt(
    Path(__file__).with_name("hdl64e.csv"), delimiter=",", unpack=True
)
HDL64E = _Lasers(
    elevation=-np.deg2rad(_BELOW),
    height=np.concatenate([np.linspace(0.209, 0.198, 32), np.linspace(0.126, 0.116, 32)]),
    side=np.tile([0.026, -0.026], 32),  # neighbours are left and right of the axis
    block=np.repeat([0, 1], 32),
    phase=np.modf(0.618 * np.arange(64))[0],  # unknown; neighbours differ
    bias=_BIAS.astype(np.float32)[:, None],
    gain=_GAIN.astype(np.float32)[:, None],
    straight=False,
)


@lru_cache(maxsize=16)
def lasers_of(sensor: Sensor) -> _Lasers:
    """The lasers of a sensor: the calibrated lasers of an HDL-64E for any image size, else a laser
    along each row.
    """
    return HDL64E if sensor.name == "hdl64e" else _along_rows(sensor)


def _along_rows(sensor: Sensor) -> _Lasers:
    """Lasers along `sensor.rays("centre")`, all at the origin."""
    elevation = np.deg2rad(np.asarray(sensor.elevations, dtype=np.float64))
    zero = np.zeros_like(elevation)
    return _Lasers(elevation, zero, zero, zero.astype(int), zero, bias=0.0, gain=0.0, straight=True)


def rows_of(sensor: Sensor, slope: ndarray) -> ndarray:
    """Row of each return by its apparent slope tan e; -1 outside the field of view."""
    falling = np.tan(np.deg2rad(sensor.row_edges)).astype(np.float32)
    h = len(sensor.elevations)
    row = h - np.searchsorted(falling[::-1], slope, side="right")
    return np.where(row < h, row, -1)


class Rays:
    """B lasers by W azimuths; `ground` is the height of the sensor's origin above the scene's z =
    0, in metres.

    Every ray is p(s) = (s cos a, s sin a, z + s T) with horizontal distance s, azimuth a of the
    column, slope T = tan E and height z of the laser. The s of an intersection with an upright
    surface depends on the column only.
    """

    def __init__(self, lasers: _Lasers, columns: int, ground: float) -> None:
        self.lasers = lasers
        self.columns = columns
        self.ground = ground
        self.shape = len(lasers.elevation), columns
        # a in radians, (W,), float64
        self.azimuth = np.pi - 2 * np.pi * (np.arange(columns) + 0.5) / columns
        self.cos = np.cos(self.azimuth).astype(np.float32)
        self.sin = np.sin(self.azimuth).astype(np.float32)
        self.slope = np.tan(lasers.elevation).astype(np.float32)  # T, decreasing, (B,)
        # z of each laser above the scene's z = 0, (B,)
        self.height = (lasers.height + ground).astype(np.float32)


def _expand(first: ndarray, count: ndarray) -> tuple[ndarray, ndarray]:
    """All integers first_k <= j < first_k + count_k: (k, j), each (sum of counts,), int32."""
    count = np.maximum(count, 0)
    k = np.repeat(np.arange(len(count), dtype=np.int32), count)
    start = np.cumsum(count) - count - first
    return k, np.arange(len(k), dtype=np.int32) - start[k].astype(np.int32)


def column_windows(azimuth: ndarray, half: ndarray, columns: int) -> tuple[ndarray, ndarray]:
    """Pairs (object k, column w) with an azimuth within half_k of azimuth_k, (N,) each, int32."""
    half = np.minimum(half, np.pi * (1 - 1e-9))
    edges = (np.pi - azimuth + [-half, half]) * (columns / (2 * np.pi)) - 0.5
    first = np.ceil(edges[0]).astype(np.int64)
    last = np.floor(edges[1]).astype(np.int64)
    k, w = _expand(first, np.minimum(last - first + 1, columns))
    return k, w % columns


def row_windows(rays: Rays, spans: Arrays, bottom: ndarray, top: ndarray) -> Arrays:
    """The rays that may intersect solids between their bottom and top.

    A span is a solid k, a column w, distances near and far, and more arrays; (N,) each. Returns the
    pixel b W + w, the slope and height of the laser b, and the span of each ray; (F,) each.
    """
    k, w, near, far, *_ = spans
    falling = bottom[k] - rays.height.max()
    rising = top[k] - rays.height.min()
    least = falling / np.where(falling < 0, near, far)
    most = rising / np.where(rising > 0, near, far)
    first = np.searchsorted(-rays.slope, -most, side="left")
    last = np.searchsorted(-rays.slope, -least, side="right")
    n, b = _expand(first, last - first)
    return b * rays.columns + w[n], rays.slope[b], rays.height[b], *(q[n] for q in spans)


# Parts of the ego vehicle's roof, with an instrument next to the sensor, and without.
RIGS = ([*TABLES["roof"], TABLES["instrument"]], TABLES["roof"])


@lru_cache(maxsize=16)
def hidden(lasers: _Lasers, columns: int, rig: int) -> ndarray:
    """Rays that the ego vehicle occludes, (B, W), bool, for one of `RIGS`."""
    azimuth = 180 - 360 * (np.arange(columns) + 0.5) / columns
    elevation = np.rad2deg(lasers.elevation)[:, None]
    hidden = np.zeros((len(elevation), columns), bool)
    for half_width, half_height, power, below, away, grounded, places in RIGS[rig]:
        up = (elevation + below) / half_height
        up = np.abs(np.maximum(up, 0) if grounded else up) ** power
        turned = azimuth - np.rad2deg(np.arctan2(lasers.side, away))[:, None]
        for place in places:
            across = ((turned - place + 180) % 360 - 180) / half_width
            hidden |= np.abs(across) ** power + up < 1
    hidden.setflags(write=False)
    return hidden
