"""Posterior samplers: sample x_1 given a part of it, by a flow trained without a condition.

With u = v(t, x_t), x_1hat = x_t + (1 - t) u is the mean E[x_1 | x_t]. With a flow map, `Replace`
and `Repaint` jump to the next time; `MMPS` needs the mean and takes the map's velocity u(x, t, t).
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count, pairwise
from typing import Any

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Count, NonNegative
from r2flow.flow.maps import MeanVelocity, jump
from r2flow.samplers.base import Generated, Grid, Known, Noise, OnGrid, Steps, Tick
from r2flow.samplers.stochastic import SDE, back, sde

# Largest growth of |y - A x_1hat|^2 in conjugate gradients: a larger residual has diverged.
_GROWN = 10.0
_EARLIEST = 0.1  # earliest time of the Jacobian in `MMPS`: Cov(x_1 | x_t) divides it by t


@dataclass(frozen=True)
class Posterior(OnGrid):
    """A sampler conditioned on `image` and `known` of each scan, which keeps known values."""

    completes = True
    paired = False

    steps: Steps = 10
    grid: Grid = "power:2"

    def evaluations(self, generator: Any = None) -> int:
        return self.steps

    @abstractmethod
    def run(
        self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any
    ) -> Tensor:
        """x_1 from noise x, (B, ...), given the values of y where `known`, (B, ...) bool."""

    def check(self, generator: Any) -> None:
        super().check(generator)
        if generator.takes_condition:
            raise InputError(
                f"sampler {self.name} needs an unconditional flow; for this model give jump."
            )

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        if condition is None:
            raise InputError(
                f"{self.name} completes scans: it needs a condition (r2flow complete)."
            )
        y = condition["image"].to(noise)
        known = condition["known"].to(noise) > 0
        x = self.answer(generator, noise, y, known, draws, progress)
        return Generated.after(torch.where(known, y, x), self.evaluations())

    def answer(
        self, generator: Any, x_0: Tensor, y: Tensor, known: Tensor, noise: Noise, progress: Tick
    ) -> Tensor:
        """x_1 of a generator given y where `known`, (B, ...)."""

        def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
            velocity: Tensor = generator.mean_velocity(t, x, s).to(x)
            progress()
            if velocity.requires_grad:
                # One call per product with the Jacobian.
                velocity.register_hook(lambda _: progress())
            return velocity

        with torch.inference_mode(False), torch.no_grad():
            # Vector-Jacobian products need tensors that autograd can save.
            x_0, y, known = (part.clone() for part in (x_0, y, known))
            return self.run(u, x_0, y, known, self.times().to(x_0), noise)


@dataclass(frozen=True)
class Replace(Posterior):
    """Euler steps, each followed by replacing the known values by the line from x_0 to y.

    x_t' = M (t' y + (1 - t') x_0) + (1 - M) (x_t + (t' - t) u). One evaluation per step,
    deterministic.
    """

    def run(
        self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any
    ) -> Tensor:
        x_0 = x
        for t, s in pairwise(times):
            x = torch.where(known, s * y + (1 - s) * x_0, jump(u, t, x, s))
        return x


@dataclass(frozen=True)
class Repaint(Posterior):
    """`Replace` with fresh noise and repeated steps (Lugmayr et al. 2022, RePaint, algorithm 1).

    Before repeating a step, it goes back from t' to t by fresh noise (`back`), which preserves the
    distribution of x_t. The first step is taken once, since x_0 does not depend on x_t'. If the
    generator has a method `repaint`, as a diffusion model has, that method is used instead.
    """

    draws = True

    repeats: Count = 4  # how often each step is taken
    jump: Count = 1  # number of equal parts of a step

    def times(self) -> Tensor:
        times = super().times()
        inner = torch.arange(self.jump, dtype=times.dtype, device=times.device) / self.jump
        return torch.cat([(times[:-1, None] + times.diff()[:, None] * inner).flatten(), times[-1:]])

    def evaluations(self, generator: Any = None) -> int:
        return self.jump * (1 + self.repeats * (self.steps - 1))

    def run(
        self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise
    ) -> Tensor:
        draws = map(noise, count(1))
        for first in range(0, len(times) - 1, self.jump):
            part = times[first : first + self.jump + 1]
            for again in range(self.repeats if first else 1):
                if again:
                    x = back(x, float(part[-1]), float(part[0]), next(draws))
                for t, s in pairwise(part):
                    x = torch.where(known, s * y + (1 - s) * next(draws), jump(u, t, x, s))
        return x

    def answer(
        self, generator: Any, x_0: Tensor, y: Tensor, known: Tensor, noise: Noise, progress: Tick
    ) -> Tensor:
        if hasattr(generator, "repaint"):
            return generator.repaint(self, x_0, y, known, noise, progress)
        return super().answer(generator, x_0, y, known, noise, progress)


@dataclass(frozen=True)
class MMPS(Posterior):
    """Moment matching posterior sampling (Rozet et al. 2024): mean by the flow's covariance.

    Cov(x_1 | x_t) = C = ((1 - t)^2 / t) J with J = d x_1hat / d x_t, the second-order Tweedie
    formula of a 1-RF: then E[x_1 | x_t, y] = x_1hat + C A^T (A C A^T)^-1 (y - A x_1hat), which is
    exact if x_1 is Gaussian given x_t. Conjugate gradients (`_solved`) solve the linear system with
    one product with J per iteration; they stop at a direction in which C is not positive, which a
    network does not exclude. `sde` takes the steps with this mean.
    """

    draws = SDE.draws

    products: Count = 2  # with the Jacobian per step
    churn: NonNegative = 1.0  # noise replacement, as in `SDE`

    def evaluations(self, generator: Any = None) -> int:
        """Network evaluations per scan; a vector-Jacobian product counts as one."""
        return self.steps * (1 + self.products)

    def run(
        self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise
    ) -> Tensor:
        def mean(t: Tensor, x: Tensor) -> Tensor:
            at = t.clamp(min=_EARLIEST)
            with torch.enable_grad():
                # 0 / 0 at a late t that float32 rounds to 1.
                scale = torch.where(t < at, (1 - at) / (1 - t), 1)
                state = (x * scale).detach().requires_grad_()
                x_1 = state + (1 - at) * u(at, state, at)

            def multiply(p: Tensor) -> tuple[Tensor, Tensor]:
                (product,) = torch.autograd.grad(x_1, state, p, retain_graph=True)
                moved = (1 - at) ** 2 / at * product
                return moved, known * moved

            residual = torch.where(known, y - x_1.detach(), 0)
            return torch.where(known, y, x_1.detach() + _solved(multiply, residual, self.products))

        *_, x = sde(mean, x, times, self.churn, noise)
        return x


def _solved(multiply: Callable[[Tensor], tuple[Tensor, Tensor]], r: Tensor, steps: int) -> Tensor:
    """B S^-1 r for a positive S, per scan, with `multiply(p)` = (B p, S p), by conjugate gradients.

    Where their squared residual exceeds `_GROWN` r r, as a network's J is not exactly symmetric, it
    is the combination of the same directions with the smallest residual. A scan stops at a residual
    of 0 or if S is not positive along p.
    """
    p = r
    rr = _dot(r, r)
    tolerance = torch.finfo(r.dtype).eps ** 2 * rr
    limit = _GROWN * rr
    active = torch.ones_like(rr, dtype=torch.bool)
    rest = r  # the smallest residual
    solution = least = last = last_image = torch.zeros_like(r)
    for _ in range(steps):
        product, image = multiply(p)
        curvature = _dot(p, image)
        active = active & (rr > tolerance) & (curvature > 0)
        step = torch.where(active, rr / curvature, 0)
        solution = solution + step * product
        r = r - step * image
        before = rr
        rr = _dot(r, r)
        p = r + torch.where(active, rr / before, 0) * p
        # The smallest residual, by images S p made orthonormal to the one before.
        share = _dot(last_image, image)
        last = product - share * last
        last_image = image - share * last_image
        length = _dot(last_image, last_image).sqrt()
        active = active & (length > 0)
        last = torch.where(active, last / length, 0)
        last_image = torch.where(active, last_image / length, 0)
        share = _dot(rest, last_image)
        least = least + share * last
        rest = rest - share * last_image
    return torch.where(rr <= limit, solution, least)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Sum of a b over each scan, (B, 1, ...)."""
    return (a * b).flatten(1).sum(1).view(-1, *(1,) * (a.ndim - 1))
