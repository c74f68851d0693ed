"""GANs: x = G(z) in one evaluation, with a mask of dropped rays or without."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.solution import finite
from r2flow.generators.base import Condition, Generated, Generator, Progress, Sampler
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import Count, Positive
from r2flow.systems.gan import dcgan, style_gan
from r2flow.systems.gan.layers import LatentGenerator

DIRECT, TRUNCATE = "direct", "truncate:"
DROPPED = -1.0  # a dropped ray in model space


class Gan(Generator):
    """x = G(z) clamped to [-1, 1], with z of N(0, I).

    Samplers: `direct`; `truncate:PSI` moves each code towards the mean one, w <- w_avg + PSI (w - w_avg) with PSI in
    (0, 1], for plainer scans that are closer to each other (0.7 in DUSty's published demo).

    Args:
        space: The images it makes.
        build: The network of a shape and a number of channels.

    Attributes:
        network: G.
        drops: Whether a mask of dropped rays is drawn: logistic noise of `draws.step(shape, 1)`.
    """

    def __init__(self, space: ModelSpace, build: Callable[[tuple[int, int], int], LatentGenerator]) -> None:
        channels, h, w = space.shape
        network = build((h, w), channels)
        super().__init__(space, noise_shape=(network.latent,))
        self.sampler = Sampler(DIRECT, 1, fixed=True)
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
        if condition is not None:
            raise InputError(f"a {type(self).__name__} takes no condition; leave it out.")
        z, uniform = noise.to(self.device), None
        if self.drops:
            if draws is None:
                raise InputError(f"a {type(self).__name__} draws a mask, whose noise is of draws: give them.")
            normal = draws.step((1, *self.space.shape[1:]), 1)
            uniform = torch.special.ndtr(normal.double()).to(z)
        made = self.made(z, uniform, truncation=truncation_of(sampler or self.sampler))
        if progress is not None:
            progress()
        return Generated.after(made["image"].clamp(-1, 1), 1, finite(made["image"]))

    def check_sampler(self, sampler: Sampler) -> None:
        known = sampler.method == DIRECT or sampler.method.startswith(TRUNCATE)
        if not known or replace(sampler, method=self.sampler.method) != self.sampler:
            raise InputError(
                f"a {type(self).__name__} makes a scan in 1 step, by {DIRECT} or {TRUNCATE}PSI, without a tolerance or "
                f"a time grid; found {sampler.unlike(self.sampler)}."
            )
        truncation_of(sampler)

    def evaluations_of(self, sampler: Sampler) -> int:
        return 1

    def in_steps(self, steps: int) -> Sampler:
        return self.sampler


def truncation_of(sampler: Sampler) -> float:
    """psi of a sampler.

    Raises:
        InputError: none of (0, 1].
    """
    if sampler.method == DIRECT:
        return 1.0
    said = sampler.method.removeprefix(TRUNCATE)
    try:
        psi = float(said)
    except ValueError:
        psi = 0.0
    if not 0 < psi <= 1:
        raise InputError(f"a truncation must lie in (0, 1], as {TRUNCATE}0.7; found {sampler.method!r}.")
    return psi


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
