"""Surfaces in range images: normals, angle of incidence, gaps."""

import numpy as np

from r2flow.lidar.interpolation import nearest_known
from r2flow.lidar.sensors import Sensor

SPAN = 2  # columns to either side for a surface's direction; range noise dominates for 1
STEP = 0.15  # relative to range; larger differences separate objects
GAP = 16  # columns; longer gaps are sky or occluded, not dropped rays


def normals(r: np.ndarray, sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals n ~ (p(h - 1, w) - p(h + 1, w)) x (p(h, w - 2) - p(h, w + 2)), p = r d, towards the sensor.

    n_z, the upward part, and |n . d| = cos i, i the angle of incidence, (H, W) float32 each as the ranges r in metres;
    NaN where one of the five pixels is missing or its range differs by more than 15 % from the centre.
    """
    e, a = sensor.rays().numpy()
    d = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    p = r * d
    left, right = np.roll(p, SPAN, axis=-1), np.roll(p, -SPAN, axis=-1)  # azimuth falls with w
    above, below = _above_and_below(p)
    n = np.cross(above - below, left - right, axis=0)
    size = np.sqrt((n**2).sum(0))
    usable = (r > 0) & (size > 0)
    for other in (*_above_and_below(r), np.roll(r, SPAN, -1), np.roll(r, -SPAN, -1)):
        usable &= (other > 0) & (np.abs(other - r) < STEP * r)
    n = n / np.where(usable, size, np.nan)
    return n[2], np.abs((n * d).sum(0))


def _above_and_below(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours of each pixel in the rows above and below; 0 outside the image."""
    wider = np.pad(x, [(0, 0)] * (x.ndim - 2) + [(1, 1), (0, 0)])
    return wider[..., :-2, :], wider[..., 2:, :]


def bridged(x: np.ndarray, known: np.ndarray, gap: int = GAP) -> np.ndarray:
    """Fill unknown values of x, (..., W), by the mean of the nearest known values to the left and right, periodic in W.

    Gaps of more than `gap` columns are NaN.
    """
    width = x.shape[-1]
    gap = min(gap, width - 1)
    turn = np.arange(-gap - 1, width + gap + 1) % width  # periodic padding
    before, after = (end[..., gap + 1 : gap + 1 + width] for end in nearest_known(known[..., turn]))
    low, high = (np.take_along_axis(x, (end - gap - 1) % width, -1) for end in (before, after))
    mean = np.where(after - before - 1 <= gap, (low + high) / 2, np.nan)
    return np.where(known, x, mean)
