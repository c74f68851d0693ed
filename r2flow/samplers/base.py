"""What every sampler has in common: noise in, scans out, and its fields as plain values."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.grids import build_grid
from r2flow.flow.solvers.solution import Solution, finite, wide
from r2flow.registry import Bound, check_options, options_of

Condition = Mapping[str, Tensor]
"""Conditions of each scan by name: tensors of shape (B, ...)."""

Call = Callable[[], None]
Progress = Call | None
Noise = Callable[[int], Tensor]  # N(0, 1) of the j-th draw, j = 1, 2, ..., in the noise's shape
Given = Condition | None
Fresh = Noise | None
Steps = Annotated[int, Bound("from 1 to 1,000,000", lambda n: 1 <= n <= 10**6)]
Grid = str | list[float] | tuple[float, ...]


@dataclass(frozen=True)
class Generated:
    """Scans in model space.

    Attributes:
        x: x_1, (B, C, H, W), on the generator's device, float32 or float64.
        evaluations: Network evaluations of each scan, (B,) int64.
        converged: Whether each is finite and, for an adaptive method, solved, (B,) bool.
    """

    x: Tensor
    evaluations: Tensor
    converged: Tensor

    @classmethod
    def after(cls, x: Tensor, evaluations: int, converged: Tensor | None = None) -> Self:
        """Scans after the same number of evaluations.

        Args:
            converged: Whether each was finite all the way, (B,) bool; None: where x is finite.
        """
        counted = torch.full((len(x),), evaluations, dtype=torch.int64, device=x.device)
        x = wide(x)
        return cls(x, counted, finite(x) if converged is None else converged)


def last_of(states: Iterable[Tensor], progress: Call) -> Tensor:
    """The last of a sampler's states; calls `progress` after each."""
    for state in states:
        progress()
        last = state
    return last


class Sampler(ABC):
    """How a generator is run. A subclass is a frozen dataclass in `SAMPLERS`; name and fields are what a config, a
    checkpoint and a command line hold.

    Attributes:
        draws: Whether noise is drawn on the way.
        paired: Whether x_1 still belongs to its noise x_0, so that both can be a reflow pair.
        completes: Whether a condition is needed.
        needs: Attribute of the generators that the sampler can run.
    """

    draws: ClassVar[bool] = False
    paired: ClassVar[bool] = True
    completes: ClassVar[bool] = False
    needs: ClassVar[str] = "velocity"

    @abstractmethod
    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        """x_1 in model space, (B, C, H, W).

        Args:
            generator: One that has `needs`.
            noise: (B, *noise_shape), on the generator's device, float32 or float64.
            condition: Condition of each scan.
            draws: Noise of step j; given where `draws` is True.
            progress: Called after every evaluation of the network.
        """

    @property
    def name(self) -> str:
        """Its name in `SAMPLERS`."""
        from r2flow.samplers import SAMPLERS

        return SAMPLERS.name_of(type(self))

    def evaluations(self, generator: Any) -> int | None:
        """Network evaluations of a batch; None where they depend on the scans."""
        return getattr(self, "steps", None)

    def check(self, generator: Any) -> None:
        """Refuse a generator that the sampler cannot run."""
        if getattr(generator, self.needs, None) is None:
            kind = type(generator).__name__
            raise InputError(f"sampler {self.name} needs a generator with a {self.needs}, which a {kind} is not.")

    def solve(self, *args: Any, **options: Any) -> Solution:
        """The state at t_1 of the ODE, by an `ODESampler`."""
        raise InputError(f"sampler {self.name} does not follow the flow's paths: give a solver, such as adams3.")

    def knot_times(self, knots: int) -> Tensor:
        """Times of both ends and of the inner states that a solution keeps, (knots + 2,) float64."""
        raise InputError(f"sampler {self.name} keeps no inner states; give a solver of fixed steps, such as adams3.")

    def changed(self, **options: Any) -> Self:
        """The same sampler with the options that are not None."""
        options = {key: value.tolist() if hasattr(value, "tolist") else value for key, value in options.items()}
        options = {key: value for key, value in options.items() if value is not None}
        check_options(f"sampler '{self.name}'", type(self), {**self._fields(), **options})
        grid = getattr(self, "grid", None)
        if isinstance(grid, tuple) and options.get("steps", len(grid) - 1) != len(grid) - 1:
            options.setdefault("grid", options_of(type(self))["grid"])
        return replace(self, **_with_steps(options))  # type: ignore[type-var]

    def asdict(self) -> dict[str, Any]:
        """Name and fields as plain values, as a config or a checkpoint holds them."""
        return {"name": self.name, **self._fields()}

    def _fields(self) -> dict[str, Any]:
        values = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        if values.get("method") == self.name:  # a solver, whose name says it
            del values["method"]
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    def __str__(self) -> str:
        steps = getattr(self, "steps", None)
        return self.name if steps is None else f"{self.name}, {steps} step{'s' * (steps > 1)}"


@dataclass(frozen=True)
class OnGrid(Sampler):
    """A sampler that steps from time to time.

    Attributes:
        steps: Steps from t = 0 to t = 1.
        grid: Where they begin and end: a name (`r2flow.flow.solvers.named_grid`), or the times themselves.
    """

    steps: Steps = 32
    grid: Grid = "uniform"

    def __post_init__(self) -> None:
        if isinstance(self.grid, list | tuple):
            object.__setattr__(self, "grid", tuple(float(t) for t in self.grid))
            if len(self.grid) != self.steps + 1:
                raise InputError(f"the time grid has {len(self.grid) - 1} steps, found steps={self.steps}.")
        self.times()

    def times(self, t_0: float = 0.0, t_1: float = 1.0, fewer: int = 0) -> Tensor:
        """From t_0 to t_1, (steps - fewer + 1,) float64."""
        with torch.device("cpu"):  # also where weights are made on the meta device
            return build_grid(self.times_or_name, t_0, t_1, self.steps - fewer)

    @property
    def times_or_name(self) -> str | Tensor:
        """The grid as solvers take it."""
        return self.grid if isinstance(self.grid, str) else torch.tensor(self.grid, dtype=torch.float64)


def _with_steps(options: dict[str, Any]) -> dict[str, Any]:
    """Options in which given times decide the number of steps."""
    grid = options.get("grid")
    return options if not isinstance(grid, list | tuple) else {"steps": len(grid) - 1, **options}
