"""Generators that follow a score down a ladder of noise levels: LiDARGen."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import Condition, Generated, Generator, Progress, Sampler, parts_of
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import Count, Positive
from r2flow.systems.score.langevin import annealed_langevin, noise_levels, toward
from r2flow.systems.score.refinenet import RefineNet

LANGEVIN = "langevin"


class ScoreModel(Generator):
    """Annealed Langevin dynamics by a learned score (Zyrianov et al. 2022, "Learning to generate realistic LiDAR point
    clouds").

    It works in [0, 1] and starts from uniform noise, which is made of ours by the normal distribution function. Its
    sampler's `steps` are those at each noise level. A condition pulls the scan to what is known: densification.

    Args:
        space: The images it makes.
        backbone: Not used: the network is a `RefineNet`.
        rate: Of `r2flow.systems.score.langevin.step_sizes`.
        denoise: Whether the last level's noise is taken off at the end.
        pull: Strength of the pull to known pixels, a step.
        width: The network's, see `RefineNet`.
        sigma_first, sigma_last, levels, spacing: The noise levels, see `r2flow.systems.score.langevin.noise_levels`.

    Raises:
        InputError: an odd height or width, noise levels that rise, an unknown spacing.
    """

    told = True

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any],
        rate: Positive = 6.2e-6,
        denoise: bool = True,
        pull: Positive = 0.1,
        width: Count = 128,
        sigma_first: Positive = 50.0,
        sigma_last: Positive = 0.01,
        levels: Count = 232,
        spacing: str = "geometric",
    ) -> None:
        super().__init__(space)
        self.sampler = Sampler(LANGEVIN, 5)
        self.rate, self.denoise, self.pull = rate, denoise, pull
        channels, rows, columns = space.shape
        if rows % 2 or columns % 2:
            raise InputError(f"RefineNet halves the image: its height and width must be even, found {rows}x{columns}.")
        self.network = RefineNet(noise_levels(sigma_first, sigma_last, levels, spacing), channels, width)

    @torch.no_grad()
    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        if draws is None:
            raise InputError("annealed Langevin dynamics draws noise in every step: give draws.")
        how = sampler or self.sampler
        x = torch.special.ndtr(noise.to(self.device))

        def fresh(step: int) -> Tensor:
            return draws.step(self.noise_shape, step).to(x)

        pull = self._pulled(condition, x)
        steps = annealed_langevin(
            self.network, x, self.network.sigmas, fresh, self.rate, how.steps, self.denoise, pull
        )  # fmt: skip
        for end in steps:
            x = end
            if progress is not None:
                progress()
        return Generated.after(2 * x.clamp(0, 1) - 1, self.evaluations_of(how), finite(x))

    def _pulled(self, condition: Condition | None, x: Tensor) -> Callable[[Tensor], Tensor] | None:
        if condition is None:
            return None
        image, known = parts_of(condition, x)
        return toward((image + 1) / 2, known, self.pull)

    def check_sampler(self, sampler: Sampler) -> None:
        plain = Sampler(LANGEVIN, sampler.steps)
        if sampler != plain:
            raise InputError(
                f"a score model is sampled by {LANGEVIN}, in steps at each noise level and without other settings; "
                f"found {sampler.unlike(plain)}."
            )

    def evaluations_of(self, sampler: Sampler) -> int:
        return len(self.network.sigmas) * sampler.steps + int(self.denoise)
