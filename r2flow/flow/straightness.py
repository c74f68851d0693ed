"""Straightness of a flow's paths: the paper's s(t) (eq. 6), its integral, and the most curved pixels.

    s(t) = |d - v_t|^2,  d = Phi(x_0, 1) - x_0,  v_t = v(t, Phi(x_0, t)),

which is 0 on a straight path, where one Euler step is exact. Along n equal Euler steps d is the mean of v_t; the
integral of s is thus the variance of v_t over the path and needs one pass. s(t) itself needs d, which is known only at
the end: `straightness` makes a second pass instead of storing n images.

An untrained flow with v = 0 is perfectly straight: report s together with s / |d|^2.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.flow.solvers import Velocity, solve

Progress = Callable[[], None] | None


class Curvature(NamedTuple):
    """The integral of s over the paths of a batch."""

    x_0: Tensor  # start of each path, (B, ...)
    x_1: Tensor  # end
    per_pixel: Tensor  # int_0^1 (d - v_t)^2 dt per element, (B, ...), float64

    @property
    def total(self) -> Tensor:
        """int_0^1 s(t) dt, (B,)."""
        return self.per_pixel.flatten(1).sum(1)

    @property
    def squared_length(self) -> Tensor:
        """|d|^2, (B,)."""
        return _squared_norm(self.x_1 - self.x_0)

    @property
    def normalised(self) -> Tensor:
        """int_0^1 s(t) dt / |d|^2, (B,); NaN for d = 0."""
        return self.total / self.squared_length


class Straightness(NamedTuple):
    """s(t) per scene, and the paths of the most curved elements."""

    t: Tensor  # the times 0, 1/n, ..., (n - 1)/n, (n,), float64
    s: Tensor  # s(t), (B, n), float64
    curvature: Curvature  # the integral of s
    pixels: Tensor  # indices into the flattened batch by decreasing curvature, (k,); those of non-finite paths last
    trajectories: Tensor  # values of these elements at 0, 1/n, ..., 1, (k, n + 1)


@torch.no_grad()
def curvature(velocity: Velocity, x_0: Tensor, steps: int = 256, progress: Progress = None) -> Curvature:
    """Integral of s over the path, per pixel, in one pass of Euler steps from x_0, (B, ...).

    A left sum, too small where v changes near t = 1: two thirds of the integral for data of deviation 0.01.
    """
    first: Tensor | None = None
    mean, mean_square = torch.zeros(2, *x_0.shape, dtype=torch.float64, device=x_0.device)

    def recorded(t: Tensor, x: Tensor) -> Tensor:
        nonlocal first
        v = velocity(t, x).to(x.dtype)
        # Deviations from the first velocity avoid the cancellation of a variance computed from v^2.
        first = v.clone() if first is None else first
        deviation = (v - first).double()
        mean.add_(deviation / steps)
        mean_square.add_(deviation.square() / steps)
        return v

    x_1 = solve(recorded, x_0, steps=steps, progress=progress).x
    return Curvature(x_0, x_1, (mean_square - mean.square()).clamp(min=0))


@torch.no_grad()
def straightness(
    velocity: Velocity, x_0: Tensor, steps: int = 256, most_curved: int = 0, progress: Progress = None
) -> Straightness:
    """s(t) per scan at the times of `steps` Euler steps from noise, (B, ...), in two passes: 2 x steps evaluations.

    The paths of the `most_curved` elements, over all scans, are kept.
    """
    total = curvature(velocity, x_0, steps, progress)
    d = total.x_1 - total.x_0
    values = total.per_pixel.flatten().nan_to_num(-math.inf, -math.inf)
    pixels = values.topk(min(most_curved, len(values))).indices
    s, trajectories = [], []

    def recorded(t: Tensor, x: Tensor) -> Tensor:
        v = velocity(t, x).to(x.dtype)
        s.append(_squared_norm(d - v))
        trajectories.append(x.flatten()[pixels])
        return v

    x_1 = solve(recorded, x_0, steps=steps, progress=progress).x
    t = torch.arange(steps, dtype=torch.float64) / steps
    paths = torch.stack([*trajectories, x_1.flatten()[pixels]], 1)
    return Straightness(t, torch.stack(s, 1), total, pixels, paths)


def _squared_norm(x: Tensor) -> Tensor:
    return x.double().square().flatten(1).sum(1)
