"""Embedded Runge-Kutta methods: a step and an estimate of its error from the same stages."""

from typing import NamedTuple


class EmbeddedMethod(NamedTuple):
    """The Butcher tableau of an explicit embedded method whose last stage is the next step's first (FSAL).

    Attributes:
        order: Order of the solution that is carried on.
        nodes: c_i of stages 2 to s.
        rows: a_ij of stages 2 to s; the last row is the new state.
        error: b_i - b*_i, the weights of the error estimate.
        safety: Safety factor of the step size controller.
        grow: Largest factor between one step size and the next.
        stability: |h lambda| above which a step counts as stiff; near the end of the stability region on the negative
            real axis.
        evaluations: None, since the evaluations of a solution depend on the scene.
    """

    order: int
    nodes: tuple[float, ...]
    rows: tuple[tuple[float, ...], ...]
    error: tuple[float, ...]
    safety: float
    grow: float
    stability: float
    evaluations: None = None

    @property
    def stages(self) -> int:
        """Evaluations a step."""
        return len(self.rows)


# Bogacki, Shampine, A 3(2) pair of Runge-Kutta formulas, 1989.
bosh3 = EmbeddedMethod(
    order=3,
    nodes=(1 / 2, 3 / 4, 1),
    rows=((1 / 2,), (0, 3 / 4), (2 / 9, 1 / 3, 4 / 9)),
    error=(2 / 9 - 7 / 24, 1 / 3 - 1 / 4, 4 / 9 - 1 / 3, -1 / 8),
    safety=0.7,
    grow=3.0,  # measured: longer steps double the error on the mixed batch of benchmarks/solvers.py
    stability=1.75,  # 2.51, reduced because its last two stages are at different times
)

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
    grow=10.0,  # as in dopri5.f; of 32 ray-drop scenes, more were missed with smaller factors
    stability=3.0,  # the region ends at 3.31; Hairer's 3.25 is for longer steps
)
