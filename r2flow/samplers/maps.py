"""Samplers of a flow map X_{t->s}(x) = x + (s - t) u(x, t, s): one evaluation per step."""

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
    """Apply X_{t->s} from each time of the grid to the next."""

    needs: ClassVar[str] = "map"

    steps: Steps = 4

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        """x_s; e is fresh noise if the sampler is stochastic."""
        return jump(u, t, x, s)

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        u, x, alive, times = generator.map(condition), noise, finite(noise), self.times().to(noise)
        for j, (t, s) in enumerate(pairwise(times), start=1):
            e = x.new_zeros(())
            if self.draws and s < 1:
                assert draws is not None
                e = draws(j)
            x, alive = stepped(x, self.step(u, t, x, s, e), alive)
            progress()
        return Generated.after(x, self.steps, alive)


@dataclass(frozen=True)
class Chord(Jump):
    """x_s = x_t + (s - t) u(x_t, t, 1), a point on the straight line to X_{t->1}(x_t).

    This is DDIM's step (Song et al. 2021) with X_{t->1}(x_t) as the estimate of the scan: the next jump starts with
    less of the same noise and corrects the estimate. It is exact if paths are straight. Otherwise x_s does not have
    the flow's density at s, even for the exact map, and each jump adds grain to the reflectance.
    """

    steps: Steps = 2
    grid: Grid | None = None  # type: ignore[assignment]  # None: `late`

    def times(self, *args: Any, **options: Any) -> Tensor:
        return late(self.steps) if self.grid is None else super().times(*args, **options)

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        return x + (s - t) * u(t, x, torch.ones_like(t))


@dataclass(frozen=True)
class Renoise(Jump):
    """x_s = (1 - s) e + s X_{t->1}(x_t) with fresh noise e (Song et al. 2023, consistency models, algorithm 1).

    If the map is exact, x_1 has the right distribution, but is not the end of the path of x_0.
    """

    draws: ClassVar[bool] = True

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        return s * jump(u, t, x, torch.ones_like(t)) + (1 - s) * e


@dataclass(frozen=True)
class Transport(Sampler):
    """One evaluation: map the noise of each ray to the predicted density (`TransferFlow.transported`)."""

    needs: ClassVar[str] = "transported"

    def evaluations(self, generator: Any = None) -> int:
        return 1

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        x = generator.transported(noise, condition)
        progress()
        return Generated.after(x, 1)


def late(steps: int) -> Tensor:
    """Time grid of one long step and short steps near t = 1: 1 - t_j is log-spaced between 1 / 16 and 1 / 64.

    1 - t_j = 2^(1 - (2 j - 1) / (N - 1)) / 32 for j = 1 to N - 1 of N steps.
    """
    share = (2 * torch.arange(1, steps, dtype=torch.float64) - 1) / max(steps - 1, 1)
    return torch.cat([torch.zeros(1), 1 - 2 ** (1 - share) / 32, torch.ones(1)])
