"""Diffusions of N steps: beta_n by name, and what follows from it.

z_n = sqrt(1 - beta_n) z_{n-1} + sqrt(beta_n) eps, so that alpha_bar_n = prod_{i <= n} (1 - beta_i) is the share of the
data in the variance of z_n (Ho et al. 2020, "Denoising diffusion probabilistic models").
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.registry import Registry

Betas = Callable[[int], Tensor]
LARGEST = 0.999  # beta, in the two schedules that say alpha_bar


def linear(steps: int) -> Tensor:
    """beta from 0.1 / N to 20 / N in equal steps: 1e-4 to 0.02 for N = 1000 (Ho et al. 2020, section 4)."""
    return torch.linspace(0.1 / steps, 20 / steps, steps, dtype=torch.float64)


def cosine(steps: int) -> Tensor:
    """alpha_bar proportional to cos^2(pi / 2 (n / N + 0.008) / 1.008) (Nichol and Dhariwal 2021, eq. 17)."""
    return _from_signal(torch.cos((_times(steps) + 0.008) / 1.008 * (math.pi / 2)).square())


def sigmoid(steps: int) -> Tensor:
    """alpha_bar proportional to sigmoid(3 - 6 n / N) - sigmoid(-3) (Jabri et al. 2022, algorithm 1)."""
    lowest = 1 / (1 + math.exp(3))
    return _from_signal(torch.sigmoid(3 - 6 * _times(steps)) - lowest)


BETAS: Registry[Betas] = Registry("schedule of steps", linear=linear, cosine=cosine, sigmoid=sigmoid)


class Steps(NamedTuple):
    """The tables of a diffusion of N steps, (N,) float64 each.

    Attributes:
        beta: Share of the variance that each step replaces by noise.
        alpha_bar: Share of the data after each step.
        alpha_bar_prev: Share of the data before it.
        snr: alpha_bar / (1 - alpha_bar).
    """

    beta: Tensor
    alpha_bar: Tensor
    alpha_bar_prev: Tensor
    snr: Tensor


def tables(beta: Tensor) -> Steps:
    """What follows from beta, (N,)."""
    alpha_bar = (1 - beta).cumprod(0)
    before = torch.cat([torch.ones_like(beta[:1]), alpha_bar[:-1]])
    return Steps(beta, alpha_bar, before, alpha_bar / (1 - alpha_bar))


def _times(steps: int) -> Tensor:
    return torch.arange(steps + 1, dtype=torch.float64) / steps


def _from_signal(signal: Tensor) -> Tensor:
    return (1 - signal[1:] / signal[:-1]).clamp(0, LARGEST)
