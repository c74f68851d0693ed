"""Test problems for solvers: flows with a known solution.

States have any shape (B, ...). `Gaussian`, `Anisotropic`, the mixtures and `PointMass` are rectified flows:
x_0 ~ N(0, 1), x_1 independent of x_0, v(t, x) = E[x_1 - x_0 | x_t = x]. `Straight` is a reflowed Gaussian. The others
do not model data; each has a different difficulty for solvers.
"""

import functools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.registry import Registry


class Problem(ABC):
    """A velocity and its exact paths; a subclass gets times that broadcast with the state."""

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        """v(t, x) in x's type, with t of shape () or (B,) and x (B, ...)."""
        return self.velocity(expand_time(t, x), x)

    def solution(self, x_0: Tensor, t: Tensor | float) -> Tensor:
        """x_t, (B, ...) float64, of the path that starts at x_0; t of shape () or (B,)."""
        x_0 = x_0.double()
        return self.path(x_0, expand_time(torch.as_tensor(t, dtype=torch.float64, device=x_0.device), x_0))

    @abstractmethod
    def velocity(self, t: Tensor, x: Tensor) -> Tensor: ...

    @abstractmethod
    def path(self, x_0: Tensor, t: Tensor) -> Tensor: ...


class Gaussian(Problem):
    """x_1 ~ N(mean, std^2): x_t = t mean + sigma_t x_0 with sigma_t^2 = (1 - t)^2 + t^2 std^2.

    A smaller std gives later and sharper turns of the paths.
    """

    mean = 0.7

    def __init__(self, std: float = 0.25) -> None:
        self.std = std

    def deviation(self, x: Tensor) -> Tensor | float:
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
    """Phi(x), accurate in the lower tail, where `torch.special.ndtr` loses all digits beyond 6 standard deviations."""
    return torch.special.erfc(-x / math.sqrt(2)) / 2


class GaussianMixture(Problem):
    """x_1 from a mixture of Gaussians, independently in every element.

    In component i, x_t has mean t m_i and variance c_i = (1 - t)^2 + t^2 s_i^2, and x_1 - x_0 the conditional mean
    m_i + (t s_i^2 - (1 - t)) (x - t m_i) / c_i; v is their mean over the posterior of i. Paths of a scalar do not
    cross; the distribution function is therefore constant along a path: x_t solves F_t(x_t) = F_0(x_0).
    """

    def __init__(self, weights: Sequence[float], means: Sequence[float], stds: Sequence[float]) -> None:
        self.weights, self.means, self.stds = tuple(weights), tuple(means), tuple(stds)

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        scores, slopes = [], []
        for weight, mean, std in zip(self.weights, self.means, self.stds, strict=True):
            variance = (1 - t) ** 2 + (t * std) ** 2
            offset = x - t * mean
            scores.append(math.log(weight) - 0.5 * variance.log() - 0.5 * offset.square() / variance)
            slopes.append(mean + (t * std**2 - (1 - t)) / variance * offset)
        return (torch.stack(scores).softmax(0) * torch.stack(slopes)).sum(0)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        """x_t by bisection, to full precision: the quantile of a mixture lies between those of its components."""
        means = torch.stack([t * mean + torch.zeros_like(x_0) for mean in self.means])
        stds = torch.stack([((1 - t) ** 2 + (t * std) ** 2).sqrt() + torch.zeros_like(x_0) for std in self.stds])
        weights = torch.tensor(self.weights, dtype=torch.float64, device=x_0.device).view(-1, *(1,) * x_0.ndim)
        # Compare the tail in which x_0 lies: 1 - F(x) would lose digits.
        side = torch.where(x_0 < 0, 1.0, -1.0)
        level = _normal_cdf(side * x_0)
        low, high = (means + stds * x_0).amin(0), (means + stds * x_0).amax(0)
        for _ in range(64):
            middle = (low + high) / 2
            tail = (weights * _normal_cdf(side * (middle - means) / stds)).sum(0)
            above = (tail - level) * side > 0
            low, high = torch.where(above, low, middle), torch.where(above, middle, high)
        return (low + high) / 2


class TwoModes(GaussianMixture):
    """Mixture of two Gaussians of equal weight at -apart and +apart."""

    def __init__(self, apart: float = 0.5, std: float = 0.05) -> None:
        super().__init__((0.5, 0.5), (-apart, apart), (std, std))


class RayDrop(GaussianMixture):
    """Mixture like a pixel of a scan: -1 (within `std`) for a dropped ray, else a range around 0.3."""

    def __init__(self, dropped: float = 0.3, std: float = 1e-3) -> None:
        super().__init__((dropped, 1 - dropped), (-1.0, 0.3), (std, 0.3))


class PointMass(Problem):
    """x_1 = 1/2: v = (1/2 - x) / (1 - t), a straight path whose velocity is 0 / 0 at t = 1."""

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return (0.5 - x) / (1 - t)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return (1 - t) * x_0 + t * 0.5


class Straight(Problem):
    """A reflowed Gaussian, x_1 = mean + std x_0: one Euler step is exact."""

    mean, std = 0.7, 0.25

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return self.mean + (self.std - 1) / (1 - t + t * self.std) * (x - t * self.mean)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return (1 - t) * x_0 + t * (self.mean + self.std * x_0)


class Rotating(Problem):
    """x' = w J x: pairs of elements, from the first and the second half, make `turns` full rotations until t = 1."""

    def __init__(self, turns: float = 0.5) -> None:
        self.speed = 2 * math.pi * turns

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        first, second = x.flatten(1).chunk(2, 1)
        return self.speed * torch.cat([-second, first], 1).view(x.shape)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        first, second = x_0.flatten(1).chunk(2, 1)
        angle = self.speed * t.view(-1, 1)
        c, s = angle.cos(), angle.sin()
        return torch.cat([c * first - s * second, s * first + c * second], 1).view(x_0.shape)


class StiffLinear(Problem):
    """x' = -rate (x - sin t) + cos t: all paths approach a slow one within a time of 1 / rate.

    Prothero, Robinson, On the stability and accuracy of one-step methods for solving stiff systems, 1974.
    """

    def __init__(self, rate: float = 1e2) -> None:
        self.rate = rate

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return t.cos() - self.rate * (x - t.sin())

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return t.sin() + x_0 * (-self.rate * t).exp()


class Discontinuous(Problem):
    """x' = -x before t = `at`, -x + jump from there."""

    def __init__(self, jump: float = 3.0, at: float = math.sqrt(2) - 1) -> None:
        self.jump, self.at = jump, at

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        return self.jump * (t >= self.at) - x

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return x_0 * (-t).exp() - self.jump * torch.expm1(-(t - self.at).clamp(min=0))


class NarrowJet(Problem):
    """x' = -x + N(t; at, width^2): an impulse of 1 within a few widths, which a long step can miss."""

    def __init__(self, width: float = 2e-3, at: float = 0.6) -> None:
        self.width, self.at = width, at

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        z = (t - self.at) / self.width
        return (-0.5 * z**2).exp() / (self.width * math.sqrt(2 * math.pi)) - x

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        w = self.width
        passed = _normal_cdf((t - self.at) / w - w) - _normal_cdf(t.new_tensor(-self.at / w - w))
        return x_0 * (-t).exp() + (self.at - t + w**2 / 2).exp() * passed


class Pulse(Problem):
    """x' = 1 / width within width / 2 of `at`, else 0, for any x: moves all paths by 1."""

    def __init__(self, width: float = 0.2, at: float = 0.45) -> None:
        self.width, self.at = width, at

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        inside = (t - self.at).abs() < self.width / 2
        return (inside / self.width).to(x.dtype) + torch.zeros_like(x)

    def path(self, x_0: Tensor, t: Tensor) -> Tensor:
        return x_0 + ((t - self.at) / self.width + 0.5).clamp(0, 1)


PROBLEMS: Registry = Registry(
    "problem",
    straight=Straight,
    gaussian=Gaussian,
    narrow_gaussian=functools.partial(Gaussian, std=0.01),
    two_modes=TwoModes,
    ray_drop=RayDrop,
    point_mass=PointMass,
    anisotropic=Anisotropic,
    stiff_1e2=functools.partial(StiffLinear, rate=1e2),
    stiff_1e4=functools.partial(StiffLinear, rate=1e4),
    stiff_1e6=functools.partial(StiffLinear, rate=1e6),
    discontinuous=Discontinuous,
    narrow_jet=NarrowJet,
    pulse=Pulse,
    rotating=Rotating,
)
