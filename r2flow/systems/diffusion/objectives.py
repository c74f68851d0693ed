"""Predictions of diffusion networks, and their errors."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.registry import Registry
from r2flow.systems.diffusion.log_snr import alpha_sigma, for_images

Coefficients = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class Prediction:
    """A prediction y = p x + q eps, which with z = alpha x + sigma eps determines x and eps.

        x = (sigma y - q z) / d,    eps = (p z - alpha y) / d,    d = p sigma - q alpha

    Its error is |p - q alpha / sigma| times that of x. `coefficients` are p and q from alpha and sigma.
    """

    def __init__(self, coefficients: Coefficients) -> None:
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

Error = Callable[[Tensor, Tensor], Tensor]  # per element

ERRORS: Registry[Error] = Registry(
    "error of an element",
    l2=lambda y, target: F.mse_loss(y, target, reduction="none"),
    l1=lambda y, target: F.l1_loss(y, target, reduction="none"),
    huber=lambda y, target: F.smooth_l1_loss(y, target, reduction="none"),
)
