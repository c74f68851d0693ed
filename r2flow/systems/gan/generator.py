"""Base class of GANs: x = G(z) in one evaluation, with or without a mask of dropped rays."""

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from r2flow.base.noise import Draws
from r2flow.base.registry import Bound
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.samplers.base import Generated, Known, Noise, Sampler, Tick
from r2flow.systems.gan.layers import LatentGenerator, Outputs


class Gan(Generator):
    """x = G(z) clamped to [-1, 1], with z of N(0, I).

    The sampler is `Direct`, and `network` is G.
    """

    #: Whether a ray-drop mask is sampled: logistic noise of `draws.step(shape, 1)`.
    drops = True
    #: Elevation and azimuth of every pixel, (1, 2, H, W), for networks that use them; training
    #: rotates scans by random angles.
    angle: Tensor | None

    def __init__(self, space: ModelSpace, network: LatentGenerator) -> None:
        super().__init__(space, noise_shape=(network.latent,))
        self.run_by(Direct())
        self.network = network
        self.register_buffer("angle", None)

    def made(self, z: Tensor, uniform: Tensor | None = None, **options: Any) -> Outputs:
        """Outputs of the network, see `LatentGenerator`."""
        return self.network(z, self.angle, uniform=uniform, **options)

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        return draws.step((1, *self.space.shape[1:]), j)


@dataclass(frozen=True)
class Direct(Sampler):
    """One evaluation."""

    needs = "made"

    # psi of w <- w_avg + psi (w - w_avg): smaller values reduce diversity (0.7 in DUSty's demo).
    truncation: Annotated[float, Bound("in (0, 1]", lambda psi: 0 < psi <= 1)] = 1.0

    def evaluations(self, generator: Any) -> int:
        return 1

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        uniform = None
        if generator.drops:
            uniform = torch.special.ndtr(draws(1).double()).to(noise)
        x = generator.made(noise, uniform, truncation=self.truncation)["image"]
        progress()
        return Generated.after(x.clamp(-1, 1), 1, finite(x))
