"""What every solver takes and gives back."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

Velocity = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Solution:
    """The end of the path, what it cost and how far it can be trusted.

    Attributes:
        x: State at t_1, (B, ...), float32 (float64 when the start was); of a scene that has not converged, its last
            finite state.
        evaluations: Network evaluations per scene, (B,) int64, those of the error estimate included.
        accepted: Steps taken per scene, (B,) int64.
        rejected: Steps tried in vain per scene, (B,) int64; 0 for fixed steps.
        stiff: Scenes whose steps stability rather than accuracy held short, (B,) bool; False where not looked for.
        converged: Scenes that reached t_1 with finite values, (B,) bool.
        global_error: Estimated root mean square error over a scene's elements, (B,) float64; inf where no estimate
            could be had; None when not asked for.
        estimate_evaluations: What the estimate cost of these evaluations, (B,) int64; None when not asked for.
    """

    x: Tensor
    evaluations: Tensor
    accepted: Tensor
    rejected: Tensor
    stiff: Tensor
    converged: Tensor
    global_error: Tensor | None = None
    estimate_evaluations: Tensor | None = None

    @classmethod
    def build(cls, x: Tensor, evaluations: np.ndarray, accepted: Any, rejected: Any, stiff: Any, converged: Any):  # type: ignore[no-untyped-def]
        """From one number for all scenes or an array of them."""
        of = len(x)
        counts = [torch.from_numpy(np.broadcast_to(n, of).astype(np.int64)) for n in (evaluations, accepted, rejected)]
        flags = [torch.from_numpy(np.broadcast_to(flag, of).astype(bool)) for flag in (stiff, converged)]
        return cls(x, *counts, *flags)

    def shaped(self, shape: torch.Size) -> "Solution":
        """The same with the scenes of x in another shape."""
        return replace(self, x=self.x.view(shape))


class Evaluations:
    """The velocity as solvers call it: counted per scene, in the state's type whatever the network computes in.

    A velocity that treats every scene in a way of its own has a method `select(scenes)`, which returns the velocity
    of these scenes alone, int64 indices into the batch that it was made for. It is called when scenes leave.

    What it was computed in is the coarsest of its type, the autocast around it, the parameters of a module (whose
    answer may come in x's type) and, where it has one, its attribute `precision`.

    Args:
        velocity: v(t, x) with x of shape (B, ...) and t of shape () or (B,).
        scenes: Size of the batch.
        progress: Called after every evaluation.

    Attributes:
        counts: Evaluations of every scene of the batch, (B,).
        scenes: Those that the state holds at present, indices into the batch.
        precision: What the velocity was last computed in.
    """

    def __init__(self, velocity: Velocity, scenes: int, progress: Callable[[], None] | None = None) -> None:
        self._whole = self._velocity = velocity
        self._progress = progress
        self.counts = np.zeros(scenes, dtype=np.int64)
        self.scenes = np.arange(scenes)
        self._own_types = _own_types(velocity)
        self.precision = torch.float64

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        self.counts[self.scenes] += 1
        v = self._velocity(t, x)
        if v.shape != x.shape:
            raise ValueError(
                f"the velocity of a state {tuple(x.shape)} at times {tuple(t.shape)} must have the state's shape, "
                f"found {tuple(v.shape)}. Does it expand t, one time for each scene?"
            )
        self.precision = self.coarsest(v, x)
        if self._progress is not None:
            self._progress()
        return v.to(x.dtype)

    def coarsest(self, *tensors: Tensor) -> torch.dtype:
        """The type with the fewest digits, among those of the tensors and of what is at work behind the velocity."""
        kind = tensors[0].device.type
        around = [torch.get_autocast_dtype(kind)] if torch.is_autocast_enabled(kind) else []
        return max([*(x.dtype for x in tensors), *around, *self._own_types], key=lambda dtype: torch.finfo(dtype).eps)

    def only(self, scenes: np.ndarray) -> None:
        """From now on the state holds these scenes, indices into the original batch."""
        self.scenes = scenes
        select = getattr(self._whole, "select", None)
        if select is not None:
            self._velocity = select(torch.from_numpy(scenes))


def _own_types(velocity: Velocity) -> set[torch.dtype]:
    """The types that a velocity shows without being asked: of a module's parameters, and what it says itself."""
    said = getattr(velocity, "precision", None)
    types = {said} if isinstance(said, torch.dtype) else set()
    module = velocity if isinstance(velocity, torch.nn.Module) else getattr(velocity, "__self__", None)
    if isinstance(module, torch.nn.Module):
        types |= {parameter.dtype for parameter in module.parameters() if parameter.is_floating_point()}
    return types


def finite(x: Tensor) -> Tensor:
    """Which scenes of x, (B, ...), hold no NaN and no infinity, (B,) bool."""
    return torch.isfinite(x).flatten(1).all(1)
