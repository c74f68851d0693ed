"""Time densities: p(t) of the times at which a flow is trained, each given by its inverse CDF.

A density maps u ~ Uniform[0, 1) to t. The uniform draw comes from outside (counter-based, one per image), so that the
time of image k depends on k alone.
"""

import math
from collections.abc import Callable
from typing import Annotated

import torch
from torch import Tensor

from r2flow.flow.solvers.grids import build_grid
from r2flow.registry import Bound, Count, Portion, Positive, Registry

GOLDEN = -7046029254386353131  # (sqrt(5) - 1) / 2 of 2^64, as a signed integer
PLASTIC = -4521708957497675121, -7935046062780286180  # 1/p and 1/p^2 of 2^64, p^3 = p + 1

TimeDensity = Callable[[Tensor], Tensor]


class Uniform:
    """p(t) = 1, the density of 1-RF."""

    def __call__(self, u: Tensor) -> Tensor:
        return u


class UShaped:
    """p(t) proportional to e^(a t) + e^(a (1 - t)), a = 4 (Lee et al. 2024, as the paper uses it).

    The paper prints e^(-a t) for the second term, which is not U-shaped on [0, 1]: a slip. Each branch is
    taken half of the time; one has the inverse CDF t = ln(u (e^a - 1) + 1) / a, the other is its mirror.
    """

    def __init__(self, a: Annotated[float, Bound("above 0 and at most 80", lambda a: 0 < a <= 80)] = 4.0) -> None:
        self.a = a

    def __call__(self, u: Tensor) -> Tensor:
        rising = u < 0.5
        v = torch.where(rising, 2 * u, 2 * u - 1)
        t = torch.log1p(v * math.expm1(self.a)) / self.a
        # float32 can return 1 + 1e-7, which is outside the path.
        return torch.where(rising, t, 1 - t).clamp(0, 1)


class LogitNormal:
    """logit(t) ~ N(mean, std^2) (Esser et al. 2024): most weight in the middle of the path."""

    def __init__(self, mean: float = 0.0, std: Positive = 1.0) -> None:
        self.mean, self.std = mean, std

    def __call__(self, u: Tensor) -> Tensor:
        normal = torch.special.ndtri(u.double().clamp(1e-12, 1 - 1e-12))
        return torch.sigmoid(self.mean + self.std * normal).to(u.dtype)


class Late:
    """p(t) = 1 - share + share q(t) with logit(t) ~ N(mean, std^2) under q: uniform, and more near t = 1.

    The last hundredths before t = 1, of which a uniform density shows as many hundredths of the images, are where
    surfaces become smooth.
    """

    def __init__(self, share: Portion = 0.5, mean: float = 2.0, std: Positive = 1.6) -> None:
        self.share, self.logit_normal = share, LogitNormal(mean, std)

    def __call__(self, u: Tensor) -> Tensor:
        late = u < self.share
        rest = (u - self.share) / (1 - self.share)
        return torch.where(late, self.logit_normal(u / max(self.share, 1e-12)), rest.clamp(0, 1))


class Discrete:
    """t uniform on the times at which k Euler steps begin, {0, 1/k, ..., (k-1)/k} on a uniform grid (k-TD)."""

    def __init__(self, k: Count, grid: str = "uniform") -> None:
        self.k, self.times = k, build_grid(grid, 0.0, 1.0, k)

    def __call__(self, u: Tensor) -> Tensor:
        return self.times.to(u)[(u * self.k).long()]


def golden_sequence(k: Tensor) -> Tensor:
    """(k + 1/2) (sqrt(5) - 1) / 2 mod 1 of integers k, float32: a low-discrepancy sequence over [0, 1).

    In 64-bit integers that wrap around, so that no k is too large.
    """
    return _turns(k, GOLDEN)


def plastic_sequence(k: Tensor) -> Tensor:
    """The same in two dimensions, (..., 2) float32: steps 1 / p and 1 / p^2 with p^3 = p + 1 (Roberts 2018, R2)."""
    return torch.stack([_turns(k, step) for step in PLASTIC], -1)


def _turns(k: Tensor, step: int) -> Tensor:
    return (k.long() * step + step % 2**64 // 2 >> 40 & 0xFFFFFF).float() / 2**24


TIMES: Registry[Callable[..., TimeDensity]] = Registry(
    "time density",
    uniform=Uniform,
    u_shaped=UShaped,
    logit_normal=LogitNormal,
    late=Late,
    discrete=Discrete,
)
