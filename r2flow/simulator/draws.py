"""Bit-reproducible functions, composed of sums, products, roots and tables, and random draws.

IEEE arithmetic is identical on all machines. Sine, exponential and others are not: NumPy chooses an implementation for
the processor, and results differ in the last bit. A single bit can move a ray past an edge and change a scan.
"""

import math
from collections.abc import Sequence
from functools import cache
from statistics import NormalDist
from typing import TypeVar

import numpy as np

_ENTRIES = 8192  # of a table of quantiles; the outermost Gaussian quantiles are at 3.8 standard deviations
_TAYLOR = tuple((-1) ** k * (2 * math.pi) ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(7))


def sine(x: np.ndarray) -> np.ndarray:
    """sin x to 1e-9 (float64) or to rounding (float32), by the Taylor series on a quarter turn."""
    t = x * (1 / (2 * math.pi))
    t = t - np.rint(t)
    t = np.maximum(np.minimum(t, 0.5 - t), -0.5 - t)  # sin(pi - a) = sin a
    square = t * t
    total = np.full_like(t, _TAYLOR[-1])
    for term in _TAYLOR[-2::-1]:
        total *= square
        total += term
    return total * t


def cosine(x: np.ndarray) -> np.ndarray:
    return sine(x + math.pi / 2)


def hypotenuse(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sqrt(x * x + y * y)


@cache
def _normal_quantiles() -> np.ndarray:
    return np.array([*map(NormalDist().inv_cdf, ((np.arange(_ENTRIES) + 0.5) / _ENTRIES).tolist())], np.float32)


@cache
def exponential_quantiles() -> np.ndarray:
    """Quantiles of Exp(1) at the midpoints of 8192 equal shares, (8192,), float32."""
    return np.array([-math.log1p(-(k + 0.5) / _ENTRIES) for k in range(_ENTRIES)], np.float32)


def normals(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Standard normal draws, float32: random entries of a table of 8192 quantiles."""
    return _normal_quantiles()[rng.integers(0, _ENTRIES, shape, dtype=np.uint16)]


def exponentials(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draws from Exp(1), float32: random entries of a table of 8192 quantiles."""
    return exponential_quantiles()[rng.integers(0, _ENTRIES, shape, dtype=np.uint16)]


def logistic(x: np.ndarray) -> np.ndarray:
    """Smooth step from 0 to 1, with the slope of 1 / (1 + e^-x) at 0: t^2 (3 - 2 t), t = clip(1/2 + x / 6, 0, 1)."""
    t = np.clip(x * (1 / 6) + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


T = TypeVar("T")

_BULK = 4096  # a scene takes about 12,000


class ScalarDraws:
    """Scalar random numbers, computed from uniform numbers that are drawn in bulk."""

    def __init__(self, rng: np.random.Generator) -> None:
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
        return mean + deviation * radius * math.cos(2 * math.pi * self.unit())

    def exponential(self, mean: float) -> float:
        """Exponential, by inversion."""
        return -mean * math.log(1 - self.unit())

    def poisson(self, mean: float) -> int:
        """Poisson: the number of exponential waiting times within `mean`."""
        count, waited = 0, self.exponential(1.0)
        while waited < mean:
            count, waited = count + 1, waited + self.exponential(1.0)
        return count

    def whole(self, low: int, high: int) -> int:
        """Uniform integer, low <= n <= high."""
        return low + int((high - low + 1) * self.unit())

    def side(self) -> int:
        """+1 (left) or -1 (right)."""
        return 1 if self.unit() < 0.5 else -1

    def pick(self, options: Sequence[T], shares: Sequence[float]) -> T:
        """Choose an option with probability proportional to `shares`."""
        left = self.unit() * sum(shares)
        for option, share in zip(options, shares, strict=True):
            left -= share
            if left < 0:
                return option
        return options[-1]
