"""Log-SNR schedules of diffusions, in continuous time and in steps.

For notation and time see `r2flow.systems.diffusion.process`. Schedules compute in the precision of
t.
"""

import math
from typing import Annotated

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Bound, NonNegative, Positive, Registry

_Steps = Annotated[int, Bound("at least 2", lambda n: n >= 2)]
_Beta = Annotated[float, Bound("in (0, 1)", lambda x: 0 < x < 1)]

_FARTHEST = 20  # largest |lambda|: up to it, the float32 tangent has an error of at most 0.005


class _Cosine:
    """lambda(t) = -2 ln tan(a + t (b - a)), a = atan e^(-highest / 2), b = atan e^(-lowest / 2).

    alpha_t is the cosine and sigma_t the sine of that angle (Nichol and Dhariwal 2021; Hoogeboom et
    al. 2023, "Simple diffusion", eq. 4, with the ends cut off).
    """

    def __init__(self, lowest: float = -15.0, highest: float = 15.0) -> None:
        if not -_FARTHEST <= lowest < highest <= _FARTHEST:
            raise InputError(
                f"a log-SNR schedule falls from highest to lowest, both within {_FARTHEST} of 0; "
                f"found {highest:g} and {lowest:g}."
            )
        self.start = math.atan(math.exp(-highest / 2))
        self.end = math.atan(math.exp(-lowest / 2))

    def __call__(self, t: Tensor) -> Tensor:
        return -2 * torch.tan(self.start + t * (self.end - self.start)).log()


class _Linear:
    """lambda(t) = -ln(e^(1e-4 + 10 t^2) - 1): beta grows linearly (Ho et al. 2020, continuous)."""

    def __call__(self, t: Tensor) -> Tensor:
        return -(1e-4 + 10 * t.square()).expm1().log()


class _CosineInterpolated(_Cosine):
    """lambda(t) = cosine + 2 t ln(noise_d_low / image_d) + 2 (1 - t) ln(noise_d_high / image_d).

    More noise for larger images (Hoogeboom et al. 2023, eq. 6).

    Args:
        image_d: Side of the images.
        noise_d_low: Image side with the same noise under the cosine schedule, towards t = 1.
        noise_d_high: The same towards t = 0.
        options: Options of `_Cosine`, before the shift.
    """

    def __init__(
        self, image_d: Positive, noise_d_low: Positive, noise_d_high: Positive, **options: float
    ) -> None:
        super().__init__(**options)
        self.low = 2 * math.log(noise_d_low / image_d)
        self.high = 2 * math.log(noise_d_high / image_d)

    def __call__(self, t: Tensor) -> Tensor:
        return super().__call__(t) + t * self.low + (1 - t) * self.high


class _CosineShifted(_CosineInterpolated):
    """The same shift at all times (Hoogeboom et al. 2023, eq. 5)."""

    def __init__(
        self, image_d: Positive, noise_d: Positive, lowest: float = -15.0, highest: float = 15.0
    ) -> None:
        super().__init__(image_d, noise_d, noise_d, lowest=lowest, highest=highest)


def _of_steps(beta: Tensor) -> Tensor:
    """lambda_t at t = 0 .. N - 1, (N,), of beta_t, (N,), the share of noise in step t's variance.

    alpha_t^2 is the product of 1 - beta up to step t (Ho et al. 2020).
    """
    return torch.logit((1 - beta).cumprod(0))


def square_root_linear(first: _Beta = 0.0015, last: _Beta = 0.0195, steps: _Steps = 1000) -> Tensor:
    """lambda_t, (N,), of beta_t with evenly spaced square roots, as in LiDM (Ran et al. 2024)."""
    return _of_steps(torch.linspace(first**0.5, last**0.5, steps, dtype=torch.float64) ** 2)


def _linear_steps(steps: Annotated[int, Bound("above 20", lambda n: n > 20)] = 1000) -> Tensor:
    """lambda_t, (N,), of beta_t evenly from 0.1 / N to 20 / N (Ho et al. 2020 for N = 1,000)."""
    return _of_steps(torch.linspace(0.1 / steps, 20 / steps, steps, dtype=torch.float64))


def _cosine_steps(steps: _Steps = 1000, offset: NonNegative = 0.008) -> Tensor:
    """lambda_t, (N,), of alpha_t ~ cos(pi / 2 (t / N + offset) / (1 + offset)).

    Nichol and Dhariwal 2021, eq. 17.
    """
    t = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    return _of_signal(torch.cos((t + offset) / (1 + offset) * math.pi / 2).square())


def _sigmoid_steps(steps: _Steps = 1000, start: float = -3.0, end: float = 3.0) -> Tensor:
    """lambda_t, (N,), of alpha_t^2 ~ sigmoid(end) - sigmoid(start + (end - start) t / N), 1 at t =
    0.

    From Jabri et al. 2022, "Scalable adaptive computation for iterative generation".
    """
    t = torch.linspace(start, end, steps + 1, dtype=torch.float64)
    # Rounded as published.
    return _of_signal(torch.tensor(end, dtype=torch.float32).sigmoid() - t.sigmoid())


def _of_signal(alpha_squared: Tensor) -> Tensor:
    """lambda_t, (N,), of steps between alpha^2 up to a factor, (N + 1,); beta_t in [0, 0.999]."""
    return _of_steps((1 - alpha_squared[1:] / alpha_squared[:-1]).clamp(0, 0.999))


SCHEDULES = Registry(
    "log-SNR schedule",
    cosine=_Cosine,
    linear=_Linear,
    cosine_shifted=_CosineShifted,
    cosine_interpolated=_CosineInterpolated,
)
DISCRETE = Registry(
    "schedule of steps",
    square_root_linear=square_root_linear,
    linear=_linear_steps,
    cosine=_cosine_steps,
    sigmoid=_sigmoid_steps,
)
