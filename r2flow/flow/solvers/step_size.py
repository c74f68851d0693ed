"""Step size control of all scenes of a batch, on the host in float64."""

import numpy as np
from numpy import ndarray

from r2flow.flow.solvers.batched import rounded
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations

SHRINK = 0.2  # smallest factor between one step size and the next
REMEMBERED = 3  # steps for which a rejection makes a jump likely
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
        self.reached, self.resume = np.zeros((2, n))
        self.h = np.full(n, self.length)
        self.grow = np.full(n, method.grow)  # largest factor to the next step size
        self.last_error = np.full(n, 1e-4)  # dopri5.f
        # Steps at the bound of stability; others in a row since; steps for which a rejection is
        # remembered; bit k: a step of about 10^-k of the interval moved x far.
        self.touched, self.calm, self.troubled, self.decades = np.zeros((4, n), int)
        # A jump of the velocity: its bracket, as lengths from t_0, and the step size after it
        # (`resume`). Steps end at both ends of the bracket.
        self.begin, self.end = np.full((2, n), np.inf)
        self.arrived = np.zeros(n, bool)
        # Lengths at which rejected steps saw most, a tuple for each scene.
        self.memories = np.empty(n, object)
        self.memories.fill(())
        # Third differences: of this step, and of the last one over h^4.
        self.roughness, self.rough = np.full((2, n), np.nan)

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

        The last two steps before the end, or before a jump, are of equal length.
        """
        goal = np.minimum(self.length, self.begin)
        left = goal - self.reached
        h = np.minimum(self.h, self.longest)
        shared = np.where(2 * h > left, left / 2, h)
        h = np.where(1.01 * h >= left, left, shared)
        self.h = h
        self.following = np.where(h == left, goal, self.reached + h)
        self.factor = np.full_like(h, np.inf)  # largest one from a rejected step to the next
        nodes = np.array(self.method.nodes)[:, None]
        stages = self.time(np.where(nodes == 1, self.following, self.reached + nodes * h))
        return np.vstack([stages, self.direction * h])

    def within(self, error: ndarray, dk: ndarray, dy: ndarray, size: ndarray) -> ndarray:
        """Which steps are finite and within the tolerance, (B,) bool.

        If the stages differ by more than the state's size 1 + |x|, a pole makes the error estimate
        meaningless.
        """
        pole = ~(dy <= size)
        self.factor[pole] = SHRINK
        return (error <= 1) & np.isfinite(dk) & ~pole

    def rougher(self, least: float, by: float) -> ndarray:
        """Whether the third difference exceeds `least`, and `by` times the last one's, (B,)."""
        expected = self.roughness <= by * self.rough * self.h**4
        return (self.roughness > least) & ~expected & ~self.v.stiff[self.v.scenes]

    def budget(self) -> ndarray:
        """Number of evaluations that every scene has left, (B,)."""
        used: ndarray = self.v.counts[self.v.scenes]
        return self.v.limits.max_evaluations - used

    def shorten(self, place: int, share: float) -> None:
        """Reject a scene's step; retry with about this share of its length."""
        self.factor[place] = min(max(share, SHRINK), 0.7)

    def remember(self, place: int, share: float) -> None:
        self.memories[place] += (self.reached[place] + share * self.h[place],)

    def remembered(self, place: int) -> list[float]:
        """The noted times within a scene's step, in shares of it."""
        thetas = (np.array(self.memories[place]) - self.reached[place]) / self.h[place]
        return thetas[(thetas > 0) & (thetas < 1)].tolist()

    def stop_at(self, place: int, left: float, right: float) -> None:
        """Note a jump of a scene's velocity between two shares of its step."""
        h = self.h[place]
        self.begin[place] = self.reached[place] + left * h
        self.end[place] = self.reached[place] + right * h
        self.resume[place] = h

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
        self.troubled = np.where(good, np.maximum(self.troubled - 1, 0), REMEMBERED)
        self.grow = np.where(good, self.method.grow, 1.0)
        self.last_error = np.where(good, np.maximum(error, 1e-4), self.last_error)
        shortest = self.shortest()
        at_jump = self.begin - self.reached <= shortest
        behind = at_jump & (self.end == np.inf)
        stuck = ~good & (h < shortest) & (self.end == np.inf)
        self.rough = np.where(good & ~behind, self.roughness / self.h**4, self.rough)
        self.h = np.where(behind, self.resume, h)
        self.begin = np.where(at_jump, self.end, self.begin)
        self.end = np.where(at_jump, np.inf, self.end)
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
        shorter = np.minimum(retry.clip(SHRINK, 1.0), self.factor)
        longer = (retry * self.last_error**_MEMORY).clip(SHRINK, self.grow)
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
