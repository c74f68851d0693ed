"""What every generator has in common: noise in, scan out."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.flow.solvers.solution import wide
from r2flow.lidar.region import Region
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import options_of
from r2flow.samplers import SAMPLERS, FixedSteps, build_sampler
from r2flow.samplers.base import Condition, Generated, Progress, Sampler

Precision = Literal["32-true", "bf16-mixed"]  # words of Lightning's trainer

IMAGE, KNOWN = "image", "known"  # the names of what is known of a part of a scan

WHOLE_ONLY = "a {} makes whole images and no part of one; leave the region out."


def parts_of(condition: Condition | None, x: Tensor) -> tuple[Tensor, Tensor]:
    """`image` and `known` of a condition, as `x` is in type and place; zeros where nothing is known."""
    if condition is None:
        return torch.zeros_like(x), torch.zeros_like(x)
    image, known = (condition[name].to(x) for name in (IMAGE, KNOWN))
    assert image.shape == known.shape == x.shape
    return image, known


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """In which a network is computed with `precision`."""
    return nullcontext() if precision == "32-true" else torch.autocast(device.type, torch.bfloat16)


class Generator(nn.Module):
    """Noise in, scan out. What training makes, a checkpoint holds and every verb, report and callback runs.

    A subclass has what its samplers need (`r2flow.samplers.base.Sampler.needs`) and enters `GENERATORS`. Its
    constructor takes the model space, the config's `backbone`, which it may ignore, and the options of `generator`.

    Attributes:
        space: The images it makes.
        noise_shape: Noise of one scan: (C, H, W) for a flow, (latent,) for a GAN.
        sampler: How it is run by default.
        few: Sampler for fewer steps than the sampler's; None: the same.
        fixed: True for a distilled model: it is run by `sampler` and nothing else.
        plain: Name of the sampler by which generators are compared at equal steps; None: its own.
        draws: Whether it makes scans of noise; an autoencoder by itself does not, and no picture or sample is drawn.
        told: Whether it takes a condition of `r2flow.generators.condition_of`.
        goes_on_as: Generator class used when fine-tuned with a velocity loss; None: same class.
    """

    plain: ClassVar[str | None] = None
    draws: ClassVar[bool] = True
    told: ClassVar[bool] = False
    goes_on_as: ClassVar[str | None] = None

    def __init__(self, space: ModelSpace, noise_shape: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.space = space
        self.noise_shape = space.shape if noise_shape is None else noise_shape
        self.run_by(FixedSteps())

    def run_by(self, sampler: Sampler, few: Sampler | None = None, fixed: bool = False) -> None:
        """Set how it is run by default."""
        self.sampler, self.few, self.fixed = sampler, few, fixed

    def drawing(self) -> dict[str, Any]:
        """How it is run by default as plain values, as a checkpoint holds them."""
        return {"sampler": self.sampler.asdict(), "few": self.few and self.few.asdict(), "fixed": self.fixed}

    @torch.no_grad()
    def forward(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        precision: Precision = "32-true",
        progress: Progress = None,
    ) -> Generated:
        """x_1 in model space with evaluations and convergence of each scan, (B, C, H, W).

        Args:
            noise: (B, *noise_shape).
            condition: Condition of each scan, by name.
            sampler: Instead of the generator's own.
            draws: Where further noise comes from, `draws.step(shape, j)` at step j = 1, 2, ...
            precision: `bf16-mixed` computes the network's products in bfloat16; states and steps stay as they are.
            progress: Called after every evaluation of the network.

        Raises:
            InputError: the sampler cannot run this generator, or needs draws or a condition.
        """
        how = sampler or self.sampler
        how.check(self)
        if condition is not None and not (self.told or how.completes):
            raise InputError(f"this {type(self).__name__} takes no condition; complete scans by --sampler mmps.")
        if how.draws and draws is None:
            raise InputError(f"sampler {how.name} draws noise on the way: give draws.")
        x = wide(noise.to(self.device))
        known = condition and {name: value.to(self.device) for name, value in condition.items()}
        fresh = None if draws is None else lambda j: self.further_noise(draws, j).to(x)
        with autocast(self.device, precision):
            return how(self, x, known, fresh, progress or (lambda: None))

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        """The noise of step j."""
        return draws.step(self.noise_shape, j)

    def choose(self, name: str | None = None, **options: Any) -> Sampler:
        """The generator's sampler with options that are not None: `few` for fewer steps, or another by its name.

        Another sampler takes over the number of steps and has its own defaults.

        Raises:
            InputError: an unknown name or option, or a sampler that cannot run this generator.
        """
        given = {key: value for key, value in options.items() if value is not None}
        own, steps = self.sampler, getattr(self.sampler, "steps", None)
        if self.few and (name == self.few.name if name else steps and given.get("steps", steps) < steps):
            own, steps = self.few, None
        if not given and name in (None, own.name):
            return own
        if name in (None, own.name):
            sampler = own.changed(**given)
        else:
            known = options_of(SAMPLERS[name])
            sampler = build_sampler(
                {"name": name, **({"steps": steps} if "steps" in known and "grid" not in given else {}), **given}
            )
        sampler.check(self)
        return sampler

    @property
    def unit(self) -> tuple[int, int]:
        """Rows and columns that a part of the image must be a multiple of, and begin at a multiple of."""
        raise InputError(WHOLE_ONLY.format(type(self).__name__))

    def part(self, region: Region) -> "Generator":
        """The same generator for a region of whole units, its weights shared."""
        if region.share < 1:
            raise InputError(WHOLE_ONLY.format(type(self).__name__))
        return self

    def start_from(self, parent: "Generator") -> None:
        """Take over a trained generator's weights: every name and shape must be this one's."""
        self._take(parent, parent.state_dict())

    def _take(self, parent: "Generator", weights: Mapping[str, Tensor]) -> None:
        try:
            self.load_state_dict(weights)
        except RuntimeError:
            raise InputError(
                f"the weights of a {type(parent).__name__} do not fit into this {type(self).__name__}: give the "
                "generator and the options that it was trained with, or leave stage.init out."
            ) from None

    @property
    def learns_directions(self) -> bool:
        """Whether it learns a vector for each direction, so that scans must not be turned in training."""
        return False

    @property
    def device(self) -> torch.device:
        """Where its weights are; the CPU without any."""
        return next((p.device for p in self.parameters()), torch.device("cpu"))
