"""Step size control for many scenes at once, on the host and in float64."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Solution

SHRINK = 0.2  # smallest factor between one step size and the next
MEMORY = 0.04  # beta of the PI controller, the weight of the previous error: steadier steps at a stability limit
STIFF_AFTER, SMOOTH_AFTER = 15, 6  # Hairer: stiff after 15 such steps without 6 others in a row between them


class Limits(NamedTuple):
    """The options of a solution.

    Attributes:
        tolerance: Absolute and relative tolerance of one step's error, as asked for.
        max_evaluations: Budget of one scene.
        tighter: The tolerance used is the attainable one divided by this.
        max_step: Longest step as a share of the interval.
        finish: Length of the last part of the interval, which one Euler step takes.
    """

    tolerance: float
    max_evaluations: int
    tighter: float = 1.0
    max_step: float = 1.0
    finish: float = 0.0


class StepController:
    """Time, step size and step counts of every scene of a batch.

    The arrays have one entry for each scene still in the batch, except those that `solution` returns for all. Progress
    is a length from t_0, so that forward and backward in time are the same.
    """

    def __init__(
        self, scenes: np.ndarray, t_0: float, t_1: float, method: EmbeddedMethod, limits: Limits, eps: float
    ) -> None:
        self.method, self.limits, self.nodes = method, limits, np.array(method.nodes)[:, None]
        self.t_0, self.direction = t_0, math.copysign(1.0, t_1 - t_0)
        self.length = abs(t_1 - t_0) - limits.finish
        self.t_end = t_0 + self.direction * self.length if limits.finish else t_1
        self.low, self.high = sorted((t_0, self.t_end))
        self.longest = limits.max_step * self.length
        self.eps = eps
        self.scenes, self.places = scenes, np.arange(len(scenes))
        of = len(scenes)
        self.reached, self.h, self.grow = np.zeros(of), np.full(of, self.length), np.full(of, method.grow)
        self.last_error = np.full(of, 1e-4)  # dopri5.f
        self.stiff_run, self.smooth_run = np.zeros(of, int), np.zeros(of, int)
        self.arrived, self.leaving = np.zeros(of, bool), np.zeros(of, bool)
        self.accepted, self.rejected = np.zeros(of, int), np.zeros(of, int)
        self.stiff, self.converged = np.zeros(of, bool), np.zeros(of, bool)

    def time(self, reached: np.ndarray) -> np.ndarray:
        """t at a length from t_0, never beyond the end."""
        t = self.t_0 + self.direction * np.minimum(reached, self.length)
        t = np.where(reached >= self.length, self.t_end, t)
        return np.minimum(np.maximum(t, self.low), self.high)

    def shortest(self) -> np.ndarray:
        """Step sizes below which the stages' times are equal in the state's type, (B,)."""
        return 4 * self.eps * np.maximum(np.abs(self.time(self.reached)), 1e-3 * self.length)

    def now(self, x: Tensor) -> Tensor:
        """t of every scene, (B,), on the device and in the type of x."""
        return torch.from_numpy(self.time(self.reached)).to(x.device, x.dtype)

    def probe(self, state: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Time after and signed length of the Euler step that estimates the curvature, (2, B)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            h = np.where((state < 1e-5) | (slope < 1e-5), 1e-6 * self.length, 0.01 * state / slope)
        self.h = np.fmin(h, self.longest)
        return np.stack([self.time(self.h), self.direction * self.h])

    def start(self, slope: np.ndarray, change: np.ndarray, evaluations: np.ndarray) -> None:
        """The first step size, from |v| and its change over the probe; a scene whose v is not finite leaves."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            steepest = np.fmax(slope, change / self.h)
            h = np.where(steepest <= 1e-15, 1e3 * self.h, (0.01 / steepest) ** (1 / self.method.order))
        h = np.where(np.isfinite(h), np.minimum(100 * self.h, h), self.h)
        h = np.where(steepest == 0, self.longest, h)  # an untrained network's 0
        self.h = np.maximum(h, self.shortest()).astype(np.float32).astype(np.float64)
        self.leaving = ~np.isfinite(slope) | self._spent(evaluations)

    def propose(self) -> np.ndarray:
        """Times of the stages and signed steps, (stages + 1, B); the last two steps share the rest of the interval."""
        left = self.length - self.reached
        h = np.minimum(self.h, self.longest)
        h = np.where(1.01 * h >= left, left, np.where(2 * h > left, left / 2, h))
        self.h, self.following = h, np.where(h == left, self.length, self.reached + h)
        stages = self.time(np.where(self.nodes == 1, self.following, self.reached + self.nodes * h))
        return np.concatenate([stages, self.direction * h[None]])

    def judge(self, error: np.ndarray, dk: np.ndarray, dy: np.ndarray, evaluations: np.ndarray) -> np.ndarray:
        """Accept or reject every scene's step and choose its next step size.

        Args:
            error: Norm of the local error divided by the tolerance, (B,).
            dk, dy: Norms of the differences in v and x between the last two stages, (B,).
            evaluations: Evaluations so far, (B,).

        Returns:
            Whose step is accepted, (B,) bool.
        """
        finite = np.isfinite(error) & np.isfinite(dk) & np.isfinite(dy)
        good = finite & (error <= 1)
        self.accepted[self.places] += good
        self.rejected[self.places] += ~good
        self._look_for_stiffness(good, dk, dy)
        tried = self.h
        self.reached = np.where(good, self.following, self.reached)
        self.h = tried * self._factors(good, finite, error)
        self.grow = np.where(good, self.method.grow, 1.0)
        self.last_error = np.where(good, np.maximum(error, 1e-4), self.last_error)
        self.arrived = good & (self.reached >= self.length)
        stuck = (self.h < self.shortest()) & ~good
        self.leaving = self.arrived | stuck | self._spent(evaluations)
        return good

    def _spent(self, evaluations: np.ndarray) -> np.ndarray:
        return evaluations + self.method.stages > self.limits.max_evaluations

    def _factors(self, good: np.ndarray, finite: np.ndarray, error: np.ndarray) -> np.ndarray:
        """h_new / h = S err^-(1/q - 3/4 beta) err_before^beta, the PI controller of dopri5.f; 1/5 where not finite."""
        error = np.where(finite, np.maximum(error, 1e-10), np.inf)
        q = 1 / self.method.order
        steady = self.method.safety * error ** -(q - 0.75 * MEMORY) * self.last_error**MEMORY
        retry = self.method.safety * error ** -(q - 0.75 * MEMORY)
        factors = np.where(good, np.clip(steady, SHRINK, self.grow), np.clip(retry, SHRINK, 1.0))
        # Rounded as in `_norms`, so that a difference of one ulp is not carried on.
        return factors.astype(np.float32).astype(np.float64)

    def _look_for_stiffness(self, good: np.ndarray, dk: np.ndarray, dy: np.ndarray) -> None:
        """Hairer, Wanner, Solving Ordinary Differential Equations II, IV.2: h |dk| / |dy| estimates |h lambda|.

        Where it stays at the boundary of the stability region, stability limits the steps, not accuracy.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            touching = good & (self.h * dk > self.method.stability * dy)
        self.stiff_run += touching
        self.smooth_run = np.where(touching, 0, self.smooth_run + (good & ~touching))
        self.stiff_run = np.where(self.smooth_run >= SMOOTH_AFTER, 0, self.stiff_run)
        self.stiff[self.places] |= self.stiff_run >= STIFF_AFTER

    def keep(self, rest: np.ndarray) -> None:
        """Keep these scenes; of the others, note which have arrived."""
        self.converged[self.places] |= self.arrived
        for name in (
            "scenes", "places", "reached", "h", "grow", "last_error", "stiff_run", "smooth_run", "arrived", "leaving",
        ):  # fmt: skip
            setattr(self, name, getattr(self, name)[rest])

    def solution(self, x: Tensor, evaluations: np.ndarray) -> Solution:
        """The solution of all scenes from their final states."""
        return Solution.build(x, evaluations, self.accepted, self.rejected, self.stiff, self.converged)
