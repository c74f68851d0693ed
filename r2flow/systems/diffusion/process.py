"""Diffusion processes: log-SNR schedules, predictions of networks, and steps between noise levels.

A diffusion mixes data x and noise eps, z_t = alpha_t x + sigma_t eps with alpha_t^2 + sigma_t^2 =
1.

Notation and time follow Kingma et al. (2021), "Variational diffusion models": t = 0 is data and t =
1 is noise, the reverse of a flow. The noise level of z_t, and the time input of networks, is the
log-SNR, lambda_t = ln(alpha_t^2 / sigma_t^2), which decreases with t. Schedules compute in the
precision of t.

Noise is passed as a tensor or function, so that samplers are deterministic functions of noise.
"""

from collections.abc import Callable, Iterator
from itertools import count, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from r2flow.base.registry import Registry
from r2flow.flow.path import expand_time
from r2flow.samplers.base import Noise


def alpha_sigma(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha = sqrt(sigmoid(lambda)) and sigma = sqrt(sigmoid(-lambda)), in the shape of lambda."""
    return log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()


def for_images(log_snr: Tensor, z: Tensor) -> Tensor:
    """Reshape and cast lambda, () or (B,), to broadcast with z, (B, ...)."""
    return expand_time(log_snr.to(z), z)


class _Prediction(NamedTuple):
    """A prediction y = p x + q eps, which with z = alpha x + sigma eps determines x and eps.

        x = (sigma y - q z) / d,    eps = (p z - alpha y) / d,    d = p sigma - q alpha

    Its error is |p - q alpha / sigma| times that of x.
    """

    coefficients: Callable[[Tensor, Tensor], tuple[Any, Any]]  # p and q from alpha and sigma

    def target(self, x: Tensor, eps: Tensor, log_snr: Tensor) -> Tensor:
        """y of data and noise, (B, ...), at log-SNRs () or (B,)."""
        p, q = self.coefficients(*alpha_sigma(for_images(log_snr, x)))
        return p * x + q * eps

    def split(self, z: Tensor, y: Tensor, log_snr: Tensor) -> tuple[Tensor, Tensor]:
        """x and eps, (B, ...) each, from a state z and its prediction y."""
        alpha, sigma = alpha_sigma(for_images(log_snr, z))
        p, q = self.coefficients(alpha, sigma)
        d = p * sigma - q * alpha
        return (sigma * y - q * z) / d, (p * z - alpha * y) / d

    def weight(self, log_snr: Tensor, min_snr: float | None = 5.0) -> Tensor:
        """min(SNR, gamma) over the squared ratio of the errors of y and x, in the shape of log_snr.

        The loss of y is then min(SNR, gamma) times that of x for any prediction (Hang et al. 2023,
        "Efficient diffusion training via min-SNR weighting strategy"). gamma is `min_snr`; None:
        the SNR itself.
        """
        alpha, sigma = alpha_sigma(log_snr)
        p, q = self.coefficients(alpha, sigma)
        snr = log_snr.exp()
        weight = snr if min_snr is None else snr.clamp(max=min_snr)
        return weight / (p - q * alpha / sigma).square()


PREDICTIONS = Registry(
    "prediction",
    eps=_Prediction(lambda alpha, sigma: (0.0, 1.0)),
    v=_Prediction(lambda alpha, sigma: (-sigma, alpha)),  # Salimans and Ho 2022, appendix D
    x=_Prediction(lambda alpha, sigma: (1.0, 0.0)),
)

# Expected data given (z, log-SNR), the latter of shape ()
_Denoise = Callable[[Tensor, Tensor], Tensor]


def noised(x: Tensor, log_snr: Tensor, eps: Tensor) -> Tensor:
    """z = alpha x + sigma eps, (B, ...), at log-SNRs () or (B,)."""
    alpha, sigma = alpha_sigma(for_images(log_snr, x))
    return alpha * x + sigma * eps


def step(
    z: Tensor,
    x: Tensor,
    log_snr: Tensor,
    next_log_snr: Tensor,
    eta: float,
    noise: Tensor | None,
) -> Tensor:
    """z_s from z_t and expected data x, s < t:

        z_s = alpha_s x + sigma_s [sqrt(1 - eta^2 c) eps + eta sqrt(c) noise]

    with eps = (z_t - alpha_t x) / sigma_t and c = 1 - e^(lambda_t - lambda_s), the share of new
    noise. eta = 1 is DDPM's ancestral step, eta = 0 is DDIM (Song et al. 2021, "Denoising diffusion
    implicit models", eq. 12 and 16). In log-SNRs lambda, () or (B,), no digits are lost for alpha
    near 1. Without noise eta must be 0.
    """
    lambda_t = for_images(log_snr, z)
    lambda_s = for_images(next_log_snr, z)
    alpha, sigma = alpha_sigma(lambda_t)
    next_alpha, next_sigma = alpha_sigma(lambda_s)
    c = -torch.expm1(lambda_t - lambda_s)
    z_s = next_alpha * x + next_sigma * (1 - eta**2 * c).sqrt() * ((z - alpha * x) / sigma)
    return z_s if noise is None else z_s + next_sigma * eta * c.sqrt() * noise


def _forward_step(z: Tensor, log_snr: Tensor, next_log_snr: Tensor, noise: Tensor) -> Tensor:
    """z_t from z_s, s < t: alpha_t / alpha_s z_s + sigma_t sqrt(1 - e^(lambda_t - lambda_s)) n."""
    lambda_s = for_images(log_snr, z)
    lambda_t = for_images(next_log_snr, z)
    alpha, _ = alpha_sigma(lambda_s)
    next_alpha, next_sigma = alpha_sigma(lambda_t)
    return next_alpha / alpha * z + next_sigma * (-torch.expm1(lambda_t - lambda_s)).sqrt() * noise


def walk(
    denoise: _Denoise,
    z: Tensor,
    log_snrs: Tensor,
    eta: float,
    noise: Noise,
    times: Tensor | None = None,
) -> Iterator[Tensor]:
    """Yield the states from noise z, (B, ...), to data, after each of N steps.

    Args:
        log_snrs: Rising log-SNRs, (N + 1,).
        eta: See `step`.
        noise: Called with 1, 2, ..., also in the last step, unless eta = 0.
        times: Those of `denoise`, (N,); None: the log-SNRs.
    """
    times = log_snrs[:-1] if times is None else times
    for j, t in enumerate(times, start=1):
        fresh = noise(j) if eta else None
        z = step(z, denoise(z, t), log_snrs[j - 1], log_snrs[j], eta, fresh)
        yield z


def repaint(
    denoise: _Denoise,
    z: Tensor,
    image: Tensor,
    known: Tensor,
    log_snrs: Tensor,
    noise: Noise,
    repeats: int = 1,
    jump: int = 1,
) -> Iterator[Tensor]:
    """Complete images, (B, ...), by RePaint.

    The part `known`, a mask, is noised to each level, the rest sampled. Each step denoises in
    `jump` parts with resampled known pixels, then returns by forward steps and denoises again,
    `repeats` times in total, to harmonise both parts (Lugmayr et al. 2022, algorithm 1, with
    resampling inside each step). The last step is not repeated. N steps of N jump + 1 rising
    log-SNRs take jump (repeats (N - 1) + 1) evaluations.

    Yields the state after each step, including repetitions; the last is the completed image.
    `noise` is called in each part of a step for the known pixels and for the ancestral step, and
    once per forward step.
    """
    j = count(1)
    for first in range(0, len(log_snrs) - 1, jump):
        levels = log_snrs[first : first + jump + 1]
        last = first + jump == len(log_snrs) - 1
        for repeat in range(1 if last else repeats):
            if repeat:
                for start, end in pairwise(levels.flip(0)):
                    z = _forward_step(z, start, end, noise(next(j)))
            for start, end in pairwise(levels):
                measured = noised(image, end, noise(next(j)))
                z = step(z, denoise(z, start), start, end, 1.0, noise(next(j)))
                z = torch.where(known > 0, measured, z)
            yield z
