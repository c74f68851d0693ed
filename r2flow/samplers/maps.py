"""Samplers of a flow map X_{t->s}(x) = x + (s - t) u(x, t, s): one evaluation per step."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

import torch
from torch import Tensor

from r2flow.base.registry import Bound, Count, NonNegative
from r2flow.flow.maps import MeanVelocity, jump
from r2flow.flow.solvers import solve
from r2flow.flow.solvers.fixed import build_grid
from r2flow.flow.solvers.solution import finite, stepped
from r2flow.samplers.base import Generated, Grid, Known, Noise, OnGrid, Sampler, Steps, Tick


@dataclass(frozen=True)
class Jump(OnGrid):
    """Apply X_{t->s} from each time of the grid to the next."""

    needs = "map"

    steps: Steps = 4

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        """x_s; e is fresh noise if the sampler is stochastic."""
        return jump(u, t, x, s)

    def start(
        self, generator: Any, noise: Tensor, condition: Known, progress: Tick
    ) -> tuple[int, Tensor, Tensor]:
        """Number of steps before the first jump, the state after them, and whether it is finite."""
        return 0, noise, finite(noise)

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        first, x, alive = self.start(generator, noise, condition, progress)
        u = generator.map(condition)
        times = self.times().to(noise)[first:]
        for j, (t, s) in enumerate(pairwise(times), start=1):
            last = j == len(times) - 1
            e = draws(j) if self.draws and not last else x.new_zeros(())
            x, alive = stepped(x, self.step(u, t, x, s, e), alive)
            progress()
        return Generated.after(x, self.steps, alive)


@dataclass(frozen=True)
class Renoise(Jump):
    """x_s = (1 - s) e + s X_{t->1}(x_t), e ~ N(0, 1) (Song et al. 2023, algorithm 1).

    For the exact map of a 1-RF (not of a 2-RF), x_1 has the right distribution, but is not the end
    of the path of x_0. Without a grid, 1 - t_j is log-spaced from 1 / 2 to 1 / 64 (`_late`): fresh
    noise lets early jumps be corrected.
    """

    draws = True

    steps: Steps = 8
    grid: Grid | None = None  # type: ignore[assignment]  # None: `_late`

    def times(self) -> Tensor:
        return _late(self.steps, 1 / 2) if self.grid is None else super().times()

    def step(self, u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor, e: Tensor) -> Tensor:
        return s * jump(u, t, x, torch.ones_like(t)) + (1 - s) * e


@dataclass(frozen=True)
class Refine(Renoise):
    """Solve the ODE by `adams3` to t = `until`, then renoise in `jumps` steps, at most half.

    The ODE places objects that early jumps lose; jumps draw surfaces that the velocity blurs near t
    = 1. It is `renoise` where this leaves fewer than four steps to the ODE. A grid gives all times,
    instead of `until`.
    """

    steps: Steps = 12
    jumps: Count = 5
    until: Annotated[float, Bound("above 0 and at most 0.98", lambda t: 0 < t <= 0.98)] = 0.9

    @property
    def leading(self) -> int:
        first = self.steps - min(self.jumps, self.steps // 2)
        return first if first >= 4 else 0

    def times(self) -> Tensor:
        if self.grid is not None or not self.leading:
            return super().times()
        leading = build_grid("power:1.5", 0.0, self.until, self.leading)
        return torch.cat([leading, _late(self.steps - self.leading, 1 - self.until)[1:]])

    def start(
        self, generator: Any, noise: Tensor, condition: Known, progress: Tick
    ) -> tuple[int, Tensor, Tensor]:
        if not self.leading:
            return super().start(generator, noise, condition, progress)
        times = self.times()[: self.leading + 1]
        end = solve(
            generator.field(condition),
            noise,
            t_1=float(times[-1]),
            method="adams3",
            grid=times,
            progress=progress,
        )
        return self.leading, end.x, end.converged.to(end.x.device)


@dataclass(frozen=True)
class Transport(Sampler):
    """One evaluation: map the noise of each ray to its density (`TransferFlow.transported`)."""

    needs = "transported"

    # Factor of a ray's deviation from its drawn candidate: less is sharper, but too sure.
    residual: NonNegative = 1.0

    def evaluations(self, generator: Any = None) -> int:
        return 1

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        x = generator.transported(noise, condition, self.residual)
        progress()
        return Generated.after(x, 1)


def _late(steps: int, widest: float) -> Tensor:
    """Time grid, (N + 1,) float64 on the CPU, 1 - t_j log-spaced from `widest` to 1 / 64 at middles
    of N - 1 parts:

    1 - t_j = widest (1 / (64 widest))^((j - 1/2) / (N - 1)) for j = 1 to N - 1 of N steps.
    """
    share = (torch.arange(1, steps, dtype=torch.float64, device="cpu") - 0.5) / max(steps - 1, 1)
    return torch.cat([share.new_zeros(1), 1 - widest * (64 * widest) ** -share, share.new_ones(1)])
