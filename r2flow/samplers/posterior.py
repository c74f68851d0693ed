"""Samples given a part of x_1, by a flow that was trained without a condition.

A sampler takes the states x_t of a flow from noise at t = 0 to x_1 at t = 1, where the values of a mask are known. With
u = v(t, x_t), x_1hat = x_t + (1 - t) u is the mean E[x_1 | x_t]. With a flow map, `Replace` and `Repaint` jump to the
next time; `MMPS` needs that mean and takes the map's velocity u(x, t, t).
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.maps import MeanVelocity, jump
from r2flow.registry import Count, NonNegative
from r2flow.samplers.base import Call, Fresh, Generated, Given, Grid, Noise, OnGrid, Steps
from r2flow.samplers.stochastic import back, sde

GROWN = 10.0  # times |y - A x_1hat|^2: a larger residual has diverged
EARLIEST = 0.1  # earlier times take the Jacobian of this one: the formula divides by t


@dataclass(frozen=True)
class Posterior(OnGrid):
    """A sampler with `image` and `known` of each scan as its condition; known values arrive as given."""

    completes: ClassVar[bool] = True
    paired: ClassVar[bool] = False

    steps: Steps = 10
    grid: Grid = "power:2"

    def evaluations(self, generator: Any = None) -> int:
        return self.steps

    @abstractmethod
    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any) -> Tensor:
        """x_1 from noise x, (B, ...), given y where `known`, (B, ...) bool."""

    def check(self, generator: Any) -> None:
        super().check(generator)
        if generator.told:
            kind = type(generator).__name__
            raise InputError(f"sampler {self.name} asks a flow of whole scans; a {kind} completes by jump.")

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        if condition is None:
            raise InputError(f"{self.name} completes scans: it needs a condition.")

        def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
            velocity: Tensor = generator.mean_velocity(t, x, s).to(x)
            progress()
            if velocity.requires_grad:
                velocity.register_hook(lambda _: progress())  # each product with the Jacobian
            return velocity

        y, known = condition["image"].to(noise), condition["known"].to(noise) > 0
        return Generated.after(self.given(u, noise, y, known, self.times(), draws), self.evaluations(generator))

    def given(
        self, u: MeanVelocity, x_0: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Fresh = None
    ) -> Tensor:
        """x_1 given y, (B, ...), on times from 0 to 1."""
        if torch.is_inference_mode_enabled():  # products with a Jacobian need tensors that autograd may keep
            with torch.inference_mode(False), torch.no_grad():
                return self.given(u, x_0.clone(), y.clone(), known.clone(), times.clone(), noise)
        return torch.where(known, y, self.run(u, x_0, y, known, times.to(x_0), noise))


@dataclass(frozen=True)
class Replace(Posterior):
    """Euler steps, after each of which the known values lie on the line from this scan's own noise to y.

    x_t' = M (t' y + (1 - t') x_0) + (1 - M) (x_t + (t' - t) u). One evaluation a step, no noise.
    """

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any) -> Tensor:
        x_0 = x
        for t, s in pairwise(times):
            x = torch.where(known, s * y + (1 - s) * x_0, jump(u, t, x, s))
        return x


@dataclass(frozen=True)
class Repaint(Posterior):
    """`Replace` with fresh noise, which takes every step several times (Lugmayr et al. 2022, RePaint, algorithm 1).

    Before it takes a step again it goes back from t' to t by fresh noise (`back`), which leaves the law of the flow's
    x_t as it is. The first step is taken once: at t = 0 nothing of x_t' is left. A generator with a `repaint` of its
    own, as a diffusion, is run by that.

    Attributes:
        repeats: How often a step is taken.
        jump: Equal parts of a step.
    """

    draws: ClassVar[bool] = True

    repeats: Count = 4
    jump: Count = 1

    def times(self, *args: Any, **options: Any) -> Tensor:
        times = super().times(*args, **options)
        inner = torch.arange(self.jump, dtype=times.dtype, device=times.device) / self.jump
        return torch.cat([(times[:-1, None] + times.diff()[:, None] * inner).flatten(), times[-1:]])

    def evaluations(self, generator: Any = None) -> int:
        return self.jump * (1 + self.repeats * (self.steps - 1))

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise) -> Tensor:
        j = 0
        for first in range(0, len(times) - 1, self.jump):
            part = times[first : first + self.jump + 1]
            for again in range(self.repeats if first else 1):
                if again:
                    j += 1
                    x = back(x, float(part[-1]), float(part[0]), noise(j))
                for t, s in pairwise(part):
                    j += 1
                    x = torch.where(known, s * y + (1 - s) * noise(j), jump(u, t, x, s))
        return x

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        if condition is None or not hasattr(generator, "repaint"):
            return super().__call__(generator, noise, condition, draws, progress)
        y, known = condition["image"].to(noise), condition["known"].to(noise) > 0
        x = generator.repaint(noise, y, known, self.times(), draws, self.repeats, self.jump, progress)
        return Generated.after(torch.where(known, y, x), self.evaluations())


@dataclass(frozen=True)
class MMPS(Posterior):
    """The posterior mean by the flow's own covariance (Rozet et al. 2024, moment matching posterior sampling).

    Cov(x_1 | x_t) = C = ((1 - t)^2 / t) J with J = d x_1hat / d x_t, the second-order Tweedie formula, so that
    E[x_1 | x_t, y] = x_1hat + C A^T (A C A^T)^-1 (y - A x_1hat), which is exact where x_1 is Gaussian given x_t. The
    linear system is solved by conjugate gradients (`_solved`), each step one product with J; where C is not positive in
    a direction, as a network's may be, they end. With that mean `sde` takes the steps.

    Attributes:
        products: Products with the Jacobian in a step.
        churn: Noise that is replaced, as in `SDE`.
    """

    products: Count = 2
    churn: NonNegative = 1.0

    @property
    def draws(self) -> bool:  # type: ignore[override]
        return self.churn > 0

    def evaluations(self, generator: Any = None) -> int:
        """A vector-Jacobian product counts as one."""
        return self.steps * (1 + self.products)

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise) -> Tensor:
        def mean(t: Tensor, x: Tensor) -> Tensor:
            at = t.clamp(min=EARLIEST)
            with torch.enable_grad():
                state = (x * ((1 - at) / (1 - t))).detach().requires_grad_()
                x_1 = state + (1 - at) * u(at, state, at)

            def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
                moved = (1 - at) ** 2 / at * torch.autograd.grad(x_1, state, p, retain_graph=True)[0]
                return moved, known * moved

            residual = torch.where(known, y - x_1.detach(), 0)
            return torch.where(known, y, x_1.detach() + _solved(multiply, residual, self.products))

        *_, x = sde(mean, x, times, self.churn, noise)
        return x


def _solved(multiply: Callable[[Tensor], tuple[Tensor, Tensor]], r: Tensor, steps: int) -> Tensor:
    """B S^-1 r for a positive S, each scan for itself, with `multiply(p)` = (B p, S p).

    By conjugate gradients or, where these have left more than `GROWN` r r, by the combination of the same directions
    that leaves the least: a network's J is not quite symmetric, and their residual may then grow without end. A scan
    ends where its residual is 0 to rounding, or in a direction in which S is not positive.
    """
    p, rr, found = r, _dot(r, r), torch.zeros(())
    goes = torch.ones_like(rr, dtype=torch.bool)
    enough, most = torch.finfo(r.dtype).eps ** 2 * rr, GROWN * rr
    rest, least = r, torch.zeros(())
    last: tuple[Tensor, Tensor] | None = None  # the direction before, S p orthogonal to the others' and of length 1
    for _ in range(steps):
        moved, q = multiply(p)
        curvature = _dot(p, q)
        goes = goes & (rr > enough) & (curvature > 0)
        step = torch.where(goes, rr / curvature, 0)
        found, r = found + step * moved, r - step * q
        former, rr = rr, _dot(r, r)
        p = r + torch.where(goes, rr / former, 0) * p
        if last is not None:
            share = _dot(last[1], q)
            moved, q = moved - share * last[0], q - share * last[1]
        length = _dot(q, q).sqrt()
        goes = goes & (length > 0)
        last = torch.where(goes, moved / length, 0), torch.where(goes, q / length, 0)
        share = _dot(rest, last[1])
        least, rest = least + share * last[0], rest - share * last[1]
    return torch.where(rr <= most, found, least)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Sum of a b over each scan, (B, 1, ...)."""
    return (a * b).flatten(1).sum(1).view(-1, *(1,) * (a.ndim - 1))
