"""Base class of samplers, and their result."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from r2flow.errors import InputError, check
from r2flow.flow.solvers.fixed import build_grid
from r2flow.flow.solvers.solution import finite, wide
from r2flow.registry import Bound, check_options, options_of

Condition = Mapping[str, Tensor]
"""Conditions of each scan by name: tensors of shape (B, ...)."""

Call = Callable[[], None]
Progress = Call | None
Noise = Callable[[int], Tensor]  # the j-th draw from N(0, 1), j = 1, 2, ..., in the noise's shape
Given = Condition | None
Fresh = Noise | None
Steps = Annotated[int, Bound("from 1 to 1,000,000", lambda n: 1 <= n <= 10**6)]
Grid = str | list[float] | tuple[float, ...]


@dataclass(frozen=True)
class Generated:
    """Scans in model space."""

    x: Tensor  #: x_1, (B, C, H, W), on the generator's device, float32 or float64
    evaluations: Tensor  #: network evaluations of each scan, (B,) int64
    converged: Tensor  #: whether each scan is finite and, for an adaptive method, solved, (B,) bool

    @classmethod
    def after(cls, x: Tensor, evaluations: int, converged: Tensor | None = None) -> Self:
        """Scans after as many evaluations each; `converged`, (B,) bool, is whether x is finite by default."""
        counted = torch.full((len(x),), evaluations, dtype=torch.int64, device=x.device)
        return cls(wide(x), counted, finite(x) if converged is None else converged)


def last_of(states: Iterable[Tensor], progress: Call) -> Tensor:
    """Iterate over a sampler's states, calling `progress` after each; return the last one."""
    for state in states:
        progress()
        last = state
    return last


class Sampler(ABC):
    """How a generator is run. A subclass is a frozen dataclass in `SAMPLERS`; configs, checkpoints and the command line
    store its name and fields.
    """

    draws: ClassVar[bool] = False  #: whether the sampler is stochastic: it draws noise after x_0
    paired: ClassVar[bool] = True  #: whether x_1 depends on x_0 closely enough for a reflow pair (x_0, x_1)
    completes: ClassVar[bool] = False  #: whether a condition is required
    needs: ClassVar[str] = "velocity"  #: attribute that a generator must have

    @abstractmethod
    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        """Generate x_1 in model space, (B, C, H, W).

        Args:
            generator: A generator with the attribute `needs`.
            noise: (B, *noise_shape), on the generator's device, float32 or float64.
            draws: Noise of step j; required if `self.draws`.
            progress: Called after every network evaluation.
        """

    @property
    def name(self) -> str:
        """Name in `SAMPLERS`."""
        from r2flow.samplers import SAMPLERS

        return SAMPLERS.name_of(type(self))

    def evaluations(self, generator: Any) -> int | None:
        """Network evaluations per scan; None if they depend on the scans."""
        return getattr(self, "steps", None)

    def check(self, generator: Any) -> None:
        """Refuse a generator that the sampler cannot run."""
        drawn, kind = getattr(generator, "draws", True), type(generator).__name__
        if getattr(generator, self.needs, None) is None:
            check(drawn or generator.told, f"a {kind} draws no scans: give a model of its latents, a latent diffusion.")
            raise InputError(f"sampler {self.name} needs a generator with a {self.needs}; a {kind} has none.")
        anew = self.draws and self.needs in ("velocity", "map")  # others know what their generator starts from
        check(drawn or not anew, f"{self.name} adds noise of N(0, 1); a {kind} starts from other: give jump.")
        if getattr(generator, "fixed", False) and self != generator.sampler:
            raise InputError(f"this model is distilled for {generator.sampler} alone: use these, or its parent flow.")

    def changed(self, **options: Any) -> Self:
        """A copy with the options that are not None."""
        options = _plain(options)
        check_options(f"sampler '{self.name}'", type(self), {**self._fields(), **options})
        grid = getattr(self, "grid", None)
        if isinstance(grid, tuple) and options.get("steps", len(grid) - 1) != len(grid) - 1:
            options.setdefault("grid", options_of(type(self))["grid"])
        return replace(self, **options)  # type: ignore[type-var]

    def asdict(self) -> dict[str, Any]:
        """Name and fields as plain values, as stored in a config or a checkpoint."""
        return {"name": self.name, **self._fields()}

    def _fields(self) -> dict[str, Any]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        if values.get("method") == self.name:  # a solver's name is its method
            del values["method"]
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @property
    def text(self) -> str:
        """`NAME:FIELD=VALUE:...`, as `parse_sampler` reads it."""
        return ":".join([self.name, *(f"{key}={value}" for key, value in self._fields().items() if value is not None)])

    def __str__(self) -> str:
        steps = getattr(self, "steps", None)
        return self.name if steps is None else f"{self.name}, {steps} step{'s' * (steps > 1)}"


@dataclass(frozen=True)
class OnGrid(Sampler):
    """A sampler with fixed steps on a time grid."""

    steps: Steps = 32  # from t = 0 to t = 1
    grid: Grid = "uniform"  # a name (`r2flow.flow.solvers.named_grid`), or the times themselves

    def __post_init__(self) -> None:
        if isinstance(self.grid, list | tuple):
            object.__setattr__(self, "grid", tuple(float(t) for t in self.grid))
            steps = len(self.grid) - 1
            check(steps == self.steps, f"the time grid has {steps} steps, found steps={self.steps}.")
            check(not getattr(self, "finish", 0) or self.steps == 1, "a grid has its own last step: give finish=0.")
        self.times()

    def times(self) -> Tensor:
        """Time grid from 0 to 1, (steps + 1,) float64."""
        return build_grid(self.grid, 0.0, 1.0, self.steps)


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that are not None, with plain values for NumPy's and torch's, and `steps` of a grid of times."""
    plain = {k: v.tolist() if hasattr(v, "tolist") else v for k, v in options.items() if v is not None}
    grid = plain.get("grid")
    return plain if not isinstance(grid, list | tuple) else {**plain, "steps": plain.get("steps", len(grid) - 1)}
