"""A scan's rays as a product of lasers and azimuths, and the windows of rays that an object can cover.

Every ray is p(s) = (s cos a, s sin a, z + s T): s the horizontal distance, a the azimuth of the column, T = tan E the
slope of the laser and z its height. This makes ray casting cheap: an upright surface is met at an s that depends on the
column alone.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from r2flow.simulator.lasers import Lasers


@dataclass(frozen=True)
class Rays:
    """B lasers by W azimuths.

    Attributes:
        lasers: The lasers, (B,).
        columns: Number W of azimuths; column w looks along a = pi - 2 pi (w + 1/2) / W.
        ground: Height of the sensor's origin above the scene's z = 0, in metres.
    """

    lasers: Lasers
    columns: int
    ground: float = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """(B, W)."""
        return len(self.lasers.elevation), self.columns

    @cached_property
    def azimuth(self) -> np.ndarray:
        """Azimuth a in radians, (W,), float64."""
        return np.pi - 2 * np.pi * (np.arange(self.columns) + 0.5) / self.columns

    @cached_property
    def cos(self) -> np.ndarray:
        """cos a, (W,), float32."""
        return np.cos(self.azimuth).astype(np.float32)

    @cached_property
    def sin(self) -> np.ndarray:
        """sin a, (W,), float32."""
        return np.sin(self.azimuth).astype(np.float32)

    @cached_property
    def slope(self) -> np.ndarray:
        """T = tan E, falling, (B,), float32."""
        return np.tan(self.lasers.elevation).astype(np.float32)

    @cached_property
    def height(self) -> np.ndarray:
        """Height z of each laser above the scene's z = 0 in metres, (B,), float32."""
        return (self.lasers.height + self.ground).astype(np.float32)


def expand(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers first_k <= j < first_k + count_k: (k, j), each (sum of counts,), int32."""
    count = np.maximum(count, 0)
    k = np.repeat(np.arange(len(count), dtype=np.int32), count)
    start = np.cumsum(count) - count
    j = np.arange(len(k), dtype=np.int32) - (start - first)[k].astype(np.int32)
    return k, j


def column_windows(azimuth: np.ndarray, half: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (object k, column w) whose azimuth lies within half_k of azimuth_k, (N,) each, int32."""
    to_column = columns / (2 * np.pi)
    half = np.minimum(half, np.pi * (1 - 1e-9))
    first = np.ceil((np.pi - azimuth - half) * to_column - 0.5).astype(np.int64)
    last = np.floor((np.pi - azimuth + half) * to_column - 0.5).astype(np.int64)
    k, w = expand(first, np.minimum(last - first + 1, columns))
    return k, w % columns


def row_windows(
    rays: Rays, near: np.ndarray, far: np.ndarray, bottom: np.ndarray, top: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, laser b) that may meet [bottom, top] between the distances near and far, (F,) each, int32."""
    low, high = rays.height.min(), rays.height.max()
    falling, rising = bottom - high, top - low
    least = falling / np.where(falling < 0, near, far)
    most = rising / np.where(rising > 0, near, far)
    descending = -rays.slope
    first = np.searchsorted(descending, -most, side="left")
    last = np.searchsorted(descending, -least, side="right")
    return expand(first, last - first)
