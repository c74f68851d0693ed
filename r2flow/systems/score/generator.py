"""LiDARGen's generator: scores at decreasing noise levels, and annealed Langevin dynamics.

Song and Ermon 2019, "Generative modeling by estimating gradients of the data distribution", and
2020, "Improved techniques for training score-based generative models". The score s(x, i) is the
gradient by x of the log density of data plus noise of standard deviation sigma_i.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from r2flow.backbones.layers import halved
from r2flow.base.errors import InputError
from r2flow.base.registry import Count, Options, Positive
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import IMAGE, KNOWN, Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers.base import Generated, Known, Noise, Sampler, Tick, last_of
from r2flow.systems.score.refinenet import RefineNet

_Score = Callable[[Tensor, Tensor], Tensor]
"""s(x, i): images (B, C, H, W) and their noise-level indices, (B,) int64, to (B, C, H, W)."""

_Spacing = Literal["geometric", "uniform"]


def _noise_levels(
    first: float, last: float, levels: int, spacing: _Spacing = "geometric"
) -> Tensor:
    """sigma_0 = first > ... > sigma_{L-1} = last, (levels,) float32."""
    if last > first:
        raise InputError(f"noise levels fall from {first:g} and cannot reach {last:g}.")
    space = np.geomspace if spacing == "geometric" else np.linspace
    return torch.from_numpy(space(first, last, levels).astype(np.float32))


def _step_sizes(sigmas: Tensor, rate: float) -> Tensor:
    """e_i = rate (sigma_i / sigma_{L-1})^2, (L,): equal signal-to-noise ratios per step."""
    return rate * (sigmas / sigmas[-1]).square()


def score_loss(
    score: _Score, x: Tensor, noise: Tensor, labels: Tensor, sigmas: Tensor, power: float = 2.0
) -> Tensor:
    """Denoising score matching, sigma^power / 2 |s(x + sigma n, i) + n / sigma|^2, (B,).

    Power 2 weights all levels equally (2019, eq. 6). Noise n is standard normal, labels i are (B,)
    int64.
    """
    sigma = sigmas[labels][:, None, None, None]
    error = score(x + sigma * noise, labels) + noise / sigma
    return error.square().flatten(1).sum(1) * sigmas[labels] ** power / 2


def _annealed_langevin(
    score: _Score,
    x: Tensor,
    sigmas: Tensor,
    noise: Callable[[int], Tensor],
    rate: float = 6.2e-6,
    steps: int = 5,
    pull: Callable[[Tensor], Tensor] = torch.zeros_like,
) -> Iterator[Tensor]:
    """Yield the states of annealed Langevin dynamics (2019, algorithm 1) after each evaluation.

    `steps` times at each level i, from the first to the last: x <- x + e_i s(x, i) + sqrt(2 e_i) z
    with e_i of `_step_sizes` and z = noise(k), k = 1, 2, ... counted over all levels. A last step
    removes the remaining noise (2020, section 3.3): x <- x + sigma_{L-1}^2 s(x, L-1).

    `pull`, the likelihood gradient as a function of the state before a step, is added in every
    step. As in LiDARGen, the last denoising adds the previous pull again, and the final state is
    pulled once more.
    """
    sizes = _step_sizes(sigmas, rate).tolist()
    for number in range(len(sizes) * steps):
        level = number // steps
        labels = torch.full((len(x),), level, device=x.device)
        pulled = pull(x)
        noised = math.sqrt(2 * sizes[level]) * noise(number + 1)
        x = x + sizes[level] * score(x, labels) + noised + pulled
        yield x
    x = x + sigmas[-1].square() * score(x, labels) + pulled
    yield x + pull(x)


class ScoreModel(Generator):
    """Annealed Langevin dynamics by a learned score.

    Zyrianov et al. 2022, "Learning to generate realistic LiDAR point clouds". Images are in [0, 1];
    the initial uniform noise is the normal distribution function of Gaussian noise. A sampler's
    `steps` are per noise level. A condition pulls the scan to the known rays: densification.

    Args:
        rate: Rate of `_step_sizes`.
        pull: Strength of the pull to known pixels per step; 1 as in the published densification.
        width: Width of the network, see `RefineNet`.
        sigma_first, sigma_last, levels, spacing: The noise levels, see `_noise_levels`.
    """

    takes_condition = True

    def __init__(
        self,
        space: ModelSpace,
        backbone: Options,
        rate: Positive = 6.2e-6,
        pull: Positive = 1.0,
        width: Count = 128,
        sigma_first: Positive = 50.0,
        sigma_last: Positive = 0.01,
        levels: Count = 232,
        spacing: _Spacing = "geometric",
    ) -> None:
        super().__init__(space)
        self.run_by(Langevin())
        self.rate = rate
        self.pull = pull
        channels, *shape = space.shape
        halved("RefineNet", shape, 1, least=4)
        self.network = RefineNet(
            _noise_levels(sigma_first, sigma_last, levels, spacing), channels, width
        )


@dataclass(frozen=True)
class Langevin(Sampler):
    """Annealed Langevin dynamics; a condition pulls the scan to the known rays."""

    draws = True
    paired = False
    needs = "pull"

    steps: Count = 5  # at each noise level

    def evaluations(self, generator: Any) -> int:
        return len(generator.network.sigmas) * self.steps + 1

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        x = torch.special.ndtr(noise)
        image = known = torch.zeros_like(x)
        if condition:
            image = condition[IMAGE].to(x)
            known = condition[KNOWN].to(x)

        def pull(x: Tensor) -> Tensor:
            """Likelihood gradient of the known pixels (Zyrianov et al. 2022, eq. 8)."""
            return generator.pull * known * ((image + 1) / 2 - x)

        network = generator.network
        states = _annealed_langevin(
            network, x, network.sigmas, draws, generator.rate, self.steps, pull
        )
        x = last_of(states, progress)
        return Generated.after(2 * x.clamp(0, 1) - 1, self.evaluations(generator), finite(x))
