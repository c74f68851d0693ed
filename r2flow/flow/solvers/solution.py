"""Arguments and results of all solvers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.flow.path import expand_time

Velocity = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Solution:
    """The state at t_1, its cost and its accuracy."""

    #: State at t_1, (B, ...), float32 (float64 if x_0 is); for a scene that has not converged, the
    #: last finite state.
    x: Tensor
    #: Network evaluations per scene, (B,) int64, including those of the error estimate.
    evaluations: Tensor
    accepted: Tensor  #: steps taken per scene, (B,) int64
    rejected: Tensor  #: steps rejected per scene, (B,) int64; 0 for fixed steps
    #: Scenes whose steps were limited by stability, not by accuracy, (B,) bool; False if not
    #: detected.
    stiff: Tensor
    converged: Tensor  #: scenes that reached t_1 with finite values, (B,) bool
    #: Estimated root mean square error over a scene's elements, (B,) float64; inf without an
    #: estimate for the scene; None if not requested.
    global_error: Tensor | None = None


class Limits(NamedTuple):
    """Options of an adaptive method."""

    tolerance: float  #: requested absolute and relative tolerance of a step's error
    max_evaluations: int  #: budget per scene
    max_step: float  #: longest step as a share of the interval
    tighter: float = 1.0  #: divisor of the attainable tolerance


class Spent(Exception):
    """A scene has used up its evaluations."""


class Evaluations:
    """The velocity as called by solvers, in the state's type, and the record of each solution.

    A velocity that differs between scenes has a method `select(scenes)`, which returns the velocity
    of these scenes, int64 indices into its batch. The precision is the coarsest type among those of
    v, of the surrounding autocast, of a module's parameters and of the velocity's attribute
    `precision`, if any.

    Attributes:
        counts, accepted, rejected, stiff, converged: Those of `Solution`, (B,); methods set all but
            the counts.
        scenes: Scenes of the current state, indices into the batch.
        precision: Precision of the last evaluation.
    """

    def __init__(
        self,
        velocity: Velocity,
        scenes: int,
        limits: Limits,
        progress: Callable[[], None] | None = None,
    ) -> None:
        self.limits = limits
        self._whole = self._velocity = velocity
        self._progress = progress
        self.counts, self.accepted, self.rejected = np.zeros((3, scenes), dtype=np.int64)
        self.stiff, self.converged = np.zeros((2, scenes), dtype=bool)
        self.scenes = np.arange(scenes)
        self._types = _types_of(velocity)
        self.precision = torch.float64

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        self.counts[self.scenes] += 1
        v = self._velocity(t.clone(), x.clone())  # it may edit them in place
        if v.shape != x.shape:
            raise InputError(f"a velocity must have the state's shape {x.shape}, found {v.shape}.")
        self.precision = self.coarsest(v, x)
        if self._progress is not None:
            self._progress()
        return v.to(x.dtype, copy=True)  # a runtime may write each output into the same buffer

    def of_one(self, t: Tensor, x: Tensor) -> Tensor:
        """v of a single scene; raises `Spent` if it has had `max_evaluations`."""
        if self.counts[self.scenes[0]] >= self.limits.max_evaluations:
            raise Spent("its evaluations are used up")
        return self(t, x)

    def some(self, places: ndarray, t: Tensor, x: Tensor) -> Tensor:
        scenes = self.scenes
        self.only(scenes[places])
        v = self(t, x)
        self.only(scenes)
        return v

    def coarsest(self, *tensors: Tensor) -> torch.dtype:
        """The type of fewest digits among those of tensors, autocast and velocity."""
        types = [x.dtype for x in tensors] + self._types
        kind = tensors[0].device.type
        if torch.is_autocast_enabled(kind):
            types.append(torch.get_autocast_dtype(kind))
        return max(types, key=lambda dtype: torch.finfo(dtype).eps)

    def only(self, scenes: ndarray) -> None:
        """Set the scenes of the current state, indices into the original batch."""
        self.scenes = scenes
        self._velocity = selected(self._whole, torch.from_numpy(scenes))

    def solution(self, x: Tensor) -> Solution:
        record = (self.counts, self.accepted, self.rejected, self.stiff, self.converged)
        return Solution(x, *map(torch.from_numpy, record))


def selected(velocity: Any, scenes: Tensor) -> Any:
    """The velocity of some scenes, (N,) int64: by its method `select`, if any."""
    return velocity.select(scenes) if hasattr(velocity, "select") else velocity


def _types_of(velocity: Velocity) -> list[torch.dtype]:
    """Types of a module's parameters, and the attribute `precision`."""
    module = getattr(velocity, "__self__", velocity)
    parameters = module.parameters() if isinstance(module, torch.nn.Module) else ()
    types = {parameter.dtype for parameter in parameters if parameter.is_floating_point()}
    return [*types, getattr(velocity, "precision", torch.float64)]


def finite(x: Tensor) -> Tensor:
    """Which scenes of x, (B, ...), are finite, (B,) bool."""
    return flat(torch.isfinite(x)).all(1)


def flat(x: Tensor) -> Tensor:
    """Reshape x, (B, ...), to (B, N); N = 1 for (B,); B may be 0."""
    return x.reshape(len(x), math.prod(x.shape[1:]))


def wide(x: Tensor) -> Tensor:
    """x in at least float32: small steps are lost in types of fewer digits."""
    return x if x.dtype == torch.float64 else x.float()


def stepped(x: Tensor, following: Tensor, alive: Tensor) -> tuple[Tensor, Tensor]:
    """States after a step, (B, ...), the last finite ones, and which are still finite, (B,)."""
    alive = alive & finite(following)
    return torch.where(expand_time(alive, x), following, x), alive
