"""Samplers of a flow map X_{t->s}(x) = x + (s - t) u(x, t, s): one evaluation a step."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.flow.maps import MeanVelocity, jump
from r2flow.flow.solvers.solution import finite, stepped
from r2flow.samplers.base import Call, Fresh, Generated, Given, Grid, OnGrid, Sampler, Steps


@dataclass(frozen=True)
class Jump(OnGrid):
    """X_{t->s} from each time of the grid to the next."""

    needs: ClassVar[str] = "map"

    steps: Steps = 4

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        """x_s, with fresh noise e where the sampler draws."""
        return jump(u, t, x, s)

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        u, x, alive, times = generator.map(condition), noise, finite(noise), self.times().to(noise)
        for j, (t, s) in enumerate(pairwise(times), start=1):
            e = draws(j) if self.draws and draws is not None and s < 1 else torch.zeros_like(x)
            x, alive = stepped(x, self.step(u, t, x, s, e), alive)
            progress()
        return Generated.after(x, self.steps, alive)


@dataclass(frozen=True)
class Chord(Jump):
    """x_s = x_t + (s - t) u(x_t, t, 1), on the straight line to the end of a jump.

    The next jump sees that end under less of the same noise and corrects it. This is DDIM's step (Song et al. 2021)
    with X_{t->1}(x_t) for the estimate of the scan; exact where paths are straight. Elsewhere x_s does not have the
    density of the flow at s even for the exact map, and each jump adds grain to the reflectance.

    Attributes:
        grid: None for `late`.
    """

    steps: Steps = 2
    grid: Grid | None = None  # type: ignore[assignment]

    def times(self, *args: Any, **options: Any) -> Tensor:
        return late(self.steps) if self.grid is None else super().times(*args, **options)

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        return x + (s - t) * u(t, x, torch.ones_like(t))


@dataclass(frozen=True)
class Renoise(Jump):
    """x_s = (1 - s) e + s X_{t->1}(x_t) with fresh noise e (Song et al. 2023, consistency models, algorithm 1).

    A sample of the same distribution where the map is exact, and not the end of this noise's own path.
    """

    draws: ClassVar[bool] = True

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        return s * jump(u, t, x, torch.ones_like(t)) + (1 - s) * e


@dataclass(frozen=True)
class Transport(Sampler):
    """One evaluation, by which a generator carries the noise of each ray to the density of its answer."""

    needs: ClassVar[str] = "transported"

    def evaluations(self, generator: Any = None) -> int:
        return 1

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        x = generator.transported(noise, condition)
        progress()
        return Generated.after(x, 1)


def late(steps: int, k: float = 32.0) -> Tensor:
    """One long step, the rest near t = 1: 1 - t falls evenly on a log scale about 1 / k, from at most 2 / k.

    1 - t_j = 2^(1 - (2 j - 1) / (N - 1)) / k for j = 1 to N - 1 of N steps.
    """
    share = (2 * torch.arange(1, steps, dtype=torch.float64) - 1) / max(steps - 1, 1)
    return torch.cat([torch.zeros(1), 1 - 2 ** (1 - share) / k, torch.ones(1)])
