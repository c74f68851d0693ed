"""Straightness of a flow's paths: the paper's s(t) (eq. 6), its integral, the most curved pixels.

    s(t) = |d - v_t|^2,  d = Phi(x_0, 1) - x_0,  v_t = v(t, Phi(x_0, t)),

which is 0 on a straight path, where one Euler step is exact. d is known only at the end, so that
the velocities of a path are kept until then: as many images as steps.

An untrained flow with v = 0 is perfectly straight: report s together with s / |d|^2.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.flow.solvers import Velocity, solve


class Straightness(NamedTuple):
    """s(t) per scan, and the paths of the most curved elements of all scans."""

    t: Tensor  # the times 0, 1/n, ..., (n - 1)/n, (n,), float64
    s: Tensor  # s(t), (N, n), float64; the mean over t is the integral
    squared_length: Tensor  # |d|^2, (N,), float64
    # The integral of (d - v_t)^2 over t of the most curved elements, decreasing; -inf: not finite.
    bends: Tensor
    trajectories: Tensor  # values of these elements at 0, 1/n, ..., 1, (k, n + 1)

    @property
    def s_normalised(self) -> Tensor:
        """s(t) / |d|^2, (N, n); NaN for d = 0."""
        return self.s / self.squared_length[:, None]


@torch.no_grad()
def straightness(
    velocity: Velocity,
    x_0: Tensor,
    steps: int = 256,
    most_curved: int = 0,
    progress: Callable[[], None] | None = None,
) -> Straightness:
    """s(t) per scan in `steps` Euler steps from noise, (N, ...), and the `most_curved` elements.

    The integral is a left sum, too small where v changes near t = 1: two thirds of it for data of
    deviation 0.01.
    """
    velocities: list[Tensor] = []

    def recorded(t: Tensor, x: Tensor) -> Tensor:
        velocities.append(velocity(t, x).to(x.dtype, copy=True))
        return velocities[-1]

    d = solve(recorded, x_0, steps=steps, progress=progress).x - x_0
    bends = torch.zeros_like(d, dtype=torch.float64)
    s = []
    for v in velocities:
        squares = (d - v).double().square()
        bends += squares / steps
        s.append(squares.flatten(1).sum(1))
    bends = bends.flatten().nan_to_num(-math.inf, -math.inf)
    most, pixels = bends.topk(min(most_curved, len(bends)))
    moves = [x_0.flatten()[pixels], *(v.flatten()[pixels] / steps for v in velocities)]
    return Straightness(
        torch.arange(steps).double() / steps,
        torch.stack(s, 1),
        d.double().square().flatten(1).sum(1),
        most,
        torch.stack(moves, 1).double().cumsum(1),
    )
