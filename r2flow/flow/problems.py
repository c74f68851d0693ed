"""Test problems for solvers: flows with a known solution.

States have any shape (B, ...). `Gaussian`, `Anisotropic`, the mixtures and `PointMass` are
rectified flows: x_0 ~ N(0, 1), x_1 independent of x_0, v(t, x) = E[x_1 - x_0 | x_t = x]. `Straight`
is a reflowed Gaussian. The others do not model data; each has a different difficulty for solvers.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from r2flow.base.registry import Registry
from r2flow.flow.path import expand_time


class Problem(ABC):
    """A velocity and its exact paths; a subclass gets times that broadcast with the state."""

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        """v(t, x) in x's type, with t of shape () or (B,) and x (B, ...)."""
        return self.velocity(expand_time(t, x), x)

    def solution(self, x_0: Tensor, t: Tensor | float) -> Tensor:
        """x_t, (B, ...) float64, of the path that starts at x_0; t of shape () or (B,)."""
        x_0 = x_0.double()
        t = torch.as_tensor(t, dtype=torch.float64, device=x_0.device)
        return self.path(x_0, expand_time(t, x_0))

    @abstractmethod
    def velocity(self, t: Tensor, x: Tensor) -> Tensor: ...

    @abstractmethod
    def path(self, x_0: Tensor, t: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Gaussian(Problem):
    """x_1 ~ N(mean, std^2): x_t = t mean + sigma_t x_0 with sigma_t^2 = (1 - t)^2 + t^2 std^2.

    A smaller std gives later and sharper turns of the paths.
    """

    std: float = 0.25
    mean = 0.7

    def deviation(self, x: Tensor) -> Any:
        """std, broadcastable with x."""
        return self.std

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        s = self.deviation(x)
        rate = (t * s**2 - (1 - t)) / ((1 - t) ** 2 + (t * s) ** 2)  # sigma' / sigma
        return self.mean + rate * (x - t * self.mean)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return t * self.mean + ((1 - t) ** 2 + (t * self.deviation(x_0)) ** 2).sqrt() * x_0


class Anisotropic(Gaussian):
    """A Gaussian per element of mean 0, with std log-spaced from 1e-4 to 10."""

    mean = 0.0

    def deviation(self, x: Tensor) -> Tensor:
        return torch.logspace(-4, 1, x[0].numel(), dtype=x.dtype, device=x.device).view(x.shape[1:])


def _normal_cdf(x: Tensor) -> Tensor:
    """Phi(x), accurate in the lower tail, where `torch.special.ndtr` loses digits beyond 6."""
    return torch.special.erfc(-x / math.sqrt(2)) / 2


class GaussianMixture(Problem):
    """x_1 from a mixture of Gaussians, independently in every element.

    In component i, x_t has mean t m_i and variance c_i = (1 - t)^2 + t^2 s_i^2, and x_1 - x_0 the
    conditional mean m_i + (t s_i^2 - (1 - t)) (x - t m_i) / c_i; v is their mean over the posterior
    of i. Paths of a scalar do not cross; the distribution function is therefore constant along a
    path: x_t solves F_t(x_t) = F_0(x_0).

    Args:
        weights, means, stds: One for each component.
    """

    def __init__(self, *components: tuple[float, ...]) -> None:
        self.components = components

    def _at(self, t: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weights, means and deviations of x_1, variances of x_t; components first."""
        weights, means, stds = x.new_tensor(self.components).view(3, -1, *(1,) * x.ndim)
        return weights, means, stds, (1 - t) ** 2 + (t * stds) ** 2

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        weights, means, stds, variances = self._at(t, x)
        offsets = x - t * means
        scores = weights.log() - variances.log() / 2 - offsets.square() / variances / 2
        slopes = means + (t * stds**2 - (1 - t)) / variances * offsets
        return (scores.softmax(0) * slopes).sum(0)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        """x_t by bisection, to full precision, between the quantiles of the components."""
        weights, means, _, variances = self._at(t, x_0)
        # Compare the tail in which x_0 lies: 1 - F(x) would lose digits.
        side = torch.where(x_0 < 0, 1.0, -1.0)
        level = _normal_cdf(side * x_0)
        quantiles = t * means + variances.sqrt() * x_0
        low, high = quantiles.aminmax(dim=0)
        for _ in range(64):
            middle = (low + high) / 2
            tails = _normal_cdf(side * (middle - t * means) / variances.sqrt())
            above = ((weights * tails).sum(0) - level) * side > 0
            low = torch.where(above, low, middle)
            high = torch.where(above, middle, high)
        return (low + high) / 2


class TwoModes(GaussianMixture):
    """Mixture of two Gaussians of equal weight at -apart and +apart."""

    def __init__(self, apart: float = 0.5, std: float = 0.05) -> None:
        super().__init__((0.5, 0.5), (-apart, apart), (std, std))


# Like a pixel of a scan: -1 for a dropped ray, else around 0.3.
RayDrop = partial(GaussianMixture, (0.3, 0.7), (-1.0, 0.3), (1e-3, 0.3))


class PointMass(Problem):
    """x_1 = 1/2: v = (1/2 - x) / (1 - t), a straight path whose velocity is 0 / 0 at t = 1."""

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return (0.5 - x) / (1 - t)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return (1 - t) * x_0 + t * 0.5


class Straight(Problem):
    """A reflowed Gaussian, x_1 = mean + std x_0: one Euler step is exact."""

    mean = 0.7
    std = 0.25

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return self.mean + (self.std - 1) / (1 - t + t * self.std) * (x - t * self.mean)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return (1 - t) * x_0 + t * (self.mean + self.std * x_0)


@dataclass(frozen=True)
class Rotating(Problem):
    """x' = w J x: pairs of elements, one of each half, make `turns` rotations until t = 1."""

    turns: float = 0.5

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return 2 * math.pi * self.turns * self._quarter(x)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        angle = 2 * math.pi * self.turns * t
        return angle.cos() * x_0 + angle.sin() * self._quarter(x_0)

    def _quarter(self, x: Tensor) -> Tensor:
        """J x, a quarter of a rotation."""
        first, second = x.flatten(1).chunk(2, 1)
        return torch.cat([-second, first], 1).view(x.shape)


@dataclass(frozen=True)
class StiffLinear(Problem):
    """x' = -rate (x - sin t) + cos t: all paths approach a slow one within a time of 1 / rate.

    Prothero, Robinson, On the stability and accuracy of one-step methods for solving stiff systems,
    1974.
    """

    rate: float = 1e2

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return t.cos() - self.rate * (x - t.sin())

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return t.sin() + x_0 * (-self.rate * t).exp()


@dataclass(frozen=True)
class Discontinuous(Problem):
    """x' = -x before t = `at`, -x + jump from there."""

    jump: float = 3.0
    at: float = math.sqrt(2) - 1

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return self.jump * (t >= self.at) - x

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return x_0 * (-t).exp() - self.jump * torch.expm1(-(t - self.at).clamp(min=0))


@dataclass(frozen=True)
class NarrowJet(Problem):
    """x' = -x + N(t; at, width^2): an impulse of 1 in a few widths, which a long step can miss."""

    width: float = 2e-3
    at: float = 0.6

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        z = (t - self.at) / self.width
        return (-0.5 * z**2).exp() / (self.width * math.sqrt(2 * math.pi)) - x

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        w = self.width
        passed = _normal_cdf((t - self.at) / w - w) - _normal_cdf((0 * t - self.at) / w - w)
        return x_0 * (-t).exp() + (self.at - t + w**2 / 2).exp() * passed


@dataclass(frozen=True)
class Pulse(Problem):
    """x' = 1 / width within width / 2 of `at`, else 0, for any x: moves all paths by 1."""

    width: float = 0.2
    at: float = 0.45

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        inside = (t - self.at).abs() < self.width / 2
        return inside / self.width + torch.zeros_like(x)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return x_0 + ((t - self.at) / self.width + 0.5).clamp(0, 1)


PROBLEMS: Registry = Registry(
    "problem",
    straight=Straight,
    gaussian=Gaussian,
    narrow_gaussian=partial(Gaussian, std=0.01),
    two_modes=TwoModes,
    ray_drop=RayDrop,
    point_mass=PointMass,
    anisotropic=Anisotropic,
    stiff_1e2=partial(StiffLinear, rate=1e2),
    stiff_1e4=partial(StiffLinear, rate=1e4),
    stiff_1e6=partial(StiffLinear, rate=1e6),
    discontinuous=Discontinuous,
    narrow_jet=NarrowJet,
    pulse=Pulse,
    rotating=Rotating,
)
