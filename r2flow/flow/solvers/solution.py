"""Arguments and results of all solvers."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.path import expand_time

Velocity = Callable[[Tensor, Tensor], Tensor]
V = TypeVar("V", bound=Callable[..., Any])


@dataclass(frozen=True)
class Solution:
    """The state at t_1, its cost and its accuracy."""

    #: State at t_1, (B, ...), float32 (float64 if x_0 is); for a scene that has not converged, the last finite state.
    x: Tensor
    evaluations: Tensor  #: network evaluations per scene, (B,) int64, including those of the error estimate
    accepted: Tensor  #: steps taken per scene, (B,) int64
    rejected: Tensor  #: steps rejected per scene, (B,) int64; 0 for fixed steps
    stiff: Tensor  #: scenes whose steps were limited by stability, not by accuracy, (B,) bool; False if not detected
    converged: Tensor  #: scenes that reached t_1 with finite values, (B,) bool
    #: Estimated root mean square error over a scene's elements, (B,) float64; inf without an estimate for the scene;
    #: None if not requested.
    global_error: Tensor | None = None


class Limits(NamedTuple):
    """Options of a solver."""

    tolerance: float  #: requested absolute and relative tolerance of a step's error
    max_evaluations: int  #: budget per scene
    tighter: float = 1.0  #: divisor of the attainable tolerance
    max_step: float = 1.0  #: longest step as a share of the interval


class Spent(Exception):
    """A scene has used up its evaluations."""


class Evaluations:
    """The velocity as called by solvers, in the state's type, and the record of each scene's solution.

    A velocity that differs between scenes has a method `select(scenes)`, which returns the velocity of these scenes,
    int64 indices into its batch. The precision is the coarsest type among those of v, of the surrounding autocast, of a
    module's parameters and of the velocity's attribute `precision`, if any.

    Attributes:
        counts, accepted, rejected, stiff, converged: Those of `Solution`, (B,); methods set all but the counts.
        scenes: Scenes of the current state, indices into the batch.
        precision: Precision of the last evaluation.
    """

    def __init__(self, velocity: Velocity, scenes: int, progress: Callable[[], None] | None = None) -> None:
        self._whole = self._velocity = velocity
        self._progress = progress
        self.counts, self.accepted, self.rejected = np.zeros((3, scenes), dtype=np.int64)
        self.stiff, self.converged = np.zeros((2, scenes), dtype=bool)
        self.scenes = np.arange(scenes)
        self._own_types = _own_types(velocity)
        self.precision = torch.float64

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        self.counts[self.scenes] += 1
        v = self._velocity(t.clone(), x.clone())  # it may edit them in place
        if v.shape != x.shape:
            raise InputError(f"a velocity must have the state's shape {tuple(x.shape)}, found {tuple(v.shape)}.")
        self.precision = self.coarsest(v, x)
        if self._progress is not None:
            self._progress()
        return v.to(x.dtype, copy=True)  # a runtime may write each output into the same buffer

    def of_one(self, t: Tensor, x: Tensor, limits: Limits) -> Tensor:
        """v of a single scene; raises `Spent` if it has had `max_evaluations`."""
        if self.counts[self.scenes[0]] >= limits.max_evaluations:
            raise Spent("its evaluations are used up")
        return self(t, x)

    def some(self, places: np.ndarray, t: Tensor, x: Tensor) -> Tensor:
        """v of some scenes of the current state."""
        scenes = self.scenes
        if len(places) < len(scenes):
            self.only(scenes[places])
        try:
            return self(t, x)
        finally:
            if len(places) < len(scenes):
                self.only(scenes)

    def coarsest(self, *tensors: Tensor) -> torch.dtype:
        """The type with the fewest digits among those of the tensors, of autocast and of the velocity."""
        kind = tensors[0].device.type
        autocast = [torch.get_autocast_dtype(kind)] if torch.is_autocast_enabled(kind) else []
        return max([*(x.dtype for x in tensors), *autocast, *self._own_types], key=lambda dtype: torch.finfo(dtype).eps)

    def only(self, scenes: np.ndarray) -> None:
        """Set the scenes of the current state, indices into the original batch."""
        self.scenes = scenes
        self._velocity = selected(self._whole, torch.from_numpy(scenes))

    def solution(self, x: Tensor) -> Solution:
        counts = self.counts, self.accepted, self.rejected, self.stiff, self.converged
        evaluations, accepted, rejected, stiff, converged = (torch.from_numpy(count) for count in counts)
        return Solution(x, evaluations, accepted, rejected, stiff, converged)


def selected(velocity: V, scenes: Tensor) -> V:
    """The velocity of some scenes, (N,) int64: by its method `select`, if any."""
    select: Callable[[Tensor], V] | None = getattr(velocity, "select", None)
    return velocity if select is None else select(scenes)


def _own_types(velocity: Velocity) -> set[torch.dtype]:
    """Types of a module's parameters, and the attribute `precision`."""
    precision = getattr(velocity, "precision", None)
    types = {precision} if isinstance(precision, torch.dtype) else set()
    module = velocity if isinstance(velocity, torch.nn.Module) else getattr(velocity, "__self__", None)
    if isinstance(module, torch.nn.Module):
        types |= {parameter.dtype for parameter in module.parameters() if parameter.is_floating_point()}
    return types


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
    """States after a step, (B, ...), and which are still finite, (B,); non-finite scenes keep the last finite one."""
    alive = alive & finite(following)
    return torch.where(expand_time(alive, x), following, x), alive
