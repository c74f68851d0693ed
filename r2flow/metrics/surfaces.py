"""Surfaces in range images: normals, angle of incidence, gaps."""

import numpy as np
from numpy import ndarray

from r2flow.lidar.interpolation import nearest_known
from r2flow.lidar.sensors import Sensor

_SPAN = 2  # columns to either side for a surface's direction; range noise dominates for 1
_STEP = 0.15  # relative to range; larger differences separate objects
_GAP = 16  # columns; longer gaps are sky or occluded, not dropped rays


def normals(r: ndarray, sensor: Sensor) -> tuple[ndarray, ndarray]:
    """Unit normals n ~ (p(h - 1, w) - p(h + 1, w)) x (p(h, w - 2) - p(h, w + 2)), p = r d.

    They point towards the sensor. n_z, the upward part, and |n . d| = cos i, i the angle of
    incidence, (H, W) float32 each as the ranges r in metres; NaN where one of the five pixels is
    missing or its range differs by more than 15 % from the centre.
    """
    e, a = sensor.rays().numpy()
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    above, below, left, right = _neighbours(r * d)
    n = np.cross(above - below, left - right, axis=0)
    size = np.sqrt((n**2).sum(0))
    usable = (r > 0) & (size > 0)
    for other in _neighbours(r):
        usable &= (other > 0) & (np.abs(other - r) < _STEP * r)
    n = n / np.where(usable, size, np.nan)
    return n[2], np.abs((n * d).sum(0))


def _neighbours(x: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Values of each pixel's neighbours above, below, left and right; 0 outside of the rows."""
    padded = np.pad(x, [(0, 0)] * (x.ndim - 2) + [(1, 1), (0, 0)])
    above = padded[..., :-2, :]
    below = padded[..., 2:, :]
    return above, below, np.roll(x, _SPAN, -1), np.roll(x, -_SPAN, -1)  # azimuth falls with w


def bridged(x: ndarray, known: ndarray, gap: int = _GAP) -> ndarray:
    """Fill unknown values of x, (..., W), by the mean of the nearest known ones in their row.

    Those are one to the left and one to the right, periodic in W. Gaps of more than `gap` columns
    are NaN.
    """
    width = x.shape[-1]
    margin = min(gap, width - 1) + 1
    turn = np.arange(-margin, width + margin) % width
    left, right = nearest_known(known[..., turn])
    before = left[..., margin:-margin]
    after = right[..., margin:-margin]
    low = np.take_along_axis(x, (before - margin) % width, -1)
    high = np.take_along_axis(x, (after - margin) % width, -1)
    mean = np.where(after - before <= margin, (low + high) / 2, np.nan)
    return np.where(known, x, mean)
