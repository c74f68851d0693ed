"""Bit-reproducible functions, composed of sums, products, roots and tables, and random draws.

IEEE arithmetic is identical on all machines. Sine, exponential and others are not: NumPy chooses an
implementation for the processor, and results differ in the last bit. A single bit can move a ray
past an edge and change a scan.
"""

import math
from collections.abc import Sequence
from functools import cache
from statistics import NormalDist
from typing import Any, TypeVar

import numpy as np
from numpy import ndarray
from numpy.random import Generator

# of a table of quantiles; the outermost Gaussian quantiles are at 3.8 standard deviations
_ENTRIES = 8192
_SHARES = ((np.arange(_ENTRIES) + 0.5) / _ENTRIES).tolist()
# Coefficients of sin(2 pi t) / t in powers of t^2, the highest first.
_TAYLOR = np.array(
    [(-1) ** k * math.tau ** (2 * k + 1) / math.factorial(2 * k + 1) for k in reversed(range(7))]
)


def sine(x: ndarray) -> ndarray:
    """sin x to 1e-9 (float64) or to rounding (float32), by the Taylor series on a quarter turn."""
    t = x * (1 / math.tau)
    t = t - np.rint(t)
    t = np.maximum(np.minimum(t, 0.5 - t), -0.5 - t)  # sin(pi - a) = sin a
    return np.polyval(_TAYLOR.astype(t.dtype), t * t) * t


def cosine(x: ndarray) -> ndarray:
    return sine(x + math.pi / 2)


def hypotenuse(x: ndarray, y: ndarray) -> ndarray:
    return np.sqrt(x * x + y * y)


def rotate(x: Any, y: Any, cos: Any, sin: Any) -> tuple[Any, Any]:
    """Coordinates of points, numbers or arrays, along (cos, sin) and to its left."""
    return x * cos + y * sin, y * cos - x * sin


def scramble(a: ndarray, b: ndarray, c: ndarray, seed: int = 0) -> ndarray:
    """A hash of whole numbers, in [0, 2^32), int64."""
    a = a.astype(np.int64) * 73856093
    b = b.astype(np.int64) * 83492791
    c = c.astype(np.int64) * 19349663
    return ((a ^ b ^ c) + seed) * 2654435761 & 0xFFFFFFFF


@cache
def _normal_quantiles() -> ndarray:
    return np.array([NormalDist().inv_cdf(share) for share in _SHARES], np.float32)


@cache
def exponential_quantiles() -> ndarray:
    """Quantiles of Exp(1) at the midpoints of 8192 equal shares, (8192,), float32."""
    return np.array([-math.log1p(-share) for share in _SHARES], np.float32)


def _entries(table: ndarray, rng: Generator, shape: tuple[int, ...]) -> ndarray:
    return table[rng.integers(0, _ENTRIES, shape, dtype=np.uint16)]


def normals(rng: Generator, shape: tuple[int, ...]) -> ndarray:
    """Standard normal draws, float32: random entries of a table of 8192 quantiles."""
    return _entries(_normal_quantiles(), rng, shape)


def exponentials(rng: Generator, shape: tuple[int, ...]) -> ndarray:
    """Draws from Exp(1), float32: random entries of a table of 8192 quantiles."""
    return _entries(exponential_quantiles(), rng, shape)


def logistic(x: ndarray) -> ndarray:
    """Smooth step from 0 to 1, with the slope of 1 / (1 + e^-x) at 0.

    It is t^2 (3 - 2 t), t = clip(1/2 + x / 6, 0, 1).
    """
    t = np.clip(x * (1 / 6) + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


_T = TypeVar("_T")

_BULK = 4096  # a scene takes about 12,000


class ScalarDraws:
    """Scalar random numbers, computed from uniform numbers that are drawn in bulk."""

    def __init__(self, rng: Generator) -> None:
        self._rng = rng
        self._pool: list[float] = []

    def unit(self) -> float:
        """Uniform on [0, 1)."""
        if not self._pool:
            self._pool = self._rng.random(_BULK).tolist()
        return self._pool.pop()

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * self.unit()

    def chance(self, probability: float) -> bool:
        return self.unit() < probability

    def normal(self, mean: float, deviation: float) -> float:
        """Gaussian, by the Box-Muller transform."""
        radius = math.sqrt(-2 * math.log(1 - self.unit()))
        return mean + deviation * radius * math.cos(math.tau * self.unit())

    def exponential(self, mean: float) -> float:
        """Exponential, by inversion."""
        return -mean * math.log(1 - self.unit())

    def poisson(self, mean: float) -> int:
        """Poisson: the number of exponential waiting times within `mean`."""
        count = 0
        waited = self.exponential(1.0)
        while waited < mean:
            count += 1
            waited += self.exponential(1.0)
        return count

    def whole(self, low: int, high: int) -> int:
        """Uniform integer, low <= n <= high."""
        return low + int((high - low + 1) * self.unit())

    def side(self) -> int:
        """+1 (left) or -1 (right)."""
        return 1 if self.chance(0.5) else -1

    def pick(self, options: Sequence[_T], shares: Sequence[float]) -> _T:
        """Choose an option with probability proportional to `shares`."""
        left = self.unit() * sum(shares)
        for option, share in zip(options, shares, strict=True):
            left -= share
            if left < 0:
                return option
        return options[-1]
