"""Samples given a part of x_1, by a flow that was trained without a condition (`r2flow.flow.posterior`)."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow import posterior
from r2flow.flow.maps import MeanVelocity
from r2flow.registry import Count, NonNegative
from r2flow.samplers.base import Condition, Generated, Grid, Noise, OnGrid, Progress, Steps


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

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        if condition is None:
            raise InputError(f"{self.name} completes scans: it needs a condition.")

        def u(t: Tensor, x: Tensor, s: Tensor) -> Tensor:
            velocity: Tensor = generator.mean_velocity(t, x, s).to(x)
            if progress is not None:
                progress()
                if velocity.requires_grad:
                    velocity.register_hook(lambda _: progress())  # each product with the Jacobian
            return velocity

        y, known = condition["image"].to(noise), condition["known"].to(noise) > 0
        return Generated.after(self.given(u, noise, y, known, self.times(), draws), self.evaluations(generator))

    def given(
        self, u: MeanVelocity, x_0: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Noise | None = None
    ) -> Tensor:
        """x_1 given y, (B, ...), on times from 0 to 1."""
        if torch.is_inference_mode_enabled():  # products with a Jacobian need tensors that autograd may keep
            with torch.inference_mode(False), torch.no_grad():
                return self.given(u, x_0.clone(), y.clone(), known.clone(), times.clone(), noise)
        return torch.where(known, y, self.run(u, x_0, y, known, times.to(x_0), noise))


@dataclass(frozen=True)
class Replace(Posterior):
    """Known values on the straight line from this scan's noise, after every step: `r2flow.flow.posterior.replace`."""

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any) -> Tensor:
        return posterior.replace(u, x, y, known, times, noise)


@dataclass(frozen=True)
class Repaint(Posterior):
    """Known values with fresh noise after every step, and repeated steps (Lugmayr et al. 2022, RePaint).

    A generator with a `repaint` of its own, as a diffusion, is run by that; a flow by `r2flow.flow.posterior.repaint`.

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

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any) -> Tensor:
        return posterior.repaint(u, x, y, known, times, noise, self.repeats, self.jump)

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        if condition is None or not hasattr(generator, "repaint"):
            return super().__call__(generator, noise, condition, draws, progress)
        y, known = condition["image"].to(noise), condition["known"].to(noise) > 0
        x = generator.repaint(noise, y, known, self.times(), draws, self.repeats, self.jump, progress)
        return Generated.after(torch.where(known, y, x), self.evaluations())


@dataclass(frozen=True)
class MMPS(Posterior):
    """Moment matching posterior sampling (Rozet et al. 2024): `r2flow.flow.posterior.mmps`.

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

    def run(self, u: MeanVelocity, x: Tensor, y: Tensor, known: Tensor, times: Tensor, noise: Any) -> Tensor:
        return posterior.mmps(u, x, y, known, times, noise, self.products, self.churn)
