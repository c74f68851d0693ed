"""The lasers of a sensor: where each starts, its inclination, and the row of the image that a return falls into.

The rows of a range image are evenly spaced; the lasers of a real sensor are not, and fire from two blocks of lenses
above the origin of the points. A return at range r from a laser of inclination E and height z has the elevation

    e = asin((z + s tan E) / r),    s the horizontal distance,

which depends on r: near returns move up by whole rows. That is why rows of real projected scans are empty in some
places and full in others.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from r2flow.lidar.sensors import Sensor


@dataclass(frozen=True)
class Lasers:
    """B lasers on a spinning head.

    Attributes:
        elevation: Inclination E in radians, falling, (B,).
        height: Height z of each laser above the sensor's origin in metres, (B,).
        side: Distance of each laser to the left of the axis, seen outwards, in metres, (B,).
        block: Number of the lens block of each laser, (B,); the lasers of one block are close together.
        phase: Where in its first azimuth bin each laser fires first, as a share of half a bin, (B,).
        bias: Error of each laser's range in metres, (B,).
        gain: Error of each laser's reflectance, (B,).
        straight: Whether laser b looks along the middles of the bins of the image's row b.
    """

    elevation: np.ndarray
    height: np.ndarray
    side: np.ndarray
    block: np.ndarray
    phase: np.ndarray
    bias: np.ndarray
    gain: np.ndarray
    straight: bool


# Inclinations in degrees of an HDL-64E S2, found by fitting z = z_i + s tan E_i to the 64 rings of scans of
# a drive; the fit's residual is 0.001 degrees for the upper block and 0.005 for the lower.
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

# Error of each laser's range in metres. Upper block: steps between neighbouring rings on upright walls, summed; drives
# agree (correlation 0.96). Lower block, where walls are rare: distances of the rings from a smooth surface through the
# road 4 to 11 metres away, medians over three drives, which agree within a centimetre.
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
    side=np.tile([0.026, -0.026], 32),  # neighbours sit left and right of the axis
    block=np.repeat([0, 1], 32),
    phase=np.modf(0.618 * np.arange(64))[0],  # not known, but neighbours differ
    bias=np.array(_HDL64E_BIAS),
    gain=np.array(_HDL64E_GAIN),
    straight=False,
)


@lru_cache(maxsize=16)
def lasers_of(sensor: Sensor) -> Lasers:
    """The lasers of a sensor: calibrated ones of an HDL-64E, whatever its image size, else one along each row."""
    return HDL64E if sensor.name == "hdl64e" else along_rows(sensor)


def along_rows(sensor: Sensor) -> Lasers:
    """Lasers exactly along `sensor.rays("centre")`, all from the origin."""
    elevation = np.deg2rad(np.asarray(sensor.elevations, dtype=np.float64))
    zero = np.zeros_like(elevation)
    return Lasers(elevation, zero, zero, zero.astype(int), zero, zero, zero, straight=True)


def rows_of(sensor: Sensor, slope: np.ndarray) -> np.ndarray:
    """Row that each return falls into by its apparent slope tan e; -1 outside the field of view."""
    edges = np.tan(np.deg2rad(sensor.row_edges))[::-1].astype(np.float32)  # rising, as searchsorted wants
    h = len(sensor.elevations)
    row = h - np.searchsorted(edges, slope, side="right")
    return np.where((row >= 0) & (row < h), row, -1)
