"""GANs: x = G(z) in one evaluation, with a mask of dropped rays or without."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import Generator
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import Bound, Count, Positive
from r2flow.samplers.base import Condition, Generated, Noise, Progress, Sampler
from r2flow.systems.gan import dcgan, style_gan
from r2flow.systems.gan.layers import LatentGenerator

DROPPED = -1.0  # a dropped ray in model space


class Gan(Generator):
    """x = G(z) clamped to [-1, 1], with z of N(0, I).

    Its sampler is `Direct`.

    Args:
        space: The images it makes.
        build: The network of a shape and a number of channels.

    Attributes:
        network: G.
        drops: Whether a mask of dropped rays is drawn: logistic noise of `draws.step(shape, 1)`.
        turns: Whether the scan is turned by a random angle in training.
    """

    turns: ClassVar[bool] = False

    def __init__(self, space: ModelSpace, build: Callable[[tuple[int, int], int], LatentGenerator]) -> None:
        channels, h, w = space.shape
        network = build((h, w), channels)
        super().__init__(space, noise_shape=(network.latent,))
        self.run_by(Direct())
        self.network = network

    @property
    def drops(self) -> bool:
        return self.network.measurement_model is not None

    def made(
        self, z: Tensor, uniform: Tensor | None = None, shift: Tensor | None = None, truncation: float = 1.0
    ) -> dict[str, Tensor]:
        """The network's outputs, see `LatentGenerator`."""
        made: dict[str, Tensor] = self.network(z, truncation=truncation, uniform=uniform)
        return made

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        return draws.step((1, *self.space.shape[1:]), j)


@dataclass(frozen=True)
class Direct(Sampler):
    """One evaluation.

    Attributes:
        truncation: psi of w <- w_avg + psi (w - w_avg): less makes plainer scans that are closer to each other (0.7 in
            DUSty's published demo).
    """

    needs: ClassVar[str] = "made"

    truncation: Annotated[float, Bound("in (0, 1]", lambda psi: 0 < psi <= 1)] = 1.0

    def evaluations(self, generator: Any) -> int:
        return 1

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        uniform = None
        if generator.drops:
            if draws is None:
                raise InputError(f"a {type(generator).__name__} draws a mask: give draws.")
            uniform = torch.special.ndtr(draws(1).double()).to(noise)
        x = generator.made(noise, uniform, truncation=self.truncation)["image"]
        if progress is not None:
            progress()
        return Generated.after(x.clamp(-1, 1), 1, finite(x))


class VanillaGan(Gan):
    """A convolutional GAN whose image says itself which rays are dropped: `r2flow.systems.gan.dcgan`.

    Args:
        space: The images it makes.
        backbone: Not used; the network is of its own kind.
        latent: Width of z.
        base_channels: Width of the outermost map; it doubles inwards.
        max_channels: Widest.
        doublings: From the first map to the image.
        tanh: Whether the image ends in tanh.
        ring: Whether the columns are a full turn.
    """

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any] | None = None,
        latent: Count = 512,
        base_channels: Count = 64,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = False,
        ring: bool = True,
    ) -> None:
        def build(shape: tuple[int, int], channels: int) -> LatentGenerator:
            widths = (latent, base_channels, max_channels, doublings)
            return dcgan.Generator(shape, channels, False, *widths, tanh, ring)

        super().__init__(space, build)


class DustyV1(Gan):
    """The same with a second output, from which a mask of the rays that return is drawn (Nakashima and Kurazume 2021).

    Args:
        temperature: Of the relaxed mask.

    See `VanillaGan` for the others.
    """

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any] | None = None,
        latent: Count = 512,
        base_channels: Count = 64,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = False,
        ring: bool = True,
        temperature: Positive = 1.0,
    ) -> None:
        def build(shape: tuple[int, int], channels: int) -> LatentGenerator:
            widths = (latent, base_channels, max_channels, doublings)
            return dcgan.Generator(shape, channels, True, *widths, tanh, ring, DROPPED, temperature)

        super().__init__(space, build)


class DustyV2(Gan):
    """A style-based GAN that makes each pixel of its ray's angles: `r2flow.systems.gan.style_gan`.

    Args:
        code: Width of w; null for `latent`.
        depth: Layers from z to w.
        temperature: Of the relaxed mask.

    See `VanillaGan` for the others.
    """

    turns = True
    angle: Tensor

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any] | None = None,
        latent: Count = 512,
        code: Count | None = None,
        depth: Count = 2,
        base_channels: Count = 32,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = True,
        ring: bool = True,
        temperature: Positive = 1.0,
    ) -> None:
        def build(shape: tuple[int, int], channels: int) -> LatentGenerator:
            widths = (latent, code, depth, base_channels, max_channels, doublings)
            return style_gan.Generator(shape, channels, *widths, tanh, ring, DROPPED, temperature)

        super().__init__(space, build)
        self.register_buffer("angle", space.rays[None].clone())

    def made(
        self, z: Tensor, uniform: Tensor | None = None, shift: Tensor | None = None, truncation: float = 1.0
    ) -> dict[str, Tensor]:
        made: dict[str, Tensor] = self.network(z, self.angle, truncation=truncation, uniform=uniform, shift=shift)
        return made

    def start_from(self, parent: Generator) -> None:
        """Take over a trained generator's weights; the angles are this one's."""
        self._take(parent, {**parent.state_dict(), "angle": self.angle})
