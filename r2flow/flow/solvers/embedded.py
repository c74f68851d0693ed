"""Tableaus of embedded Runge-Kutta methods."""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from torch import Tensor

from r2flow.flow.solvers.solution import Evaluations, Solution


@dataclass(frozen=True)
class EmbeddedMethod:
    """Butcher tableau of an explicit embedded method; its last stage is the next one's first.

    Its last two stages are at the same t; stiffness detection compares them.
    """

    adapts = True  # whether step sizes follow from a tolerance

    order: int  # of the propagated solution
    nodes: tuple[float, ...]  # c_i of stages 2 to s
    rows: tuple[tuple[float, ...], ...]  # a_ij of stages 2 to s; the last row is the new state
    error: tuple[float, ...]  # b_i - b*_i, the weights of the error estimate
    safety: float  # factor of the step size controller
    grow: float  # largest factor between one step size and the next
    # |h lambda| of stiff steps: near the end of the stability region on the negative real axis.
    stability: float
    bump: tuple[float, ...]  # d_i, the weights of the quartic term of the interpolant
    # Stages of the third divided difference, the roughness of v along a step.
    rough: tuple[int, int, int, int]
    # Largest of a step in tolerances: several times that of accurate steps of the exact problems.
    defect: float

    @np.errstate(all="ignore")
    def solve(self, v: Evaluations, x: Tensor, times: Tensor) -> Solution:
        """Solve every scene of x, (B, ...), from the first time to the last with its own steps."""
        from r2flow.flow.solvers.adaptive import advance

        t_0, t_1 = times.tolist()
        return v.solution(advance(v, x, t_0, t_1, self))

    @property
    def distinct(self) -> dict[float, int]:
        """The stage at each time of the step, the last one of several, in increasing time."""
        return dict(sorted({c: i for i, c in enumerate((0.0, *self.nodes))}.items()))

    @property
    def third_difference(self) -> list[float]:
        """Weights of the stages that annihilate quadratic functions of t; the largest is 1."""
        times = np.array((0.0, *self.nodes))
        weights = np.zeros_like(times)
        stages = list(self.rough)
        weights[stages] = np.linalg.inv(np.vander(times[stages], increasing=True))[-1]
        return (weights / np.abs(weights).max()).tolist()

    def interpolant(self, theta: ndarray) -> ndarray:
        """w_i and dw_i / dtheta of x + h sum_i w_i(theta) k_i, (2, stages + 1, B).

        Cubic Hermite interpolant plus a quartic bump, continuously differentiable: Hairer, Norsett,
        Wanner, Solving Ordinary Differential Equations I, II.6.
        """
        b = np.array([*self.rows[-1], 0.0])[:, None]
        d = np.array(self.bump)[:, None]
        rest = 1 - theta
        state = b * (theta**2 * (3 - 2 * theta)) + d * (theta * rest) ** 2
        state[0] += theta * rest**2
        state[-1] -= theta**2 * rest
        slope = b * (6 * theta * rest) + d * (2 * theta * rest * (1 - 2 * theta))
        slope[0] += rest * (1 - 3 * theta)
        slope[-1] -= theta * (2 - 3 * theta)
        return np.stack([state, slope])


# Dormand, Prince, A family of embedded Runge-Kutta formulae, 1980.
dopri5 = EmbeddedMethod(
    order=5,
    nodes=(1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1),
    rows=(
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ),
    error=(71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40),
    safety=0.95,
    grow=10.0,  # as in dopri5.f; smaller factors missed more of 32 ray-drop scenes
    stability=3.0,  # the region ends at 3.31; Hairer's 3.25 is for longer steps
    bump=(
        -12715105075 / 11282082432,
        0,
        87487479700 / 32700410799,
        -10690763975 / 1880347072,
        701980252875 / 199316789632,
        -1453857185 / 822651844,
        69997945 / 29380423,
    ),
    rough=(0, 2, 3, 6),
    defect=60.0,
)
