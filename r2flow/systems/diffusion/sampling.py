"""Sampling of diffusions: ancestral steps (DDPM), DDIM and interpolations of both, and RePaint.

Noise is passed as a tensor or function, so that samplers are deterministic functions of noise.
"""

from collections.abc import Callable, Iterator
from itertools import count, pairwise

import torch
from torch import Tensor

from r2flow.samplers.base import Noise
from r2flow.systems.diffusion.log_snr import alpha_sigma, for_images

Denoise = Callable[[Tensor, Tensor], Tensor]  # expected data given (z, log-SNR), the latter of shape ()


def noised(x: Tensor, log_snr: Tensor, eps: Tensor) -> Tensor:
    """z = alpha x + sigma eps, (B, ...), at log-SNRs () or (B,)."""
    alpha, sigma = alpha_sigma(for_images(log_snr, x))
    return alpha * x + sigma * eps


def step(z: Tensor, x: Tensor, log_snr: Tensor, next_log_snr: Tensor, eta: float, noise: Tensor | None) -> Tensor:
    """z_s from z_t and expected data x, s < t:

        z_s = alpha_s x + sigma_s [sqrt(1 - eta^2 c) eps + eta sqrt(c) noise]

    with eps = (z_t - alpha_t x) / sigma_t and c = 1 - e^(lambda_t - lambda_s), the share of new noise. eta = 1 is
    DDPM's ancestral step, eta = 0 is DDIM (Song et al. 2021, "Denoising diffusion implicit models", eq. 12 and 16).
    In log-SNRs lambda, () or (B,), no digits are lost for alpha near 1. Without noise eta must be 0.
    """
    lambda_t, lambda_s = for_images(log_snr, z), for_images(next_log_snr, z)
    (alpha, sigma), (next_alpha, next_sigma) = alpha_sigma(lambda_t), alpha_sigma(lambda_s)
    c = -torch.expm1(lambda_t - lambda_s)
    z_s = next_alpha * x + next_sigma * (1 - eta**2 * c).sqrt() * ((z - alpha * x) / sigma)
    return z_s if noise is None else z_s + next_sigma * eta * c.sqrt() * noise


def forward_step(z: Tensor, log_snr: Tensor, next_log_snr: Tensor, noise: Tensor) -> Tensor:
    """z_t from z_s, s < t: (alpha_t / alpha_s) z_s + sigma_t sqrt(1 - e^(lambda_t - lambda_s)) noise."""
    lambda_s, lambda_t = for_images(log_snr, z), for_images(next_log_snr, z)
    (alpha, _), (next_alpha, next_sigma) = alpha_sigma(lambda_s), alpha_sigma(lambda_t)
    return next_alpha / alpha * z + next_sigma * (-torch.expm1(lambda_t - lambda_s)).sqrt() * noise


def walk(
    denoise: Denoise, z: Tensor, log_snrs: Tensor, eta: float, noise: Noise | None, times: Tensor | None = None
) -> Iterator[Tensor]:
    """Yield the states from noise z, (B, ...), to data, after each of N steps between rising log-SNRs, (N + 1,).

    `eta`: see `step`. `noise` is called with 1, 2, ..., also in the last step; None if eta = 0. `times` are those of
    `denoise`, (N,); None: the log-SNRs.
    """
    times = log_snrs if times is None else times
    for j, (t, (start, end)) in enumerate(zip(times, pairwise(log_snrs), strict=False), start=1):
        z = step(z, denoise(z, t), start, end, eta, noise(j) if eta and noise else None)
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
    """Complete images, (B, ...), by RePaint: the part `known`, a mask, is noised to each level, the rest sampled.

    Each step denoises in `jump` parts with resampled known pixels, then returns by forward steps and denoises again,
    `repeats` times in total, to harmonise both parts (Lugmayr et al. 2022, algorithm 1, with resampling inside each
    step). The last step is not repeated. N steps of N jump + 1 rising log-SNRs take jump (repeats (N - 1) + 1)
    evaluations.

    Yields the state after each step, including repetitions; the last is the completed image. `noise` is called in each
    part of a step for the known pixels and for the ancestral step, and once per forward step.
    """
    j = count(1)
    for first in range(0, len(log_snrs) - 1, jump):
        levels = log_snrs[first : first + jump + 1]
        last = first + jump == len(log_snrs) - 1
        for repeat in range(1 if last else repeats):
            if repeat:
                for start, end in pairwise(levels.flip(0)):
                    z = forward_step(z, start, end, noise(next(j)))
            for start, end in pairwise(levels):
                measured = noised(image, end, noise(next(j)))
                z = torch.where(known > 0, measured, step(z, denoise(z, start), start, end, 1.0, noise(next(j))))
            yield z
