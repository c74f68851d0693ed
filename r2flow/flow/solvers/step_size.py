"""Step size control of all scenes of a batch, on the host in float64."""

import math

import numpy as np

from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations, Limits

SHRINK = 0.2  # smallest factor between one step size and the next
MEMORY = 0.04  # beta of the PI controller, the weight of the previous error: steadier steps at a stability limit
REMEMBERED = 3  # steps for which a rejection makes a jump likely
STIFF_AFTER, SMOOTH_AFTER = 15, 6  # Hairer: stiff after 15 touching steps without 6 other steps in a row between them
FAR, DECADES = 0.02, 3  # share of its size that x moves in a step; number of powers of ten of h that indicate a pole


class StepController:
    """Time, step size and step counts of every scene of a batch.

    The arrays have one entry per scene still in the batch, `v.scenes`. Progress is measured as a length from t_0, which
    makes forward and backward in time equal.
    """

    def __init__(
        self, v: Evaluations, t_0: float, t_1: float, method: EmbeddedMethod, limits: Limits, eps: float
    ) -> None:
        n, self.v = len(v.scenes), v
        self.method, self.limits, self.nodes = method, limits, np.array(method.nodes)[:, None]
        self.t_0, self.direction = t_0, math.copysign(1.0, t_1 - t_0)
        self.length, self.t_end = abs(t_1 - t_0), t_1
        self.low, self.high = sorted((t_0, t_1))
        self.longest = limits.max_step * self.length
        self.eps = eps
        self.reached, self.h, self.grow = np.zeros(n), np.full(n, self.length), np.full(n, method.grow)
        self.last_error = np.full(n, 1e-4)  # dopri5.f
        self.touched, self.calm = np.zeros((2, n), int)  # steps at the bound of stability, others in a row since
        self.arrived, self.leaving = np.zeros(n, bool), np.zeros(n, bool)
        # A jump of the velocity: its bracket, as lengths from t_0, and the step size after it.
        self.begin, self.end, self.resume = np.full(n, np.inf), np.full(n, np.inf), np.zeros(n)
        self.crossing = np.zeros(n, bool)
        self.roughness, self.rough = np.zeros(n), np.full(n, np.nan)  # third difference; of the last step, over h^4
        self.troubled = np.zeros(n, int)  # steps for which a rejection is remembered
        self.decades = np.zeros(n, int)  # of the length of short steps that moved x far: one bit per power of ten
        self.factor = np.full(n, np.inf)  # from a rejected step to the next one

    def time(self, reached: np.ndarray) -> np.ndarray:
        """t at a length from t_0, clipped to the interval."""
        t = self.t_0 + self.direction * np.minimum(reached, self.length)
        t = np.where(reached >= self.length, self.t_end, t)
        return np.clip(t, self.low, self.high)

    def shortest(self) -> np.ndarray:
        """Smallest step sizes, (B,): below them the stages' times are equal in the state's type."""
        return 4 * self.eps * np.maximum(np.abs(self.time(self.reached)), 1e-3 * self.length)

    def start(self, state: np.ndarray, slope: np.ndarray) -> None:
        """Set the first step size from the norms of x and v in tolerances; scenes with a non-finite v leave.

        Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4, without the evaluation for the second
        derivative, since steps that are too long are rejected.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            h = np.fmin((0.01 / slope) ** (1 / self.method.order), np.where(state < 1e-5, np.inf, state / slope))
        self.h = np.maximum(np.fmin(h, self.longest), self.shortest()).astype(np.float32).astype(np.float64)
        self.leaving = ~np.isfinite(slope) | self._spent()

    def propose(self) -> np.ndarray:
        """Times of the stages and signed steps, (stages + 1, B).

        The last two steps before the end, or before a jump, are of equal length.
        """
        goal = np.minimum(self.length, self.begin)
        left = goal - self.reached
        h = np.minimum(self.h, self.longest)
        h = np.where(1.01 * h >= left, left, np.where(2 * h > left, left / 2, h))
        self.h, self.following = h, np.where(h == left, goal, self.reached + h)
        stages = self.time(np.where(self.nodes == 1, self.following, self.reached + self.nodes * h))
        return np.concatenate([stages, self.direction * h[None]])

    def within(self, error: np.ndarray, dk: np.ndarray, dy: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Which steps are finite and within the tolerance, (B,) bool.

        If the stages differ by more than the state's size 1 + |x|, a pole makes the error estimate meaningless.
        """
        pole = ~(dy <= size)
        self.factor[pole] = SHRINK
        return (error <= 1) & np.isfinite(dk) & ~pole

    def rougher(self, least: float, by: float) -> np.ndarray:
        """Whether the third difference exceeds `least`, and `by` times its extrapolation from the last step, (B,)."""
        with np.errstate(invalid="ignore", over="ignore"):
            exceeds: np.ndarray = (self.roughness > least) & ~(self.roughness <= by * self.rough * self.h**4)
        return exceeds & ~self.v.stiff[self.v.scenes]

    def able(self, places: np.ndarray) -> np.ndarray:
        """Which of these scenes have budget for one more evaluation, (N,) bool."""
        return np.asarray(self.v.counts[self.v.scenes[places]] < self.limits.max_evaluations)

    def shorten(self, place: int, share: float) -> None:
        """Reject a scene's step; retry with about this share of its length."""
        self.factor[place] = min(max(share, SHRINK), 0.7)

    def stop_at(self, place: int, left: float, right: float) -> None:
        """Note a jump of a scene's velocity between two shares of its step."""
        h = self.h[place]
        self.begin[place], self.end[place] = (self.reached[place] + share * h for share in (left, right))
        self.resume[place] = h

    def judge(self, good: np.ndarray, error: np.ndarray, dk: np.ndarray, dy: np.ndarray) -> None:
        """Accept the good steps, reject the others, and set every scene's next step size.

        `error` is the norm of the local error in tolerances; `dk` and `dy` are the norms of the differences of v and x
        between the last two stages.
        """
        finite = np.isfinite(error) & np.isfinite(dk) & np.isfinite(dy)
        self.v.accepted[self.v.scenes] += good
        self.v.rejected[self.v.scenes] += ~good
        self._look_for_stiffness(good, dk, dy)
        tried = self.h
        self.reached = np.where(good, self.following, self.reached)
        self.h = tried * self._factors(good, finite, error)
        self.rough = np.where(good, self.roughness / tried**4, self.rough)
        self.troubled = np.where(good, np.maximum(self.troubled - 1, 0), REMEMBERED)
        self.factor = np.full_like(self.factor, np.inf)
        self.grow = np.where(good, self.method.grow, 1.0)
        self.last_error = np.where(good, np.maximum(error, 1e-4), self.last_error)
        spent = self._spent()
        self.crossing = (self.begin - self.reached <= self.shortest()) & ~spent
        self.arrived = good & (self.reached >= self.length) & ~self.crossing
        stuck = (self.h < self.shortest()) & ~good & (self.begin == np.inf)
        self.leaving = self.arrived | stuck | spent

    def note_pole(self, places: np.ndarray, h: np.ndarray, share: np.ndarray, back: np.ndarray) -> None:
        """Give up scenes whose path does not shorten with the step, which indicates a pole.

        Near a non-integrable pole, such as 1 / (t - a), steps of 1e-4, 1e-5 and 1e-6 of the interval all move x by the
        same share |h v| / |1 + |x|| of its size, and a step that straddles the pole by chance can meet a loose
        tolerance. If v points back at the end of the step, one power of ten less is required.
        """
        decade = 2 ** np.floor(-np.log10(h / self.length)).astype(int)
        self.decades[places] |= np.where(share > FAR, decade, 0)
        seen = np.array([int(decades).bit_count() for decades in self.decades[places]])
        self.give_up(places[seen >= DECADES - (back & (share > FAR))])

    def cross(self) -> np.ndarray:
        """Move scenes across their jump; returns the time after it and the signed length of the crossing, (2, N)."""
        begin, end = self.reached[self.crossing], np.minimum(self.end[self.crossing], self.length)
        self.reached[self.crossing], self.h[self.crossing] = end, self.resume[self.crossing]
        self.begin[self.crossing] = self.end[self.crossing] = np.inf
        self.arrived |= self.crossing & (self.reached >= self.length)
        self.leaving |= self.arrived
        self.grow[self.crossing] = 1.0
        return np.stack([self.time(end), self.direction * (end - begin)])

    def give_up(self, places: np.ndarray) -> None:
        """Remove these scenes from the batch without convergence."""
        self.arrived[places], self.leaving[places] = False, True

    def _spent(self) -> np.ndarray:
        return self.v.counts[self.v.scenes] + len(self.method.rows) > self.limits.max_evaluations

    def _factors(self, good: np.ndarray, finite: np.ndarray, error: np.ndarray) -> np.ndarray:
        """h_new / h = S err^-(1/q - 3/4 beta) err_before^beta, the PI controller of dopri5.f; 1/5 if not finite."""
        error = np.where(finite, np.maximum(error, 1e-10), np.inf)
        q = 1 / self.method.order
        retry = self.method.safety * error ** -(q - 0.75 * MEMORY)
        shorter = np.minimum(np.clip(retry, SHRINK, 1.0), self.factor)
        factors = np.where(good, np.clip(retry * self.last_error**MEMORY, SHRINK, self.grow), shorter)
        # Rounded as in `norms`, so that differences of one ulp do not propagate.
        return factors.astype(np.float32).astype(np.float64)

    def _look_for_stiffness(self, good: np.ndarray, dk: np.ndarray, dy: np.ndarray) -> None:
        """Detect steps limited by stability: h |dk| / |dy|, an estimate of |h lambda|, stays at the boundary of the
        stability region (Hairer, Wanner, Solving Ordinary Differential Equations II, IV.2)."""
        with np.errstate(invalid="ignore", over="ignore"):
            touching = good & (self.h * dk > self.method.stability * dy)
        self.calm = np.where(touching, 0, self.calm + (good & ~touching))
        self.touched = np.where(self.calm >= SMOOTH_AFTER, 0, self.touched + touching)
        self.v.stiff[self.v.scenes] |= self.touched >= STIFF_AFTER

    def keep(self, rest: np.ndarray) -> None:
        """Keep these scenes in the batch; record convergence of all."""
        self.v.converged[self.v.scenes] |= self.arrived
        self.v.only(self.v.scenes[rest])
        for name in (
            "reached", "h", "grow", "last_error", "touched", "calm", "arrived", "leaving", "begin", "end",
            "resume", "crossing", "rough", "troubled", "factor", "decades",
        ):  # fmt: skip
            setattr(self, name, getattr(self, name)[rest])
