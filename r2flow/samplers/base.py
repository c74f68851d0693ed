"""Base class of samplers, and their result."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Bound, Config, Options
from r2flow.flow.solvers.fixed import build_grid
from r2flow.flow.solvers.solution import finite, wide

Condition = Mapping[str, Tensor]
"""Conditions of each scan by name: tensors of shape (B, ...)."""
Known = Condition | None  # None: nothing is known of the scans

Tick = Callable[[], None]  # called after every network evaluation
Progress = Tick | None
Noise = Callable[[int], Tensor]  # the j-th draw from N(0, 1), j = 1, 2, ..., in the noise's shape
Steps = Annotated[int, Bound("from 1 to 1,000,000", lambda n: 1 <= n <= 10**6)]
Grid = str | list[float] | tuple[float, ...]


@dataclass(frozen=True)
class Generated:
    """Scans in model space."""

    x: Tensor  #: x_1, (B, C, H, W), on the generator's device, float32 or float64
    evaluations: Tensor  #: network evaluations of each scan, (B,) int64
    converged: Tensor  #: whether each scan is finite and, for an adaptive method, solved, (B,) bool
    density: Any = None  #: `r2flow.generators.answers.Answers` of the last step; None without one

    @classmethod
    def after(cls, x: Tensor, evaluations: int, converged: Tensor | None = None) -> Self:
        """Scans after as many evaluations each; `converged`, (B,) bool, is `finite` by default."""
        counted = torch.full((len(x),), evaluations, dtype=torch.int64, device=x.device)
        return cls(wide(x), counted, finite(x) if converged is None else converged)


def last_of(states: Iterable[Tensor], progress: Tick) -> Tensor:
    """Iterate over a sampler's states, calling `progress` after each; return the last one."""
    for state in states:
        progress()
        last = state
    return last


class Sampler(ABC):
    """How a generator is run. A subclass is a frozen dataclass in `SAMPLERS`; configs, checkpoints
    and the command line store its name and fields.
    """

    draws = False  #: whether the sampler is stochastic: it draws noise after x_0
    #: Whether x_1 depends on x_0 closely enough for a reflow pair (x_0, x_1).
    paired = True
    completes = False  #: whether a condition is required
    needs = "velocity"  #: attribute that a generator must have

    @abstractmethod
    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        """Generate x_1 in model space, (B, C, H, W).

        Args:
            generator: A generator with the attribute `needs`.
            noise: (B, *noise_shape), on the generator's device, float32 or float64.
            draws: Noise of step j.
        """

    @property
    def name(self) -> str:
        from r2flow.samplers import SAMPLERS

        return SAMPLERS.name_of(type(self)) or type(self).__name__

    def evaluations(self, generator: Any) -> int | None:
        """Network evaluations per scan; None if they depend on the scans."""
        return getattr(self, "steps", None)

    def check(self, generator: Any) -> None:
        """Refuse a generator that the sampler cannot run."""
        kind = type(generator).__name__
        unconditional = getattr(generator, "unconditional", True)
        if getattr(generator, self.needs, None) is None:
            reason = "has none" if unconditional or generator.takes_condition else "draws no scans"
            raise InputError(
                f"sampler {self.name} needs a generator with a {self.needs}; a {kind} {reason}."
            )
        if self.draws and not unconditional and self.needs in ("velocity", "map"):
            raise InputError(
                f"{self.name} adds noise of N(0, 1); a {kind} starts from other: give jump."
            )
        if getattr(generator, "fixed", False) and self != generator.sampler:
            raise InputError(
                f"this model is distilled for {generator.sampler} alone: use these, or its parent "
                "flow."
            )

    def changed(self, **options: Any) -> "Sampler":
        """A copy with the options that are not None."""
        from r2flow.samplers import build_sampler

        fields = self.asdict()
        options = _plain(options)
        times = isinstance(fields.get("grid"), list)
        if times and options.get("steps", fields["steps"]) != fields["steps"]:
            del fields["grid"]  # its times are of another number of steps
        return build_sampler(fields | options)

    def asdict(self) -> Config:
        """Name and fields as plain values, as stored in a config or a checkpoint."""
        values: Config = {"name": self.name}
        for name, value in vars(self).items():
            if (name, value) != ("method", self.name):  # a solver's name is its method
                values[name] = list(value) if isinstance(value, tuple) else value
        return values

    @property
    def text(self) -> str:
        """`NAME:FIELD=VALUE:...`, as `parse_sampler` reads it."""
        _, *fields = [f"{key}={value}" for key, value in self.asdict().items() if value is not None]
        return ":".join([self.name, *fields])

    def __str__(self) -> str:
        steps = getattr(self, "steps", None)
        if steps is None:
            return self.name
        return f"{self.name}, 1 step" if steps == 1 else f"{self.name}, {steps} steps"


@dataclass(frozen=True)
class OnGrid(Sampler):
    """A sampler with fixed steps on a time grid."""

    steps: Steps = 32  # from t = 0 to t = 1
    grid: Grid = "uniform"  # a name (`r2flow.flow.solvers.named_grid`), or the times themselves

    def __post_init__(self) -> None:
        if isinstance(self.grid, list | tuple):
            object.__setattr__(self, "grid", tuple(float(t) for t in self.grid))
            if len(self.grid) != self.steps + 1:
                raise InputError(
                    f"the time grid has {len(self.grid) - 1} steps, found steps={self.steps}."
                )
            if getattr(self, "finish", 0) and self.steps > 1:
                raise InputError("a grid has its own last step: give finish=0.")
        self.times()

    def times(self) -> Tensor:
        """Time grid from 0 to 1, (steps + 1,) float64."""
        return build_grid(self.grid, 0.0, 1.0, self.steps)


def _plain(options: Options) -> Config:
    """The options that are not None, in values of Python, and `steps` of a grid of times."""
    plain = {key: value for key, value in options.items() if value is not None}
    for key, value in plain.items():
        if hasattr(value, "tolist"):  # NumPy's and torch's
            plain[key] = value.tolist()
    if isinstance(plain.get("grid"), list | tuple):
        plain.setdefault("steps", len(plain["grid"]) - 1)
    return plain
