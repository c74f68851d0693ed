"""What every generator has in common: noise in, scan out."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.flow.solvers import TORCHDIFFEQ, adapts, check_method, usual_grid
from r2flow.flow.solvers.solution import finite, wide
from r2flow.flow.stochastic import SDE
from r2flow.lidar.region import Region
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws
from r2flow.registry import Count, Portion, Positive, check_options

Condition = Mapping[str, Tensor]
"""What is known of each scan, by name: tensors of shape (B, ...). Which names there are, the generator says."""

Progress = Callable[[], None] | None

Precision = Literal["32-true", "bf16-mixed"]  # words of Lightning's trainer

IMAGE, KNOWN = "image", "known"  # the names of what is known of a part of a scan
LOGIT, SIGMA = "logit", "sigma"  # and of what a conditional flow finds of these once (`r2flow.generators.conditional`)

JUMP, CHORD, RENOISE = WAYS = "jump", "chord", "renoise"  # of a flow map, on the same steps

WHOLE_ONLY = "a {} makes whole images and no part of one; leave the region out."


def parts_of(condition: Condition | None, x: Tensor) -> tuple[Tensor, Tensor]:
    """`image` and `known` of a condition, as `x` is in type and place; zeros where nothing is known.

    Raises:
        InputError: a condition of other names or shapes.
    """
    if condition is None:
        return torch.zeros_like(x), torch.zeros_like(x)
    if condition.keys() - {LOGIT, SIGMA} != {IMAGE, KNOWN}:
        raise InputError(f"the condition must have the keys '{IMAGE}' and '{KNOWN}', got {', '.join(condition)}.")
    image, known = (condition[name].to(x) for name in (IMAGE, KNOWN))
    if image.shape != x.shape or known.shape != x.shape:
        raise InputError(f"the condition must be {tuple(x.shape)} as the scans are, found {tuple(image.shape)}.")
    return image, known


@dataclass(frozen=True)
class Sampler:
    """How a generator is run; saved with it.

    Attributes:
        method: A solver's name for a flow (`r2flow.flow.solvers`), or what completes a scan with it
            (`r2flow.flow.posterior`); other families have names of their own.
        steps: Steps from noise to data, of a method of fixed steps.
        tolerance: Absolute and relative tolerance of an adaptive method.
        grid: Where fixed steps fall: a name (`r2flow.flow.solvers.named_grid`), or the times themselves.
        finish: Length of the last part of the way to t = 1, which the last step takes by Euler's rule. That smooths
            what a flow leaves rough that was not trained to the end.
        fixed: Whether the generator was trained for this number of steps and is worse at any other.
        doubt: Standard deviation, in model space, of the error of a doubtful value, for a method of
            `r2flow.flow.posterior`. Model space is 2 wide: false returns are further off than a tenth of that, the
            noise of a ranging sensor is far less.
        precision: Of the network, as `trainer.precision`: `bf16-mixed` computes its products in bfloat16, by
            `torch.autocast`. States and steps stay as they are.
        fewer: Method in fewer steps than `steps`, where another is better there; a flow map may have `chord`.
    """

    method: str = "euler"
    steps: Count = 32
    tolerance: Positive = 1e-5
    grid: str | tuple[float, ...] = "uniform"
    finish: Portion = 0.0
    fixed: bool = False
    doubt: Positive = 0.2
    precision: Precision = "32-true"
    fewer: str | None = None

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Self:
        """From plain values, as a config or a checkpoint holds them.

        Raises:
            InputError: an unknown option, or a value of the wrong type.
        """
        known = dict(options)
        check_options("sampler", cls, known)
        grid = known.get("grid", "uniform")
        known["grid"] = grid if isinstance(grid, str) else tuple(grid)
        return cls(**known)

    def changed(self, **options: Any) -> Self:
        """The same with the options that are not None. Given times decide the number of steps.

        Fewer steps alone go over to the method `fewer`, if there is one.
        Another method starts from its usual grid and `finish`. The same
        one with other numbers, as `sde:2` for `sde`, keeps them.

        Raises:
            InputError: an unknown option or a value of the wrong type, fewer than one step, or times and a number of
                steps that contradict.
        """
        given = {k: v.tolist() if hasattr(v, "tolist") else v for k, v in options.items() if v is not None}
        own = vars(self)  # the range of a number is judged with the method that takes it
        odd = {k: v for k, v in given.items() if isinstance(v, tuple) or type(v) is not type(own.get(k))}
        odd |= {k: v for k, v in given.items() if k in ("precision", "finish", "doubt")}
        check_options("sampler", type(self), odd)
        if self.fewer and "method" not in given and given.get("steps", self.steps) < self.steps:
            given["method"] = self.fewer
        if "method" in given:
            given = {"fewer": None, **given}
        if _kind(given.get("method", self.method)) != _kind(self.method):
            given = {**usual_steps(given["method"]), **given}
        grid = given.get("grid", "uniform")
        if not isinstance(grid, str):
            given |= {"finish": options.get("finish") or 0.0, "grid": tuple(float(t) for t in grid)}
            if given.setdefault("steps", len(given["grid"]) - 1) != len(given["grid"]) - 1:
                raise InputError(f"the time grid has {len(given['grid']) - 1} steps, found steps={given['steps']}.")
        elif "steps" in given and "grid" not in given and not isinstance(self.grid, str):
            given["grid"] = "uniform"  # the times were those of another number of steps
        found = replace(self, **given)
        if not 1 <= found.steps <= MOST_STEPS:
            raise InputError(f"a sampler takes 1 to {MOST_STEPS:,} steps, found {found.steps:,}.")
        return found

    @property
    def times(self) -> str | Tensor:
        """The grid as solvers take it: by name, or its times in float64."""
        return self.grid if isinstance(self.grid, str) else torch.tensor(self.grid, dtype=torch.float64)

    def autocast(self, device: torch.device) -> AbstractContextManager[Any]:
        """In which the network is computed with `precision`."""
        return nullcontext() if self.precision == "32-true" else torch.autocast(device.type, torch.bfloat16)

    def unlike(self, other: Self) -> str:
        """What is another one's setting, in words: "steps 5, tolerance 0.1"."""
        return ", ".join(f"{key} {value}" for key, value in asdict(self).items() if value != getattr(other, key))

    def asdict(self) -> dict[str, Any]:
        """Plain values, as a config or a checkpoint holds them; those that are younger than this format if given."""
        found = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}
        return {key: value for key, value in found.items() if (key, value) not in YOUNGER}


MOST_STEPS = 10**6  # more are a slip of the finger
YOUNGER = ("precision", "32-true"), ("fewer", None)  # what files without these keys mean by it


def _kind(method: str) -> str:
    """A method's name without its numbers; torchdiffeq's have their own after the colon. A map's ways are one."""
    name = method if method.startswith(TORCHDIFFEQ) else method.partition(":")[0]
    return JUMP if name in WAYS else name


def takes_tolerance(method: str) -> bool:
    """Whether a generator's method is an adaptive solver; what is no solver is none.

    Raises:
        InputError: torchdiffeq has no such method.
    """
    if method.startswith(TORCHDIFFEQ):
        check_method(method)
    return adapts(method)


def check_control(method: str, given: Mapping[str, Any], called: str = "{}") -> None:
    """Check what is given to say how exact a method shall be; None counts as left out.

    Args:
        given: Options of a sampler, by name.
        called: What an option is called where it was given, as `--{}`.

    Raises:
        InputError: a tolerance for fixed steps, or a number of steps for an adaptive solver.
    """
    steps, tolerance = called.format("steps"), called.format("tolerance")
    adaptive = takes_tolerance(method)
    if adaptive and given.get("steps") is not None:
        raise InputError(f"{steps} is for a solver of fixed steps, and {method} chooses its own; give {tolerance}.")
    if not adaptive and given.get("tolerance") is not None:
        raise InputError(f"{tolerance} is for an adaptive solver, as dopri5, and {method} is none; give {steps}.")


def usual_steps(method: str) -> Mapping[str, Any]:
    """Its usual `grid` and `finish`; of `sde` and `chord` what was best, or nearly so, of the package's models."""
    if _kind(method) == SDE:
        return {"grid": "power:2.5", "finish": 1 / 128}
    if method == CHORD:
        return {"grid": "late:32", "finish": 0.0}
    return {"grid": usual_grid(method), "finish": 0.0}


@dataclass(frozen=True)
class Generated:
    """Scans in model space.

    Attributes:
        x: x_1, (B, C, H, W), on the generator's device, float32 or float64.
        evaluations: Network evaluations of each, (B,) int64.
        converged: Whether each is a scan of the generator, (B,) bool: finite and, for an adaptive method, solved.
    """

    x: Tensor
    evaluations: Tensor
    converged: Tensor

    @classmethod
    def after(cls, x: Tensor, evaluations: int, converged: Tensor | None = None) -> Self:
        """Scans of a method that always comes to its end, after the same number of evaluations for all.

        Args:
            converged: Whether each was finite all the way, (B,) bool; None: where x is. An x that was clamped, or
                kept from an earlier step, does not tell.
        """
        counted = torch.full((len(x),), evaluations, dtype=torch.int64, device=x.device)
        x = wide(x)
        return cls(x, counted, finite(x) if converged is None else converged)


class Generator(nn.Module):
    """Noise in, scan out. What training makes, a checkpoint holds and every verb, report and callback runs.

    A subclass implements `generate` and enters `GENERATORS`. Its constructor takes the model space and the config's
    `backbone`, which it may ignore, and then options of its own, which are those of the config's `generator`.

    Attributes:
        space: The images it makes.
        noise_shape: What one scan is made of: (C, H, W) for a flow, (latent,) for a GAN.
        sampler: How it is run when nobody says otherwise.
        draws: Whether it makes scans of noise; an autoencoder by itself does not, and no picture or sample is drawn.
        told: Whether it takes a condition of `r2flow.generators.condition_of` by its own sampler.
        goes_on_as: The family that a stage for any flow makes of it; None for its own.
    """

    draws: ClassVar[bool] = True
    told: ClassVar[bool] = False
    goes_on_as: ClassVar[str | None] = None

    def __init__(self, space: ModelSpace, noise_shape: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.space = space
        self.noise_shape = space.shape if noise_shape is None else noise_shape
        self.sampler = Sampler()

    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        """x_1 in model space with evaluations and convergence of each scan, (B, C, H, W).

        Args:
            noise: (B, *noise_shape).
            condition: What is known of each scan; None for a scan of which nothing is known.
            sampler: Another than the generator's own.
            draws: Where further noise comes from, `draws.step(shape, j)` at step j = 1, 2, ...; a flow needs none.
            progress: Called after every evaluation of the network.

        Raises:
            InputError: a sampler or a condition that the generator does not know.
        """
        raise NotImplementedError

    def check_sampler(self, sampler: Sampler) -> None:
        """Refuse a sampler before it is needed. A generator that can be run in several ways says in which.

        Raises:
            InputError: this generator cannot be run so.
        """
        own = self.sampler
        if sampler != replace(own, precision=sampler.precision):
            raise InputError(
                f"a {type(self).__name__} can be run in one way only, {own.method} with {own.steps} "
                f"step{'s' * (own.steps > 1)}; found {sampler.unlike(own)}."
            )

    def evaluations_of(self, sampler: Sampler) -> int:
        """Network evaluations of a batch, for a progress bar; 0 where they depend on the scans."""
        return sampler.steps

    def in_steps(self, steps: int) -> Sampler:
        """The simplest sampler with this many steps, one evaluation each, by which generators are compared."""
        return self.sampler.changed(steps=steps)

    @property
    def unit(self) -> tuple[int, int]:
        """Rows and columns that a part of the image must be a multiple of, and begin at a multiple of.

        Raises:
            InputError: this generator makes whole images only.
        """
        raise InputError(WHOLE_ONLY.format(type(self).__name__))

    def part(self, region: Region) -> "Generator":
        """The same generator for a region of whole units, its weights shared.

        Raises:
            InputError: this generator makes whole images only.
        """
        if region.share < 1:
            raise InputError(WHOLE_ONLY.format(type(self).__name__))
        return self

    def start_from(self, parent: "Generator") -> None:
        """Take over a trained generator's weights: every name and shape must be this one's.

        Raises:
            InputError: one is not.
        """
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
        """Where its weights are."""
        return next(self.parameters()).device
