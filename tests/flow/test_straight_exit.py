"""A scene that passes as straight ends within ten tolerances of the exact solution, however narrow its data."""

import math

import pytest
import torch

from r2flow.errors import InputError
from r2flow.flow.problems import PROBLEMS
from r2flow.flow.solvers import solve
from r2flow.flow.straight_exit import probes, solve_straight_first


class Mixture:
    """The exact flow from N(0, 1) to sum_i w_i N(m_i, s_i^2), element by element.

    v(t, x) = E[x_1 - x_0 | x_t = x] = sum_i p(i | x) (m_i + (S_i' / S_i) (x - t m_i)), S_i^2 = (1 - t)^2 + t^2 s_i^2.
    In one dimension a flow keeps the order of points: x_0 arrives at the quantile of x_1 that it is of x_0.
    """

    def __init__(self, *parts: tuple[float, float, float]) -> None:
        self.w, self.m, self.s = (torch.tensor(values, dtype=torch.float64) for values in zip(*parts, strict=True))

    def __call__(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        t = (t.double().view(-1, 1) if t.ndim else t.double()).unsqueeze(-1)
        y = x.double()[..., None]
        variance = (1 - t) ** 2 + (t * self.s) ** 2
        logits = self.w.log() - variance.log() / 2 - (y - t * self.m) ** 2 / (2 * variance)
        slopes = (t * self.s**2 - (1 - t)) / variance
        return (logits.softmax(-1) * (self.m + slopes * (y - t * self.m))).sum(-1).to(x.dtype)

    def end(self, x_0: torch.Tensor) -> torch.Tensor:
        wanted = torch.special.ndtr(x_0.double())
        low, high = torch.full_like(wanted, -50), torch.full_like(wanted, 50)
        for _ in range(80):  # bisection
            middle = (low + high) / 2
            below = (self.w * torch.special.ndtr((middle[..., None] - self.m) / self.s)).sum(-1) < wanted
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return (low + high) / 2


GAUSSIAN, RAY_DROP = Mixture((1, 0.7, 0.5)), Mixture((0.2, -1, 1e-3), (0.8, 0.3, 0.3))
X_0 = torch.randn(6, 256, dtype=torch.float64, generator=torch.Generator().manual_seed(3))


def rms(x: torch.Tensor) -> torch.Tensor:
    return x.double().square().mean(1).sqrt()


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5, 1e-7])
@pytest.mark.parametrize("width", [10 ** (-power / 4) for power in range(33)])
def test_probes_detect_data_of_every_width(tolerance, width):
    flow = Mixture((1, 0.7, width))
    end = solve_straight_first(flow, X_0, tolerance)
    straight = end.evaluations == 1 + len(probes(tolerance))
    assert not straight.any() or rms(end.x - flow.end(X_0))[straight].max() < 10 * tolerance
    if width < tolerance / 10:
        assert straight.all()  # what is narrower than can be told is a point, and a point is reached in a step


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("flow", [GAUSSIAN, RAY_DROP, Mixture((0.5, -1, 0.05), (0.5, 1, 0.05))])
def test_bent_scenes_are_solved_by_the_adaptive_method(flow, tolerance):
    end = solve_straight_first(flow, X_0, tolerance)
    alone = solve(flow, X_0, method="dopri5", tolerance=tolerance)
    assert torch.equal(end.x, alone.x)
    assert (end.evaluations == alone.evaluations + 1).all()  # the first probe tells, and v(0, x_0) is known
    assert torch.equal(end.accepted, alone.accepted)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("name", [name for name in PROBLEMS if name != "narrow_jet"])  # nothing looks where it is
def test_only_straight_scenes_of_exact_problems_pass_the_probes(name, tolerance):
    problem = PROBLEMS[name]()
    end = solve_straight_first(problem, X_0, tolerance, max_evaluations=20)
    claimed = (end.evaluations == 1 + len(probes(tolerance))) & (end.accepted == 1) & end.converged
    error = rms(end.x - problem.solution(X_0, 1.0))
    assert not claimed.any() or error[claimed].max() < 10 * tolerance
    # a width of 0.01 is nothing at a tolerance of 0.01
    as_good = ("straight", "point_mass", *(("narrow_gaussian",) if tolerance == 1e-2 else ()))
    assert claimed.tolist() == [name in as_good] * 6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_point_mass_is_straight_up_to_its_singular_end(dtype):
    x_0 = X_0.to(dtype)
    end = solve_straight_first(lambda t, x: (0.3 - x) / (1 - t), x_0, 1e-4)
    assert end.evaluations.tolist() == [1 + len(probes(1e-4))] * 6
    torch.testing.assert_close(end.x, torch.full_like(x_0, 0.3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("jump", [0.1, 0.4, 0.7, 0.94])
def test_a_jump_in_time_is_not_straight(jump):
    end = solve_straight_first(lambda t, x: torch.ones_like(x) * (1 + (t > jump).view(-1, 1)), X_0, 1e-3)
    assert (end.evaluations > 1 + len(probes(1e-3))).all()


class Scenes:
    """A flow for each scene."""

    def __init__(self, *flows):
        self.flows = flows

    def __call__(self, t, x):
        times = t.expand(len(x)) if t.ndim == 0 else t
        return torch.cat([flow(times[i], x[i : i + 1]) for i, flow in enumerate(self.flows)])

    def select(self, scenes):
        return Scenes(*(self.flows[i] for i in scenes.tolist()))


def straight(t, x):
    return torch.full_like(x, 0.25)


def test_each_scene_is_judged_alone():
    flows = [straight, RAY_DROP, straight, GAUSSIAN, lambda t, x: x * math.nan, straight]
    order = torch.tensor([4, 1, 5, 0, 3, 2])
    mixed = solve_straight_first(Scenes(*flows), X_0, 1e-3)
    turned = solve_straight_first(Scenes(*(flows[i] for i in order)), X_0[order], 1e-3)
    assert mixed.converged.tolist() == [True, True, True, True, False, True]
    for name in ("x", "evaluations", "accepted", "rejected", "converged"):
        torch.testing.assert_close(getattr(turned, name), getattr(mixed, name)[order], rtol=0, atol=0, equal_nan=True)
    assert mixed.evaluations[[0, 2, 5]].tolist() == [3, 3, 3]
    torch.testing.assert_close(mixed.x[0], X_0[0] + 0.25)
    assert torch.equal(mixed.x[1:2], solve(RAY_DROP, X_0[1:2], method="dopri5", tolerance=1e-3).x)


def test_probes_approach_the_end_as_the_tolerance_shrinks():
    assert probes(1e-3) == pytest.approx([0.5, 0.95])
    assert probes(1e-5) == pytest.approx([0.5, 0.95, 0.995, 0.9995])
    assert probes(1.0) == pytest.approx([0.5, 0.95])
    with pytest.raises(InputError, match="must be positive"):
        solve_straight_first(straight, X_0, 0)


def test_an_error_estimate_is_refused():
    with pytest.raises(InputError, match="no estimate of their global error; call `solve`"):
        solve_straight_first(straight, X_0, 1e-3, global_error=True)
