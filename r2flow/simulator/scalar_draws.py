"""Random numbers one at a time, from a generator that is fast only in bulk."""

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")

_BULK = 4096  # a scene takes about 12,000


class ScalarDraws:
    """Random numbers, each computed from uniform ones that are drawn in bulk."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._pool: list[float] = []

    def unit(self) -> float:
        """Uniform on [0, 1)."""
        if not self._pool:
            self._pool = self._rng.random(_BULK).tolist()
        return self._pool.pop()

    def uniform(self, low: float, high: float) -> float:
        """Uniform on [low, high)."""
        return low + (high - low) * self.unit()

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return self.unit() < probability

    def normal(self, mean: float, deviation: float) -> float:
        """Gaussian, by the method of Box and Muller."""
        radius = math.sqrt(-2 * math.log(1 - self.unit()))
        return mean + deviation * radius * math.cos(2 * math.pi * self.unit())

    def exponential(self, mean: float) -> float:
        """Exponential, by inversion."""
        return -mean * math.log(1 - self.unit())

    def poisson(self, mean: float) -> int:
        """Poisson: the number of exponential waiting times that fit into `mean`."""
        count, waited = 0, self.exponential(1.0)
        while waited < mean:
            count, waited = count + 1, waited + self.exponential(1.0)
        return count

    def whole(self, low: int, high: int) -> int:
        """A whole number, low <= n <= high."""
        return low + int((high - low + 1) * self.unit())

    def side(self) -> int:
        """+1, left, or -1, right."""
        return 1 if self.unit() < 0.5 else -1

    def pick(self, options: Sequence[T], shares: Sequence[float]) -> T:
        """One of the options, with probabilities proportional to `shares`."""
        left = self.unit() * sum(shares)
        for option, share in zip(options, shares, strict=True):
            left -= share
            if left < 0:
                return option
        return options[-1]
