"""Flow maps: X_{t->s} maps the flow's state at t to that at s, by the mean velocity u between.

    X_{t->s}(x) = x + (s - t) u(x, t, s),    u(x, t, t) = v(t, x)

An objective returns a point x_t and the regression target of u there, without forward-mode
derivatives.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from r2flow.base.errors import InputError
from r2flow.base.registry import Options, Portion, Registry
from r2flow.flow.path import expand_time, interpolate
from r2flow.flow.solvers.fixed import build_grid
from r2flow.flow.solvers.solution import selected
from r2flow.flow.times import TIMES

# u(t, x, s), in the argument order of backbones.
MeanVelocity = Callable[[Tensor, Tensor, Tensor], Tensor]


def jump(u: MeanVelocity, t: Tensor, x: Tensor, s: Tensor) -> Tensor:
    """X_{t->s}(x), (B, ...), for times of shape () or (B,)."""
    return x + expand_time(s - t, x) * u(t, x, s)


@dataclass
class JumpTimes:
    """Distribution of the jumps (t, s) in training: steps of grids, velocities, ends, others.

    Args:
        steps: Numbers of steps of the grids, drawn uniformly; repeat a number to draw it more
            often.
        grid: Time grid of the steps (`r2flow.flow.solvers.fixed.named_grid`).
        share: Share of jumps that are steps of these grids.
        diagonal: Share of the rest with s = t.
        ends: Share of the rest with s = 1 and t from the density `time`.
        time: Time density (`r2flow.flow.times.TIMES`) for s = t and s = 1; None: `u_shaped`, as in
            reflow.

    Attributes:
        velocities: The time density: maps uniform draws to times, (B,) each.
        times: The time grid of each number of steps, (len(steps), max(steps) + 1) float64, padded
            with NaN.
    """

    steps: Sequence[int] = (1, 1, 1, 2, 4, 8)
    grid: str = "uniform"
    share: Portion = 0.55
    diagonal: Portion = 0.55
    ends: Portion = 0.0
    time: Options | None = None

    def __post_init__(self) -> None:
        if self.diagonal + self.ends > 1:
            raise InputError(
                f"diagonal + ends must be at most 1; found {self.diagonal}, {self.ends}."
            )
        self.velocities = TIMES.build(self.time or {"name": "u_shaped"})
        grids = [build_grid(self.grid, 0.0, 1.0, count) for count in self.steps]
        self.times = pad_sequence(grids, batch_first=True, padding_value=math.nan)

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Draw t and s, (B,) each, from uniform numbers in [0, 1), (B, 3)."""
        which, a, b = u.unbind(1)
        times = self.times.to(u)
        counts = torch.tensor(self.steps, device=u.device)
        row = (a * len(counts)).long()
        step = (b * counts[row]).long()
        velocity = self.velocities(a)
        rest = (which - self.share) / (1 - self.share)
        diagonal = rest < self.diagonal
        to_end = rest >= 1 - self.ends
        low = torch.where(diagonal | to_end, velocity, torch.minimum(a, b))
        high = torch.where(diagonal, velocity, torch.maximum(a, b)).masked_fill(to_end, 1.0)
        on_grid = which < self.share
        low = torch.where(on_grid, times[row, step], low)
        return low, torch.where(on_grid, times[row, step + 1], high)


class Aim(NamedTuple):
    """The point at which u is trained and its target, (B, ...) each."""

    x_t: Tensor
    target: Tensor


# Of u, x_0, x_1, t, s, rho.
_Objective = Callable[[MeanVelocity, Tensor, Tensor, Tensor, Tensor, Tensor], Aim]


def straight(u: MeanVelocity, x_0: Tensor, x_1: Tensor, t: Tensor, s: Tensor, rho: Tensor) -> Aim:
    """Target u(x_t, t, s) = x_1 - x_0 on the line from x_0 to x_1, for every s, as in k-TD."""
    return Aim(*interpolate(x_0, x_1, t))


def consistency(
    u: MeanVelocity, x_0: Tensor, x_1: Tensor, t: Tensor, s: Tensor, rho: Tensor
) -> Aim:
    """Target u(x_t, t, s) = rho v + (1 - rho) u(x_l, l, s) from the map itself at a later time.

        l = t + rho (s - t),    x_l = x_t + rho (s - t) v

    x_t lies on the straight line from x_0 to x_1, v = x_1 - x_0; the target has no gradient (Luo et
    al. 2025, SoFlow; Zhang et al. 2025, alpha-Flow). rho = 1 is `straight`; rho -> 0 gives
    MeanFlow.
    """
    x_t, v = interpolate(x_0, x_1, t)
    target = v.clone()
    learned = (rho < 1).nonzero()[:, 0]  # the only device synchronisation
    if len(learned):
        t, s, rho, v, x = (part[learned] for part in (t, s, rho, v, x_t))
        ahead = rho * (s - t)
        share = expand_time(rho, v)
        with torch.no_grad():
            later = selected(u, learned)(t + ahead, x + expand_time(ahead, v) * v, s)
        target[learned] = share * v + (1 - share) * later
    return Aim(x_t, target)


OBJECTIVES: Registry[_Objective] = Registry(
    "objective of a flow map",
    straight=straight,
    consistency=consistency,
)
