"""Step size control of all scenes of a batch, on the host in float64."""

import numpy as np
from numpy import ndarray

from r2flow.flow.solvers.batched import rounded
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations

_SHRINK = 0.2  # smallest factor between one step size and the next
# Beta of the PI controller, the weight of the previous error: steadier steps at a stability limit.
_MEMORY = 0.04
# Hairer: stiff after 15 touching steps without 6 other steps in a row between them.
_STIFF_AFTER = 15
_SMOOTH_AFTER = 6
# A pole: share of its size that x moves in a step, in short steps of this number of powers of ten.
_FAR = 0.02
_SHORT = 1e-3  # of the interval
_DECADES = 3


class StepController:
    """Time, step size and step counts of every scene of a batch.

    The arrays have one entry per scene still in the batch, `v.scenes`. Progress is measured as a
    length from t_0, which makes forward and backward in time equal.
    """

    def __init__(
        self, v: Evaluations, t_0: float, t_1: float, method: EmbeddedMethod, eps: float
    ) -> None:
        self.v = v
        self.method = method
        self.t_0 = t_0
        self.t_1 = t_1
        self.length = abs(t_1 - t_0)
        self.longest = v.limits.max_step * self.length
        self.direction = (t_1 - t_0) / self.length
        self.eps = eps
        n = len(v.scenes)
        self.reached = np.zeros(n)
        self.h = np.full(n, self.length)
        self.grow = np.full(n, method.grow)  # largest factor to the next step size
        self.last_error = np.full(n, 1e-4)  # dopri5.f
        # Steps at the bound of stability; others in a row since; bit k: a step of about 10^-k of
        # the interval moved x far.
        self.touched, self.calm, self.decades = np.zeros((3, n), int)
        self.arrived, self.shorten = np.zeros((2, n), bool)

    def time(self, reached: ndarray) -> ndarray:
        """t at a length from t_0, clipped to the interval."""
        t = np.where(reached >= self.length, self.t_1, self.t_0 + self.direction * reached)
        return t.clip(min(self.t_0, self.t_1), max(self.t_0, self.t_1))

    def shortest(self) -> ndarray:
        """Smallest step sizes, (B,): below them the stages' times are equal in the state's type."""
        return 4 * self.eps * np.maximum(np.abs(self.time(self.reached)), 1e-3 * self.length)

    def start(self, state: ndarray, slope: ndarray) -> None:
        """Set the first step size from the norms of x and v in tolerances; not finite: leave.

        Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4, without the
        evaluation for the second derivative, since steps that are too long are rejected.
        """
        moved = np.where(state < 1e-5, np.inf, state / slope)
        h = np.fmin((0.01 / slope) ** (1 / self.method.order), moved)
        self.h = rounded(np.maximum(np.fmin(h, self.longest), self.shortest()))
        self.leaving = ~np.isfinite(slope) | (self.budget() < len(self.method.rows))

    def propose(self) -> ndarray:
        """Times of the stages and signed steps, (stages + 1, B).

        The last two steps before the end are of equal length.
        """
        left = self.length - self.reached
        h = np.minimum(self.h, self.longest)
        shared = np.where(2 * h > left, left / 2, h)
        h = np.where(1.01 * h >= left, left, shared)
        self.h = h
        self.following = np.where(h == left, self.length, self.reached + h)
        nodes = np.array(self.method.nodes)[:, None]
        stages = self.time(np.where(nodes == 1, self.following, self.reached + nodes * h))
        return np.vstack([stages, self.direction * h])

    def within(self, error: ndarray, dk: ndarray, dy: ndarray, size: ndarray) -> ndarray:
        """Which steps are finite and within the tolerance, (B,) bool.

        If the stages differ by more than the state's size 1 + |x|, a pole makes the error estimate
        meaningless.
        """
        return (error <= 1) & np.isfinite(dk) & (dy <= size)

    def budget(self) -> ndarray:
        """Number of evaluations that every scene has left, (B,)."""
        used: ndarray = self.v.counts[self.v.scenes]
        return self.v.limits.max_evaluations - used

    def note_poles(self, good: ndarray, speed: ndarray, size: ndarray, back: ndarray) -> None:
        """Give up scenes whose path does not shorten with the step, which indicates a pole.

        Near a non-integrable pole, such as 1 / (t - a), steps of 1e-4, 1e-5 and 1e-6 of the
        interval all move x by the same share |h v| / |1 + |x|| of its size, and a step that
        straddles the pole by chance can meet a loose tolerance. If v points back at the end of the
        step, one power of ten less is required. `speed` is the norm of v, `size` that of 1 + |x|.
        """
        short = good & (self.h < _SHORT * self.length)
        far = self.h * speed > _FAR * size
        decade = 2 ** np.floor(-np.log10(self.h / self.length)).astype(int)
        self.decades |= np.where(short & far, decade, 0)
        seen = np.array([int(decades).bit_count() for decades in self.decades])
        self.lost = short & (seen >= _DECADES - (back & far))

    def judge(self, good: ndarray, error: ndarray, dk: ndarray, dy: ndarray) -> None:
        """Accept the good steps, reject the others, and set every scene's next step size.

        `error` is the norm of the local error in tolerances; `dk` and `dy` are the norms of the
        differences of v and x between the last two stages.
        """
        self.v.accepted[self.v.scenes] += good
        self.v.rejected[self.v.scenes] += ~good
        self._look_for_stiffness(good, dk, dy)
        self.reached = np.where(good, self.following, self.reached)
        h = self.h * self._factors(good, np.where(np.isfinite(dk + dy), error, np.inf))
        self.grow = np.where(good, self.method.grow, 1.0)
        self.last_error = np.where(good, np.maximum(error, 1e-4), self.last_error)
        stuck = ~good & (h < self.shortest())
        self.h = h
        self.arrived = good & (self.reached >= self.length) & ~self.lost
        spent = self.budget() < len(self.method.rows)
        self.leaving = self.arrived | stuck | spent | self.lost

    def keep(self, rest: ndarray) -> None:
        """Keep these scenes in the batch; record convergence of all."""
        self.v.converged[self.v.scenes] |= self.arrived
        self.v.only(self.v.scenes[rest])
        for name, value in vars(self).items():
            if isinstance(value, ndarray):
                setattr(self, name, value[rest])

    def _factors(self, good: ndarray, error: ndarray) -> ndarray:
        """h_new / h = S err^-(1/q - 3/4 beta) err_before^beta, the PI controller of dopri5.f."""
        error = np.where(np.isfinite(error), np.maximum(error, 1e-10), np.inf)
        retry = self.method.safety * error ** -(1 / self.method.order - 0.75 * _MEMORY)
        shorter = np.where(self.shorten, _SHRINK, retry.clip(_SHRINK, 1.0))
        longer = (retry * self.last_error**_MEMORY).clip(_SHRINK, self.grow)
        return rounded(np.where(good, longer, shorter))

    def _look_for_stiffness(self, good: ndarray, dk: ndarray, dy: ndarray) -> None:
        """Detect steps limited by stability.

        h |dk| / |dy|, an estimate of |h lambda|, stays at the boundary of the stability region
        (Hairer, Wanner, Solving Ordinary Differential Equations II, IV.2).
        """
        touching = good & (self.h * dk > self.method.stability * dy)
        self.calm = np.where(touching, 0, self.calm + (good & ~touching))
        self.touched = np.where(self.calm >= _SMOOTH_AFTER, 0, self.touched + touching)
        self.v.stiff[self.v.scenes] |= self.touched >= _STIFF_AFTER
