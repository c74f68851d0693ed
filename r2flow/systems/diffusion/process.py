"""Diffusion processes: log-SNR schedules, predictions of networks, and steps between noise levels.

A diffusion mixes data x and noise eps, z_t = alpha_t x + sigma_t eps with alpha_t^2 + sigma_t^2 = 1.

Notation and time follow Kingma et al. (2021), "Variational diffusion models": t = 0 is data and t = 1 is noise, the
reverse of a flow. The noise level of z_t, and the time input of networks, is the log-SNR,
lambda_t = ln(alpha_t^2 / sigma_t^2), which decreases with t. Schedules compute in the precision of t.

Noise is passed as a tensor or function, so that samplers are deterministic functions of noise.
"""

import math
from collections.abc import Callable, Iterator
from itertools import count, pairwise
from typing import Annotated

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.registry import Bound, NonNegative, Positive, Registry
from r2flow.samplers.base import Noise

LogSNR = Callable[[Tensor], Tensor]
Steps = Annotated[int, Bound("of at least 2", lambda n: n >= 2)]
Beta = Annotated[float, Bound("in (0, 1)", lambda x: 0 < x < 1)]

FARTHEST = 20  # largest |lambda|: up to it, the float32 tangent has an error of at most 0.005


class Cosine:
    """lambda(t) = -2 ln tan(a + t (b - a)), a = atan e^(-highest / 2), b = atan e^(-lowest / 2).

    alpha_t is the cosine and sigma_t the sine of that angle (Nichol and Dhariwal 2021; Hoogeboom et al. 2023, "Simple
    diffusion", eq. 4, with the ends cut off).
    """

    def __init__(self, lowest: float = -15.0, highest: float = 15.0) -> None:
        if not -FARTHEST <= lowest < highest <= FARTHEST:
            raise InputError(
                f"a log-SNR schedule falls from highest to lowest, both within {FARTHEST} of 0; found {highest:g} and "
                f"{lowest:g}."
            )
        self.start, self.end = (math.atan(math.exp(-end / 2)) for end in (highest, lowest))

    def __call__(self, t: Tensor) -> Tensor:
        return -2 * torch.tan(self.start + t * (self.end - self.start)).log()


class Linear:
    """lambda(t) = -ln(e^(1e-4 + 10 t^2) - 1): beta grows linearly in time (Ho et al. 2020, in continuous time)."""

    def __call__(self, t: Tensor) -> Tensor:
        return -(1e-4 + 10 * t.square()).expm1().log()


class CosineInterpolated(Cosine):
    """lambda(t) = cosine + 2 t ln(noise_d_low / image_d) + 2 (1 - t) ln(noise_d_high / image_d): more noise for larger
    images (Hoogeboom et al. 2023, eq. 6).

    Args:
        image_d: Side of the images.
        noise_d_low: Image side with the same noise under the cosine schedule, towards t = 1.
        noise_d_high: The same towards t = 0.
        options: Options of `Cosine`, before the shift.
    """

    def __init__(self, image_d: Positive, noise_d_low: Positive, noise_d_high: Positive, **options: float) -> None:
        super().__init__(**options)
        self.low, self.high = (2 * math.log(noise_d / image_d) for noise_d in (noise_d_low, noise_d_high))

    def __call__(self, t: Tensor) -> Tensor:
        return super().__call__(t) + t * self.low + (1 - t) * self.high


class CosineShifted(CosineInterpolated):
    """The same shift at all times (Hoogeboom et al. 2023, eq. 5)."""

    def __init__(self, image_d: Positive, noise_d: Positive, lowest: float = -15.0, highest: float = 15.0) -> None:
        super().__init__(image_d, noise_d, noise_d, lowest=lowest, highest=highest)


def of_steps(beta: Tensor) -> Tensor:
    """lambda_t at t = 0 .. N - 1, (N,), where beta_t, (N,), is the share of variance that step t replaces by noise.

    alpha_t^2 is the product of 1 - beta up to step t (Ho et al. 2020).
    """
    return torch.logit((1 - beta).cumprod(0))


def square_root_linear(first: Beta = 0.0015, last: Beta = 0.0195, steps: Steps = 1000) -> Tensor:
    """lambda_t, (N,), of beta_t with evenly spaced square roots, as in LiDM (Ran et al. 2024)."""
    return of_steps(torch.linspace(first**0.5, last**0.5, steps, dtype=torch.float64) ** 2)


def linear_steps(steps: Annotated[int, Bound("above 20", lambda n: n > 20)] = 1000) -> Tensor:
    """lambda_t, (N,), of beta_t evenly from 0.1 / N to 20 / N: 0.0001 to 0.02 in 1,000 steps (Ho et al. 2020)."""
    return of_steps(torch.linspace(0.1 / steps, 20 / steps, steps, dtype=torch.float64))


def cosine_steps(steps: Steps = 1000, offset: NonNegative = 0.008) -> Tensor:
    """lambda_t, (N,), of alpha_t ~ cos(pi / 2 (t / N + offset) / (1 + offset)) (Nichol and Dhariwal 2021, eq. 17)."""
    t = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    return _of_signal(torch.cos((t + offset) / (1 + offset) * math.pi / 2).square())


def sigmoid_steps(steps: Steps = 1000, start: float = -3.0, end: float = 3.0) -> Tensor:
    """lambda_t, (N,), of alpha_t^2 ~ sigmoid(end) - sigmoid(start + (end - start) t / N), 1 at t = 0.

    From Jabri et al. 2022, "Scalable adaptive computation for iterative generation".
    """
    t = torch.linspace(start, end, steps + 1, dtype=torch.float64)
    return _of_signal(torch.tensor(end, dtype=torch.float32).sigmoid() - t.sigmoid())  # rounded as published


def _of_signal(alpha_squared: Tensor) -> Tensor:
    """lambda_t, (N,) float64, of steps between alpha^2 given up to a factor, (N + 1,), with beta_t in [0, 0.999]."""
    return of_steps((1 - alpha_squared[1:] / alpha_squared[:-1]).clamp(0, 0.999))


SCHEDULES: Registry[Callable[..., LogSNR]] = Registry(
    "log-SNR schedule",
    cosine=Cosine,
    linear=Linear,
    cosine_shifted=CosineShifted,
    cosine_interpolated=CosineInterpolated,
)
DISCRETE: Registry[Callable[..., Tensor]] = Registry(
    "schedule of steps",
    square_root_linear=square_root_linear,
    linear=linear_steps,
    cosine=cosine_steps,
    sigmoid=sigmoid_steps,
)


def alpha_sigma(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha = sqrt(sigmoid(lambda)) and sigma = sqrt(sigmoid(-lambda)), in the shape of lambda."""
    return log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()


def for_images(log_snr: Tensor, z: Tensor) -> Tensor:
    """Reshape and cast lambda, () or (B,), to broadcast with z, (B, ...)."""
    return expand_time(log_snr.to(z), z)


class Prediction:
    """A prediction y = p x + q eps, which with z = alpha x + sigma eps determines x and eps.

        x = (sigma y - q z) / d,    eps = (p z - alpha y) / d,    d = p sigma - q alpha

    Its error is |p - q alpha / sigma| times that of x. `coefficients` are p and q from alpha and sigma.
    """

    def __init__(self, coefficients: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]) -> None:
        self.coefficients = coefficients

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

        The loss of y is then min(SNR, gamma) times that of x for any prediction (Hang et al. 2023, "Efficient diffusion
        training via min-SNR weighting strategy"). gamma is `min_snr`; None: the SNR itself.
        """
        alpha, sigma = alpha_sigma(log_snr)
        p, q = self.coefficients(alpha, sigma)
        snr = log_snr.exp()
        weight = snr if min_snr is None else snr.clamp(max=min_snr)
        return weight / (p - q * alpha / sigma).square()


PREDICTIONS: Registry[Prediction] = Registry(
    "prediction",
    eps=Prediction(lambda alpha, sigma: (torch.zeros_like(alpha), torch.ones_like(alpha))),
    v=Prediction(lambda alpha, sigma: (-sigma, alpha)),  # Salimans and Ho 2022, appendix D
    x=Prediction(lambda alpha, sigma: (torch.ones_like(alpha), torch.zeros_like(alpha))),
)

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
