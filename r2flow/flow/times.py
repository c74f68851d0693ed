"""Time densities p(t) for training, given by their inverse CDF.

A density maps u ~ Uniform[0, 1) to t. The caller draws u (counter-based, one per image), so that
the time of image k depends on k alone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from r2flow.base.registry import Bound, Count, Portion, Positive, Registry
from r2flow.flow.solvers.fixed import build_grid

_GOLDEN = -7046029254386353131  # (sqrt(5) - 1) / 2 of 2^64, as a signed integer
_PLASTIC = -4521708957497675121, -7935046062780286180  # 1/p and 1/p^2 of 2^64, p^3 = p + 1

_TimeDensity = Callable[[Tensor], Tensor]


class Uniform:
    """p(t) = 1, the density of 1-RF."""

    def __call__(self, u: Tensor) -> Tensor:
        return u


@dataclass
class UShaped:
    """p(t) proportional to e^(a t) + e^(a (1 - t)), a = 4 (Lee et al. 2024, as the paper uses it).

    The paper prints e^(-a t) for the second term, which is not U-shaped on [0, 1]: a typo. Each
    branch has probability 1/2; the first has the inverse CDF t = ln(u (e^a - 1) + 1) / a, the
    second is its mirror image.
    """

    a: Annotated[float, Bound("above 0 and at most 80", lambda a: 0 < a <= 80)] = 4.0

    def __call__(self, u: Tensor) -> Tensor:
        rising = u < 0.5
        v = torch.where(rising, 2 * u, 2 * u - 1)
        t = torch.log1p(v * math.expm1(self.a)) / self.a
        # float32 can round to 1 + 1e-7.
        return torch.where(rising, t, 1 - t).clamp(0, 1)


@dataclass
class LogitNormal:
    """logit(t) ~ N(mean, std^2) (Esser et al. 2024): most weight in the middle of the path."""

    mean: float = 0.0
    std: Positive = 1.0

    def __call__(self, u: Tensor) -> Tensor:
        normal = torch.special.ndtri(u.double().clamp(1e-12, 1 - 1e-12))
        return torch.sigmoid(self.mean + self.std * normal).to(u.dtype)


@dataclass
class Late:
    """p(t) = 1 - share + share q(t) with logit(t) ~ N(mean, std^2) under q: uniform, with more
    weight near t = 1.

    Surfaces become smooth in the last few hundredths before t = 1, which a uniform density rarely
    draws.
    """

    share: Portion = 0.5
    mean: float = 2.0
    std: Positive = 1.6

    def __call__(self, u: Tensor) -> Tensor:
        late = u < self.share
        near_one = LogitNormal(self.mean, self.std)
        rest = (u - self.share) / (1 - self.share)
        return torch.where(late, near_one(u / max(self.share, 1e-12)), rest.clamp(0, 1))


class Discrete:
    """t uniform on the times at which k Euler steps begin, {0, 1/k, ..., (k-1)/k} on a uniform grid
    (k-TD).
    """

    def __init__(self, k: Count, grid: str = "uniform") -> None:
        self.k = k
        self.times = build_grid(grid, 0.0, 1.0, k)

    def __call__(self, u: Tensor) -> Tensor:
        return self.times.to(u)[(u * self.k).long()]


def golden_sequence(k: Tensor) -> Tensor:
    """(k + 1/2) (sqrt(5) - 1) / 2 mod 1 for integers k, float32: a low-discrepancy sequence over
    [0, 1).

    Computed in 64-bit integers that wrap around, so that any k is valid.
    """
    return _turns(k, _GOLDEN)


def plastic_sequence(k: Tensor) -> Tensor:
    """Low-discrepancy sequence over [0, 1)^2, (..., 2) float32: steps 1/p, 1/p^2, p^3 = p + 1
    (Roberts 2018, R2).
    """
    return torch.stack([_turns(k, step) for step in _PLASTIC], -1)


def _turns(k: Tensor, step: int) -> Tensor:
    return (k.long() * step + step % 2**64 // 2 >> 40 & 0xFFFFFF).float() / 2**24


TIMES: Registry[Callable[..., _TimeDensity]] = Registry(
    "time density",
    uniform=Uniform,
    u_shaped=UShaped,
    logit_normal=LogitNormal,
    late=Late,
    discrete=Discrete,
)
