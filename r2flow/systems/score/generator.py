"""Score-based generators: LiDARGen."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.backbones.layers import halved
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import Generator, parts_of
from r2flow.lidar.space import ModelSpace
from r2flow.registry import Count, Positive
from r2flow.samplers.base import Call, Fresh, Generated, Given, Sampler, last_of
from r2flow.systems.score.langevin import annealed_langevin, noise_levels
from r2flow.systems.score.refinenet import RefineNet


class ScoreModel(Generator):
    """Annealed Langevin dynamics by a learned score (Zyrianov et al. 2022, "Learning to generate realistic LiDAR point
    clouds").

    Images are in [0, 1]; the initial uniform noise is the normal distribution function of Gaussian noise. A sampler's
    `steps` are per noise level. A condition pulls the scan to the known rays: densification.

    Args:
        rate: Rate of `r2flow.systems.score.langevin.step_sizes`.
        pull: Strength of the pull to known pixels per step.
        width: Width of the network, see `RefineNet`.
        sigma_first, sigma_last, levels, spacing: The noise levels, see `r2flow.systems.score.langevin.noise_levels`.
    """

    told = True

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any],
        rate: Positive = 6.2e-6,
        pull: Positive = 0.1,
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
        halved("RefineNet", (rows, columns), 1)
        self.network = RefineNet(noise_levels(sigma_first, sigma_last, levels, spacing), channels, width)


@dataclass(frozen=True)
class Langevin(Sampler):
    """Annealed Langevin dynamics; a condition pulls the scan to the known rays.

    Attributes:
        steps: Steps at each noise level.
    """

    draws: ClassVar[bool] = True
    paired: ClassVar[bool] = False
    needs: ClassVar[str] = "pull"

    steps: Count = 5

    def evaluations(self, generator: Any) -> int:
        return len(generator.network.sigmas) * self.steps + 1

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        x = torch.special.ndtr(noise)
        image, known = parts_of(condition, x)

        def pull(x: Tensor) -> Tensor:
            """Likelihood gradient of the known pixels (Zyrianov et al. 2022, eq. 8)."""
            return generator.pull * known * ((image + 1) / 2 - x)

        assert draws is not None
        network = generator.network
        states = annealed_langevin(network, x, network.sigmas, draws, generator.rate, self.steps, pull)
        x = last_of(states, progress)
        return Generated.after(2 * x.clamp(0, 1) - 1, self.evaluations(generator), finite(x))
