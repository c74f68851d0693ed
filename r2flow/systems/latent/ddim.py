"""Diffusions of N steps, z_t = sqrt(a_t) x + sqrt(1 - a_t) eps at t = 0 .. N - 1: objective, ancestral steps and DDIM.

a_t, `alpha_bar` in the code, is the share of the data in the variance of z_t (Ho et al. 2020, "Denoising diffusion
probabilistic models"; Song et al. 2021, "Denoising diffusion implicit models"). Networks are given t itself.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.errors import InputError

Predict = Callable[[Tensor, Tensor], Tensor]
"""eps(z, t): latents (B, ...) and the step of each, (B,) int64, to their noise, (B, ...)."""


def square_root_linear(first: float, last: float, steps: int) -> Tensor:
    """beta_t whose square roots rise in equal steps, (steps,) float64: LiDM's from 0.0015 to 0.0195 in 1000."""
    return torch.linspace(first**0.5, last**0.5, steps, dtype=torch.float64) ** 2


class Tables(NamedTuple):
    """What follows from beta, (N,) float64 each.

    Attributes:
        beta: Share of the variance that step t replaces by noise.
        alpha_bar: a_t, the product of 1 - beta up to t.
        alpha_bar_prev: a_{t-1}; 1 before the first step.
        variance: Of z_{t-1} where z_t and x are known, beta_t (1 - a_{t-1}) / (1 - a_t) (2020, eq. 7).
        log_variance: Its logarithm, of 1e-20 where it is 0.
        of_data, of_state: That z_{t-1}'s mean is of_data x + of_state z_t (2020, eq. 7).
        bound: Weight of |eps - eps(z_t, t)|^2 in the variational bound (2020, eq. 12); the first is the second's.
    """

    beta: Tensor
    alpha_bar: Tensor
    alpha_bar_prev: Tensor
    variance: Tensor
    log_variance: Tensor
    of_data: Tensor
    of_state: Tensor
    bound: Tensor


def tables(beta: Tensor) -> Tables:
    """The tables of beta, (N,) float64."""
    alpha = 1 - beta
    alpha_bar = alpha.cumprod(0)
    before = torch.cat([torch.ones_like(beta[:1]), alpha_bar[:-1]])
    variance = beta * (1 - before) / (1 - alpha_bar)
    bound = beta.square() / (2 * variance * alpha * (1 - alpha_bar))
    bound[0] = bound[1]
    return Tables(
        beta,
        alpha_bar,
        before,
        variance,
        variance.clamp(min=1e-20).log(),
        beta * before.sqrt() / (1 - alpha_bar),
        (1 - before) * alpha.sqrt() / (1 - alpha_bar),
        bound,
    )


def at(table: Tensor, t: Tensor, z: Tensor) -> Tensor:
    """A table's values at the steps t, (B,), in the type of z and to be multiplied with it."""
    return table[t].to(z.dtype).view(-1, *[1] * (z.ndim - 1))


def noised(x: Tensor, t: Tensor, eps: Tensor, alpha_bar: Tensor) -> Tensor:
    """z_t of data x, (B, ...), at steps t, (B,)."""
    return at(alpha_bar.sqrt(), t, x) * x + at((1 - alpha_bar).sqrt(), t, x) * eps


def noise_loss(predict: Predict, x: Tensor, t: Tensor, eps: Tensor, alpha_bar: Tensor) -> Tensor:
    """mean |eps - eps(z_t, t)|^2 of each of x, (B,) (2020, eq. 14)."""
    return (predict(noised(x, t, eps, alpha_bar), t) - eps).square().flatten(1).mean(1)


def expected_data(z: Tensor, t: Tensor, eps: Tensor, alpha_bar: Tensor) -> Tensor:
    """x = z_t / sqrt(a_t) - sqrt(1 / a_t - 1) eps."""
    return at((1 / alpha_bar).sqrt(), t, z) * z - at((1 / alpha_bar - 1).sqrt(), t, z) * eps


def ancestral_step(predict: Predict, z: Tensor, t: Tensor, noise: Tensor, of: Tables) -> Tensor:
    """z_{t-1} of z_t at steps t, (B,) (2020, algorithm 2, with the variance of `Tables`); at t = 0 without noise."""
    x = expected_data(z, t, predict(z, t), of.alpha_bar)
    mean = at(of.of_data, t, z) * x + at(of.of_state, t, z) * z
    spread = at((of.log_variance / 2).exp() * (torch.arange(len(of.beta), device=t.device) > 0), t, z)
    return mean + spread * noise


class Walk(NamedTuple):
    """Some of a diffusion's steps, from the first to the last that are taken: (S,) each.

    Attributes:
        times: t, falling.
        alpha: a at t.
        alpha_prev: a at the time that the step goes to.
        sigma: Standard deviation of the noise that it adds.
    """

    times: Tensor
    alpha: Tensor
    alpha_prev: Tensor
    sigma: Tensor


def ddim_walk(alpha_bar: Tensor, steps: int, eta: float) -> Walk:
    """Every (N // steps)-th of the N steps, from 1 on: more than `steps` where that does not divide N.

    sigma = eta sqrt((1 - a') / (1 - a) (1 - a / a')) from a to a' (2021, eq. 16). The last step goes to a_0 and not to
    1, as in the published code, and adds noise too.

    Raises:
        InputError: steps outside 1 to N - 1.
    """
    total = len(alpha_bar)
    if not 1 <= steps < total:
        raise InputError(f"a diffusion of {total} steps is sampled in 1 to {total - 1}, found {steps}.")
    times = torch.arange(0, total, total // steps) + 1
    times = times[times < total]
    alpha = alpha_bar[times]
    before = torch.cat([alpha_bar[:1], alpha[:-1]])
    sigma = eta * ((1 - before) / (1 - alpha) * (1 - alpha / before)).sqrt()
    return Walk(times.flip(0), alpha.flip(0), before.flip(0), sigma.flip(0))


def ddim(
    predict: Predict,
    z: Tensor,
    walk: Walk,
    noise: Callable[[int], Tensor],
    hold: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Iterator[tuple[Tensor, Tensor]]:
    """The state after each step and the data that the step expected, from z on (2021, eq. 12):

        x = (z - sqrt(1 - a) eps) / sqrt(a),  z' = sqrt(a') x + sqrt(1 - a' - sigma^2) eps + sigma noise.

    Args:
        z: Noise, (B, ...).
        noise: That of step k = 1, 2, ..., of z's shape; asked for where sigma is not 0.
        hold: Applied to the state and its time, (B,), before each step: puts in what is known.
    """
    for number, (t, a, b, sigma) in enumerate(zip(*(part.tolist() for part in walk), strict=True), start=1):
        times = torch.full((len(z),), int(t), device=z.device)
        if hold is not None:
            z = hold(z, times)
        eps = predict(z, times)
        x = (z - (1 - a) ** 0.5 * eps) / a**0.5
        z = b**0.5 * x + max(1 - b - sigma**2, 0.0) ** 0.5 * eps
        if sigma:
            z = z + sigma * noise(number)
        yield z, x
