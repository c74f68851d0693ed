"""From noise to data step by step: ancestral steps (DDPM), DDIM and everything between, and RePaint.

Noise comes in as a tensor or a function, so that a sampler is a function of it.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from torch import Tensor

from r2flow.systems.diffusion.log_snr import alpha_sigma, for_images

Denoise = Callable[[Tensor, Tensor], Tensor]  # x of (z, log-SNR), the latter of shape ()
Noise = Callable[[], Tensor]  # the next draw of N(0, I), in the shape of z


def noised(x: Tensor, log_snr: Tensor, eps: Tensor) -> Tensor:
    """z = alpha x + sigma eps, (B, ...), at log-SNRs () or (B,)."""
    alpha, sigma = alpha_sigma(for_images(log_snr, x))
    return alpha * x + sigma * eps


def step(z: Tensor, x: Tensor, log_snr: Tensor, next_log_snr: Tensor, eta: float, noise: Tensor | None) -> Tensor:
    """z_s from z_t and the data x that is expected behind it, s < t:

        z_s = alpha_s x + sigma_s [sqrt(1 - eta^2 c) eps + eta sqrt(c) noise]

    with eps = (z_t - alpha_t x) / sigma_t and c = 1 - e^(lambda_t - lambda_s), the share of new noise. eta = 1 is
    DDPM's ancestral step, eta = 0 is DDIM (Song et al. 2021, "Denoising diffusion implicit models", eq. 12 and 16).
    Written by log-SNRs it loses no digits where alpha is near 1.

    Args:
        z: (B, ...).
        x: (B, ...), of `z` and `log_snr`.
        log_snr: lambda_t, () or (B,).
        next_log_snr: lambda_s, above it.
        eta: Share of new noise, 0 to 1.
        noise: N(0, I) in the shape of z; may be None where eta = 0.
    """
    here, there = for_images(log_snr, z), for_images(next_log_snr, z)
    (alpha, sigma), (next_alpha, next_sigma) = alpha_sigma(here), alpha_sigma(there)
    c = -torch.expm1(here - there)
    z_s = next_alpha * x + next_sigma * (1 - eta**2 * c).sqrt() * ((z - alpha * x) / sigma)
    return z_s if noise is None else z_s + next_sigma * eta * c.sqrt() * noise


def forward_step(z: Tensor, log_snr: Tensor, next_log_snr: Tensor, noise: Tensor) -> Tensor:
    """z_t from z_s, s < t: (alpha_t / alpha_s) z_s + sigma_t sqrt(1 - e^(lambda_t - lambda_s)) noise.

    Args:
        log_snr: lambda_s, () or (B,).
        next_log_snr: lambda_t, below it.
    """
    here, there = for_images(log_snr, z), for_images(next_log_snr, z)
    (alpha, _), (next_alpha, next_sigma) = alpha_sigma(here), alpha_sigma(there)
    return next_alpha / alpha * z + next_sigma * (-torch.expm1(there - here)).sqrt() * noise


def walk(denoise: Denoise, z: Tensor, log_snrs: Tensor, eta: float, noise: Noise) -> Iterator[Tensor]:
    """The states from noise to data, one after each step.

    Args:
        denoise: The expected data behind (z, lambda).
        z: Noise, (B, ...).
        log_snrs: Rising, (N + 1,) for N steps.
        eta: See `step`.
        noise: Asked once in each step where eta > 0, in the last one too.
    """
    for here, there in pairwise(log_snrs):
        z = step(z, denoise(z, here), here, there, eta, noise() if eta else None)
        yield z


def repaint(
    denoise: Denoise,
    z: Tensor,
    image: Tensor,
    known: Tensor,
    log_snrs: Tensor,
    noise: Noise,
    repeats: int = 1,
    jump: int = 1,
) -> Iterator[Tensor]:
    """Complete images of which a part is known: that part is noised to each level, the rest is walked (RePaint).

    Each step goes down in `jump` parts, whose known pixels are drawn afresh, then back up by forward steps and down
    again, `repeats` times in all, so that the two parts come to agree (Lugmayr et al. 2022, algorithm 1, with
    resampling inside each step). The last step is taken once. Evaluations: jump (repeats (N - 1) + 1).

    Args:
        denoise: The expected data behind (z, lambda).
        z: Noise, (B, ...).
        image: Data, (B, ...).
        known: Where they are known, bool or 0 and 1.
        log_snrs: Rising, (N jump + 1,) for N steps.
        noise: Asked, in each part of a step, for the known pixels and for the ancestral step, and once in each
            part on the way up.
        repeats: Times that each step is taken.
        jump: Parts of a step.

    Returns:
        The state at the end of each step, repeated ones too; the last is the completed image.
    """
    for first in range(0, len(log_snrs) - 1, jump):
        levels = log_snrs[first : first + jump + 1]
        last = first + jump == len(log_snrs) - 1
        for repeat in range(1 if last else repeats):
            if repeat:
                for here, there in pairwise(levels.flip(0)):
                    z = forward_step(z, here, there, noise())
            for here, there in pairwise(levels):
                seen = noised(image, there, noise())
                z = torch.where(known > 0, seen, step(z, denoise(z, here), here, there, 1.0, noise()))
            yield z
