"""Log-SNR schedules as functions of t in [0, 1], from data at t = 0 to noise at t = 1.

Schedules compute in the precision of t.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.registry import Positive, Registry

LogSNR = Callable[[Tensor], Tensor]

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


def square_root_linear(first: float, last: float, steps: int) -> Tensor:
    """lambda_t at t = 0 .. steps - 1, (steps,) float64, of beta_t with evenly spaced square roots, as in LiDM.

    beta_t is the share of variance that step t replaces by noise; alpha_t^2 is the product of 1 - beta.
    """
    beta = torch.linspace(first**0.5, last**0.5, steps, dtype=torch.float64) ** 2
    return torch.logit((1 - beta).cumprod(0))


SCHEDULES: Registry[Callable[..., LogSNR]] = Registry(
    "log-SNR schedule",
    cosine=Cosine,
    linear=Linear,
    cosine_shifted=CosineShifted,
    cosine_interpolated=CosineInterpolated,
)


def alpha_sigma(log_snr: Tensor) -> tuple[Tensor, Tensor]:
    """alpha = sqrt(sigmoid(lambda)) and sigma = sqrt(sigmoid(-lambda)), in the shape of lambda."""
    return log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()


def for_images(log_snr: Tensor, z: Tensor) -> Tensor:
    """Reshape and cast lambda, () or (B,), to broadcast with z, (B, ...)."""
    return expand_time(log_snr.to(z), z)


def straight_time(log_snr: Tensor) -> Tensor:
    """alpha / (alpha + sigma) = sigmoid(lambda / 2): the time of a straight line from noise to data with equal log-SNR.

    z_t = (alpha + sigma) [s x + (1 - s) eps] with this s, so a diffusion's states, rescaled, are those of a flow.
    """
    return torch.sigmoid(log_snr / 2)


def log_snr_of(s: Tensor) -> Tensor:
    """2 ln(s / (1 - s)): lambda of the straight line's time s, the inverse of `straight_time`."""
    return 2 * torch.logit(s)
