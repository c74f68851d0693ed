"""Euler's rule with a shrunken velocity, from a file of a user's."""

from dataclasses import dataclass
from itertools import pairwise

from r2flow.samplers import SAMPLERS, Generated, OnGrid


@dataclass(frozen=True)
class Shrunken(OnGrid):
    share: float = 0.5

    def __call__(self, generator, noise, condition=None, draws=None, progress=None):
        v, x = generator.field(condition), noise
        for t, s in pairwise(self.times().to(noise)):
            x = x + self.share * (s - t) * v(t, x)
            if progress:
                progress()
        return Generated.after(x, self.steps)


SAMPLERS.add("shrunken", Shrunken)
