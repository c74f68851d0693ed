"""LiDARGen's generator: scores at decreasing noise levels, and annealed Langevin dynamics.

Song and Ermon 2019, "Generative modeling by estimating gradients of the data distribution", and 2020, "Improved
techniques for training score-based generative models". The score s(x, i) is the gradient by x of the log density of
data plus noise of standard deviation sigma_i.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.backbones.layers import halved
from r2flow.errors import check
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import IMAGE, KNOWN, Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.registry import Count, Positive, Registry
from r2flow.samplers.base import Call, Fresh, Generated, Given, Sampler, last_of
from r2flow.systems.score.refinenet import RefineNet

Score = Callable[[Tensor, Tensor], Tensor]
"""s(x, i): maps images (B, C, H, W) and their noise-level indices, (B,) int64, to (B, C, H, W)."""

SPACINGS: Registry[Callable[[float, float, int], np.ndarray]] = Registry(
    "spacing of noise levels", geometric=np.geomspace, uniform=np.linspace
)


def noise_levels(first: float, last: float, levels: int, spacing: str = "geometric") -> Tensor:
    """sigma_0 = first > ... > sigma_{L-1} = last, (levels,) float32."""
    check(last <= first, f"noise levels fall from {first:g} and cannot reach {last:g}.")
    return torch.from_numpy(SPACINGS[spacing](first, last, levels).astype(np.float32))


def step_sizes(sigmas: Tensor, rate: float) -> Tensor:
    """e_i = rate (sigma_i / sigma_{L-1})^2, (L,), which gives each level the same signal-to-noise ratio per step."""
    return rate * (sigmas / sigmas[-1]).square()


def score_loss(score: Score, x: Tensor, noise: Tensor, labels: Tensor, sigmas: Tensor, power: float = 2.0) -> Tensor:
    """Denoising score matching, sigma^power / 2 |s(x + sigma n, i) + n / sigma|^2 of each image, (B,).

    Power 2 weights all levels equally (2019, eq. 6). Noise n is standard normal, labels i are (B,) int64.
    """
    sigma = sigmas[labels][:, None, None, None]
    return (score(x + sigma * noise, labels) + noise / sigma).square().flatten(1).sum(1) * sigmas[labels] ** power / 2


def annealed_langevin(
    score: Score,
    x: Tensor,
    sigmas: Tensor,
    noise: Callable[[int], Tensor],
    rate: float = 6.2e-6,
    steps: int = 5,
    pull: Callable[[Tensor], Tensor] = torch.zeros_like,
) -> Iterator[Tensor]:
    """Yield the states of annealed Langevin dynamics (2019, algorithm 1) after each evaluation of the score.

    `steps` times at each level i, from the first to the last: x <- x + e_i s(x, i) + sqrt(2 e_i) z with e_i of
    `step_sizes` and z = noise(k), k = 1, 2, ... counted over all levels. A last step removes the remaining noise (2020,
    section 3.3): x <- x + sigma_{L-1}^2 s(x, L-1).

    `pull`, the likelihood gradient as a function of the state before a step, is added in every step. As in LiDARGen,
    the last denoising adds the previous pull again, and the final state is pulled once more.
    """
    number = 0
    for level, size in enumerate(step_sizes(sigmas, rate).tolist()):
        labels = torch.full((len(x),), level, device=x.device)
        for _ in range(steps):
            number += 1
            pulled = pull(x)
            x = x + size * score(x, labels) + math.sqrt(2 * size) * noise(number) + pulled
            yield x
    x = x + sigmas[-1].square() * score(x, labels) + pulled
    yield x + pull(x)


class ScoreModel(Generator):
    """Annealed Langevin dynamics by a learned score (Zyrianov et al. 2022, "Learning to generate realistic LiDAR point
    clouds").

    Images are in [0, 1]; the initial uniform noise is the normal distribution function of Gaussian noise. A sampler's
    `steps` are per noise level. A condition pulls the scan to the known rays: densification.

    Args:
        rate: Rate of `step_sizes`.
        pull: Strength of the pull to known pixels per step; 1 as in the published densification.
        width: Width of the network, see `RefineNet`.
        sigma_first, sigma_last, levels, spacing: The noise levels, see `noise_levels`.
    """

    told = True

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any],
        rate: Positive = 6.2e-6,
        pull: Positive = 1.0,
        width: Count = 128,
        sigma_first: Positive = 50.0,
        sigma_last: Positive = 0.01,
        levels: Count = 232,
        spacing: str = "geometric",
    ) -> None:
        super().__init__(space)
        self.run_by(Langevin())
        self.rate, self.pull = rate, pull
        channels, rows, columns = space.shape
        halved("RefineNet", (rows, columns), 1, least=4)
        self.network = RefineNet(noise_levels(sigma_first, sigma_last, levels, spacing), channels, width)


@dataclass(frozen=True)
class Langevin(Sampler):
    """Annealed Langevin dynamics; a condition pulls the scan to the known rays."""

    draws: ClassVar[bool] = True
    paired: ClassVar[bool] = False
    needs: ClassVar[str] = "pull"

    steps: Count = 5  # at each noise level

    def evaluations(self, generator: Any) -> int:
        return len(generator.network.sigmas) * self.steps + 1

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        x = torch.special.ndtr(noise)
        image, known = (condition[name].to(x) if condition else torch.zeros_like(x) for name in (IMAGE, KNOWN))

        def pull(x: Tensor) -> Tensor:
            """Likelihood gradient of the known pixels (Zyrianov et al. 2022, eq. 8)."""
            return generator.pull * known * ((image + 1) / 2 - x)

        assert draws is not None
        network = generator.network
        states = annealed_langevin(network, x, network.sigmas, draws, generator.rate, self.steps, pull)
        x = last_of(states, progress)
        return Generated.after(2 * x.clamp(0, 1) - 1, self.evaluations(generator), finite(x))
