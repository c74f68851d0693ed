"""LiDM's diffusion: N steps t = 0 .. N - 1 on the log-SNRs, noising and DDIM steps of `r2flow.systems.diffusion`.

The network is given t itself, and alpha_bar_t = sigmoid(lambda_t) is the share of the data in the variance of z_t.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.systems.diffusion.objectives import PREDICTIONS
from r2flow.systems.diffusion.sampling import noised, step

Predict = Callable[[Tensor, Tensor], Tensor]
"""eps(z, t): latents (B, ...) and the step of each, (B,) int64, to their noise, (B, ...)."""


def square_root_linear(first: float, last: float, steps: int) -> Tensor:
    """beta_t whose square roots rise in equal steps, (steps,) float64: LiDM's from 0.0015 to 0.0195 in 1000."""
    return torch.linspace(first**0.5, last**0.5, steps, dtype=torch.float64) ** 2


class Tables(NamedTuple):
    """beta, the share of the variance that step t replaces by noise, and alpha_bar, the product of 1 - beta."""

    beta: Tensor
    alpha_bar: Tensor


def tables(beta: Tensor) -> Tables:
    return Tables(beta, (1 - beta).cumprod(0))


def noise_loss(predict: Predict, x: Tensor, t: Tensor, eps: Tensor, alpha_bar: Tensor) -> Tensor:
    """mean |eps - eps(z_t, t)|^2 of each of x, (B,) (Ho et al. 2020, eq. 14)."""
    z = noised(x, torch.logit(alpha_bar)[t], eps)
    return (predict(z, t) - eps).square().flatten(1).mean(1)


class Walk(NamedTuple):
    """The steps that are taken: t, (S,) falling; lambda before and after them, (S + 1,); the share of new noise."""

    times: Tensor
    log_snrs: Tensor
    eta: float


def ddim_walk(alpha_bar: Tensor, steps: int, eta: float) -> Walk:
    """Every (N // steps)-th of the N steps, from 1 on: more than `steps` where that does not divide N.

    The last step goes to alpha_bar_0 and not to 1, as in the published code, and adds noise too.
    """
    total = len(alpha_bar)
    if not 1 <= steps < total:
        raise InputError(f"a diffusion of {total} steps is sampled in 1 to {total - 1}, found {steps}.")
    times = torch.arange(0, total, total // steps) + 1
    times = times[times < total].flip(0)
    return Walk(times, torch.logit(torch.cat([alpha_bar[times], alpha_bar[:1]])), eta)


def ddim(predict: Predict, z: Tensor, walk: Walk, noise: Callable[[int], Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
    """The state after each step from z (B, ...) on, and the data that the step expected.

    Args:
        noise: That of step k = 1, 2, ..., of z's shape; asked for where eta is not 0.
    """
    for number, (t, (here, there)) in enumerate(zip(walk.times, pairwise(walk.log_snrs), strict=True), start=1):
        eps = predict(z, t.to(z.device).expand(len(z)))
        x, _ = PREDICTIONS["eps"].split(z, eps, here)
        z = step(z, x, here, there, walk.eta, noise(number) if walk.eta else None)
        yield z, x
