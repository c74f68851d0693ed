"""Base class of generators, noise in and scan out, and their condition, a partial scan."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Literal, get_args

import torch
from torch import Tensor, nn

from r2flow.errors import InputError, check
from r2flow.flow.solvers.solution import wide
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.known import Ray
from r2flow.lidar.region import Region
from r2flow.noise import Draws
from r2flow.registry import options_of
from r2flow.samplers import SAMPLERS, FixedSteps, build_sampler, parse_sampler
from r2flow.samplers.base import Condition, Generated, Progress, Sampler

Precision = Literal["32-true", "bf16-mixed"]  # names of Lightning's Trainer

IMAGE, KNOWN = "image", "known"  # keys of the condition of a partial scan


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """Condition of partial scans: `image` and `known`, each (B, C, H, W) in model space.

    `known` is 1 for measured values; `image` is 0 for rays that were not measured.

    Args:
        images: Range in metres and optionally reflectance, (B, 2 or 1, H, W); 0 without a return. Without the
            reflectance channel, the reflectance of returns is unknown, that of empty rays is known.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W).
    """
    _, h, w = space.shape
    sizes, states = tuple(images.shape), tuple(state.shape)
    if len(sizes) != 4 or sizes[1] not in (1, 2) or sizes[2:] != (h, w) or states != (sizes[0], h, w):
        raise InputError(
            f"the images to complete must be (B, 2 or 1, {h}, {w}) and the states of the rays (B, {h}, {w}), found "
            f"{sizes} and {states}."
        )
    returned, measured = images[:, 0] > 0, state != Ray.UNKNOWN
    if bool((measured & (state != torch.where(returned, int(Ray.RETURN), int(Ray.EMPTY)))).any()):
        raise InputError("a ray's state must be Ray.RETURN for a range above 0, Ray.EMPTY for a measured range of 0, "
                         "and Ray.UNKNOWN for a ray that was not measured.")  # fmt: skip
    encoding = space.encoding
    without_reflectance = encoding.reflectance and images.shape[1] == 1
    image = encoding.encode(torch.cat([images, torch.zeros_like(images)], 1) if without_reflectance else images)
    known = measured[:, None].expand_as(image).to(image)
    if without_reflectance:
        known[:, -1] *= ~returned
    return {IMAGE: torch.where(measured[:, None], image, 0), KNOWN: known}


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """Context in which networks run with `precision`, whatever surrounds it."""
    check(precision in get_args(Precision), f"a network's precision is 32-true or bf16-mixed, found {precision!r}.")
    return torch.autocast(device.type, torch.bfloat16, enabled=precision != "32-true")


class Generator(nn.Module):
    """Noise in, scan out: the model that stages train, checkpoints store and commands run.

    A subclass has the attribute that its samplers need (`r2flow.samplers.base.Sampler.needs`) and is registered in
    `GENERATORS`. Its constructor takes the model space, the config's `backbone` (may be ignored) and the options of
    `generator`.

    Attributes:
        space: Model space of the images.
        noise_shape: Shape of the noise of one scan: (C, H, W) for a flow, (latent,) for a GAN.
        sampler: Default sampler.
        few: Sampler for fewer steps than `sampler.steps`; None: `sampler`.
        fixed: True for a distilled model: only `sampler` is valid.
    """

    draws: ClassVar[bool] = True  # whether it makes scans of N(0, I) alone; False for autoencoders, transfer flows
    told: ClassVar[bool] = False  # whether it takes a condition of `r2flow.generators.condition_of`
    learns_directions: ClassVar[bool] = False  # whether it learns a vector per direction: no rotation in training
    usual: ClassVar[Sampler] = FixedSteps()  # default sampler of a new generator
    goes_on_as: ClassVar[str | None] = None  # class used when fine-tuned with a velocity loss; None: the same

    def __init__(self, space: ModelSpace, noise_shape: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.space = space
        self.noise_shape = space.shape if noise_shape is None else noise_shape
        self.run_by(self.usual)

    def run_by(self, sampler: Sampler, few: Sampler | None = None, fixed: bool = False) -> None:
        self.sampler, self.few, self.fixed = sampler, few, fixed

    def drawing(self) -> dict[str, Any]:
        """The default samplers as plain values, as stored in a checkpoint."""
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
        """Generate x_1 in model space, (B, C, H, W), with evaluations and convergence per scan.

        Args:
            noise: (B, *noise_shape).
            sampler: Sampler; None: the default.
            draws: Source of the noise of stochastic samplers: `draws.step(shape, j)` at step j = 1, 2, ...
            precision: `bf16-mixed` runs the network's matrix products in bfloat16; states and steps keep their type.
            progress: Called after every network evaluation.
        """
        how = sampler or self.sampler
        how.check(self)
        if condition is not None and not (self.told or how.completes):
            raise InputError(f"this {type(self).__name__} takes no condition; complete scans with --sampler mmps.")
        check(draws is not None or not how.draws, f"sampler {how.name} is stochastic: give draws.")
        weight = next(self.parameters(), noise)
        x = wide(noise.to(self.device, torch.promote_types(noise.dtype, weight.dtype)))  # of 64-true runs, float64
        conditions = condition and {name: value.to(self.device) for name, value in condition.items()}
        noise_of_step = None if draws is None else lambda j: self.further_noise(draws, j).to(x)
        with autocast(self.device, precision):
            made = how(self, x, conditions, noise_of_step, progress or (lambda: None))
        shape = tuple(made.x.shape) if isinstance(made, Generated) else ()
        if shape != x.shape and shape != (len(x), *self.space.shape):  # x of a part of the image has its shape
            raise InputError(f"sampler {how.name} must give a Generated of {len(x)} scans of {self.space.shape}.")
        return made

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        return draws.step(self.noise_shape, j)

    def choose(self, name: str | None = None, **options: Any) -> Sampler:
        """A sampler by name, with `options` that are not None; without a name, `sampler`, or `few` for fewer steps.

        A name may have fields (`parse_sampler`). Another sampler keeps the number of steps, with defaults otherwise.
        """
        given = ({} if name is None else parse_sampler(str(name))) | {k: v for k, v in options.items() if v is not None}
        name = given.pop("name", None)
        default, steps = self.sampler, getattr(self.sampler, "steps", None)
        asked = given.get("steps")
        if self.few and (name == self.few.name if name else steps and hasattr(asked, "__index__") and asked < steps):
            default, steps = self.few, None
        if not given and name in (None, default.name):
            return default
        if name in (None, default.name):
            sampler = default.changed(**given)
        else:
            kept = {"steps": steps} if "steps" in options_of(SAMPLERS[name]) and "grid" not in given else {}
            sampler = build_sampler({"name": name, **kept, **given})
        sampler.check(self)
        return sampler

    @property
    def unit(self) -> tuple[int, int]:
        """Rows and columns whose multiples a region's offset and size must be."""
        raise InputError(f"a {type(self).__name__} generates whole images only; leave the region out.")

    def part(self, region: Region) -> "Generator":
        """This generator restricted to a region of whole units; it shares the weights."""
        if region.share < 1:
            _ = self.unit  # refuses a region
        return self

    def start_from(self, parent: "Generator") -> None:
        """Copy a trained generator's weights; all names and shapes must match."""
        self._take(parent, parent.state_dict())

    def _take(self, parent: "Generator", weights: Mapping[str, Tensor]) -> None:
        try:
            self.load_state_dict(weights)
        except RuntimeError:
            raise InputError(
                f"the weights of a {type(parent).__name__} do not fit this {type(self).__name__}: give the "
                "generator and the options that it was trained with, or leave stage.parent out."
            ) from None

    @property
    def device(self) -> torch.device:
        """Device of the weights; the CPU if there are none."""
        return next((p.device for p in self.parameters()), torch.device("cpu"))
