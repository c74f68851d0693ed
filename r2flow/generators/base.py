"""Base class of generators, noise in and scan out, and their condition, a partial scan."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.base.registry import Config, options_of
from r2flow.flow.solvers.solution import wide
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.known import Ray
from r2flow.samplers import SAMPLERS, FixedSteps, build_sampler, parse_sampler
from r2flow.samplers.base import Condition, Generated, Progress, Sampler

Precision = Literal["32-true", "bf16-mixed"]  # names of Lightning's Trainer

# Keys of the condition of a partial scan.
IMAGE = "image"
KNOWN = "known"


def holds(condition: Tensor) -> bool:
    """Whether a condition, () bool, is true; an exported graph has no branches: True."""
    return torch.compiler.is_exporting() or bool(condition)


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """Condition of partial scans: `image` and `known`, each (B, C, H, W) in model space.

    `known` is 1 for measured values; `image` is 0 for rays that were not measured.

    Args:
        images: Range in metres, optionally reflectance, then optionally common classes, (B, 1 to 3,
            H, W); 0 without a return. Without the reflectance channel, or where there are classes
            and reflectance is 0 throughout, the reflectance of returns is unknown, that of empty
            rays is known. A label is known where its class is above 0, also of a ray that was not
            measured.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W).

    Raises:
        InputError: If images and states do not have the model's shape, or contradict each other.
    """
    _, rows, columns = space.shape
    found = (tuple(images.shape), tuple(state.shape))
    if found[0][2:] != (rows, columns) or found[1] != (len(images), rows, columns):
        sizes = f"1 to {len(space.encoding.slices)}"
        raise InputError(
            f"the images to complete must be (B, {sizes}, {rows}, {columns}) and the states of "
            f"the rays (B, {rows}, {columns}), found {found[0]} and {found[1]}."
        )
    measured = state != Ray.UNKNOWN
    expected = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.EMPTY))
    if not holds((~measured | (state == expected)).all()):
        raise InputError(
            "a ray's state must be Ray.RETURN for a range above 0, Ray.EMPTY for a measured range "
            "of 0, and Ray.UNKNOWN for a ray that was not measured."
        )
    measured = measured[:, None]
    channels = space.encoding.slices
    absent = images.new_zeros(len(images), max(len(channels) - images.shape[1], 0), rows, columns)
    metres = torch.cat([images, absent], 1)
    image = space.encoding.encode(metres)
    known = measured.expand_as(image).to(image)
    if space.encoding.reflectance and images.shape[1] != 2:
        silent = (metres[:, 1] == 0).flatten(1).all(1)[:, None, None]
        known[:, 1] *= ~(silent & (images[:, 0] > 0))
    if space.encoding.labels:
        known[:, channels["label"]] = (metres[:, 2:3] > 0).to(image)
    return {IMAGE: torch.where(measured | (known > 0), image, 0), KNOWN: known}


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """Context in which networks run with `precision`, whatever surrounds it."""
    if precision not in ("32-true", "bf16-mixed"):
        raise InputError(f"a network's precision is 32-true or bf16-mixed, found {precision!r}.")
    return torch.autocast(device.type, torch.bfloat16, enabled=precision != "32-true")


class Generator(nn.Module):
    """Noise in, scan out: the model that stages train, checkpoints store and commands run.

    A subclass has the attribute that its samplers need (`r2flow.samplers.base.Sampler.needs`) and
    is registered in `GENERATORS`. Its constructor takes the model space, the config's `backbone`
    (may be ignored) and the options of `generator`.

    Attributes:
        space: Model space of the images.
        noise_shape: Shape of the noise of one scan: (C, H, W) for a flow, (latent,) for a GAN.
        sampler: Default sampler.
        few: Sampler for fewer steps than `sampler.steps`; None: `sampler`.
        fixed: True for a distilled model: only `sampler` is valid.
    """

    # Whether it makes scans of N(0, I) alone; False for autoencoders and transfer flows.
    unconditional = True
    takes_condition = False  # whether it takes a condition of `condition_of`
    # Whether it learns a vector per direction: no rotation in training.
    learns_directions = False
    default_sampler: ClassVar[Sampler] = FixedSteps()  # default sampler of a new generator
    # Class used when fine-tuned with a velocity loss; None: the same.
    finetuned_as: ClassVar[str | None] = None

    def __init__(self, space: ModelSpace, noise_shape: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.space = space
        self.noise_shape = noise_shape or space.shape
        self.run_by(self.default_sampler)

    def run_by(self, sampler: Sampler, few: Sampler | None = None, fixed: bool = False) -> None:
        self.sampler = sampler
        self.few = few
        self.fixed = fixed

    def drawing(self) -> Config:
        """The default samplers as plain values, as stored in a checkpoint."""
        few = self.few and self.few.asdict()
        return {"sampler": self.sampler.asdict(), "few": few, "fixed": self.fixed}

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
            noise: (B, *noise_shape), of any floating type; float64 noise of a model with a velocity
                gives float64 scans, else they have the type of the weights.
            sampler: Sampler; None: the default.
            draws: Noise of stochastic samplers: `draws.step(shape, j)` at step j = 1, 2, ...
            precision: `bf16-mixed` runs the network's matrix products in bfloat16; states and steps
                keep their type.
            progress: Called after every network evaluation.
        """
        how = sampler or self.sampler
        how.check(self)
        if condition is not None and not (self.takes_condition or how.completes):
            raise InputError(
                f"this {type(self).__name__} takes no condition; complete scans by --sampler mmps."
            )
        if draws is None and how.draws:
            raise InputError(f"sampler {how.name} is stochastic: give draws.")
        dtype = next(self.parameters(), noise).dtype  # float64 for weights of 64-true runs
        if hasattr(self, "velocity"):  # a solver's state may have more digits than its network
            dtype = torch.promote_types(noise.dtype, dtype)
        x = wide(noise.to(self.device, dtype))
        if condition is not None:
            condition = {name: value.to(self.device) for name, value in condition.items()}

        def noise_of_step(j: int) -> Tensor:
            assert draws is not None  # refused above, unless a GAN draws a mask
            return self.further_noise(draws, j).to(x)

        with autocast(self.device, precision):
            return how(self, x, condition, noise_of_step, progress or (lambda: None))

    def further_noise(self, draws: Draws, j: int) -> Tensor:
        return draws.step(self.noise_shape, j)

    def choose(self, name: str | None = None, **options: Any) -> Sampler:
        """A sampler by name, with `options` that are not None.

        Without a name, it is `sampler`, or `few` for fewer steps. A name may have fields
        (`parse_sampler`). Another sampler keeps the number of steps, with defaults otherwise.
        """
        fields = {} if name is None else parse_sampler(str(name))
        fields |= {key: value for key, value in options.items() if value is not None}
        name = fields.pop("name", None)
        default = self.sampler
        steps = getattr(default, "steps", None)
        if self.few:
            asked = fields.get("steps")
            fewer = steps and hasattr(asked, "__index__") and asked < steps
            if fewer if name is None else name == self.few.name:
                default = self.few
                steps = None
        if name is not None and name != default.name:
            if "grid" not in fields and "steps" in options_of(SAMPLERS[name]):
                fields = {"steps": steps, **fields}
            sampler = build_sampler({"name": name, **fields})
        elif fields:
            sampler = default.changed(**fields)
        else:
            return default
        sampler.check(self)
        return sampler

    def start_from(self, parent: "Generator") -> None:
        """Copy a trained generator's weights; all names and shapes must match."""
        self._take(parent, parent.state_dict())

    def _take(self, parent: "Generator", weights: Mapping[str, Tensor]) -> None:
        try:
            self.load_state_dict(weights)
        except RuntimeError as error:
            first = str(error).splitlines()[1].strip()
            raise InputError(
                f"the weights of a {type(parent).__name__} do not fit this {type(self).__name__}: "
                f"give the sensor and options of its training, or leave stage.parent out. {first}"
            ) from None

    @property
    def device(self) -> torch.device:
        """Device of the weights; the CPU if there are none."""
        return next(self.parameters(), torch.empty(0, device="cpu")).device
