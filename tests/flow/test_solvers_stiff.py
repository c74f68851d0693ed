"""The exponential method: its order, stiff scenes in few evaluations, and who is handed to it."""

import math

import pytest
import torch

from benchmarks.solvers import Mixed
from r2flow.flow.path import expand_time
from r2flow.flow.problems import Gaussian, Rotating, StiffLinear, Straight
from r2flow.flow.solvers import solve

X_0 = torch.randn(2, 16, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def worst(x, exact):
    return (x.double() - exact).square().mean(1).sqrt().max().item()


@pytest.mark.parametrize("rate", [1e2, 3e4, 1e6])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_stiff_scenes_are_solved_to_1e_3_in_300_evaluations(rate, dtype):
    problem, x_0 = StiffLinear(rate), X_0[:1].to(dtype)
    for method in ("exprb43", "auto"):
        found = solve(problem, x_0, method=method, tolerance=1e-3)
        assert found.converged.all()
        assert found.evaluations.max() < 300
        assert worst(found.x, problem.solution(x_0, 1.0)) < 1e-3


def test_auto_hands_over_the_stiff_scenes_and_leaves_the_others_as_they_are():
    problems = [Gaussian(), StiffLinear(2e3), Straight(), Rotating(), StiffLinear(1e3)]
    x_0 = torch.randn(5, 16, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    batch = Mixed(problems)
    found = solve(batch, x_0, method="auto", tolerance=1e-4)
    explicit = solve(batch, x_0, method="dopri5", tolerance=1e-4)
    assert found.stiff.tolist() == [False, True, False, False, True]
    assert found.converged.all()
    for scene in (0, 2, 3):
        assert torch.equal(found.x[scene], explicit.x[scene])
        assert found.evaluations[scene] == explicit.evaluations[scene]
    assert (found.evaluations[[1, 4]] < explicit.evaluations[[1, 4]] / 5).all()
    assert worst(found.x, batch.solution(x_0, 1.0)) < 1e-3
    order = torch.tensor([4, 2, 1, 0, 3])
    turned = solve(batch.select(order), x_0[order], method="auto", tolerance=1e-4)
    for name in ("x", "evaluations", "accepted", "rejected", "stiff", "converged"):
        assert torch.equal(getattr(found, name)[order], getattr(turned, name)), name


def test_a_network_in_lower_precision_leaves_the_steps_as_they_are():
    class Rounded:
        precision = torch.bfloat16

        def __init__(self, problem):
            self.problem = problem

        def __call__(self, t, x):
            return self.problem(t, x)

    x_0 = X_0[:1].float()
    plain = solve(Rounded(StiffLinear(1e4)), x_0, method="exprb43", tolerance=1e-2)
    with torch.autocast("cpu", torch.bfloat16):  # nothing in this velocity is a matrix product
        found = solve(StiffLinear(1e4), x_0, method="exprb43", tolerance=1e-2)
    assert torch.equal(found.x, plain.x)
    assert torch.equal(found.evaluations, plain.evaluations)


def test_rates_that_lie_far_apart_are_solved():
    rates = torch.logspace(0, 4, 16, dtype=torch.float64)

    def velocity(t, x):  # x' = -rate (x - cos t) - sin t: x approaches cos t
        t = expand_time(t, x)
        return -rates * (x - t.cos()) - t.sin()

    exact = math.cos(1) + (X_0 - 1) * (-rates).exp()
    found = solve(velocity, X_0, method="auto", tolerance=1e-4)
    assert found.stiff.all()
    assert worst(found.x, exact) < 1e-3
    assert found.evaluations.max() < 2000


def test_a_stiff_equation_that_is_not_linear_is_solved():
    # x' = -1e4 x (x^2 - s^2) + s'(t) with s = 2 + sin t: x = s from s(0) on.
    def velocity(t, x):
        s = 2 + expand_time(t, x).sin()
        return -1e4 * x * (x**2 - s**2) + expand_time(t, x).cos()

    found = solve(velocity, torch.full((1, 4), 2.0, dtype=torch.float64), method="exprb43", tolerance=1e-4)
    assert found.converged.all()
    assert (found.x - (2 + math.sin(1))).abs().max() < 1e-3
    assert found.evaluations.max() < 1000


def test_the_order_is_at_least_4():
    # Error against the number of steps; the reference is dopri5 at 1e-13.
    def velocity(t, x):
        return expand_time(t, x).cos() * x - x**3 / 2

    x_0 = X_0[:1, :4].clone()
    exact = solve(velocity, x_0, method="dopri5", tolerance=1e-13).x
    coarse, fine = (solve(velocity, x_0, method="exprb43", tolerance=tolerance) for tolerance in (1e-4, 1e-7))
    gained = math.log(worst(coarse.x, exact) / worst(fine.x, exact))
    assert gained / math.log(fine.accepted[0] / coarse.accepted[0]) > 3.5


def test_a_scene_that_runs_away_does_not_end_its_batch():
    """Robertson's reactions to t = 40 at a tolerance above their smallest component, beside the same in balance."""

    def reactions(t, x):
        a, b, c = x.unbind(-1)
        slow, fast = 0.04 * a - 1e4 * b * c, 3e7 * b * b
        return 40 * torch.stack([-slow, slow - fast, fast], -1)

    x_0 = torch.tensor([[1.0, 0, 0], [0.0, 0, 1]], dtype=torch.float64)
    found = solve(reactions, x_0, method="exprb43", tolerance=1e-4)
    assert found.converged[1]
    assert torch.equal(found.x[1], x_0[1])
    exact = [0.715827069, 9.18553476e-06, 0.284163746]  # scipy's Radau at 1e-12
    ok = found.converged[0] and torch.allclose(found.x[0], torch.tensor(exact, dtype=torch.float64), atol=1e-3)
    assert ok or not found.converged[0]
    close = solve(reactions, x_0[:1], method="auto", tolerance=1e-6)
    assert close.converged.all()
    assert torch.allclose(close.x[0], torch.tensor(exact, dtype=torch.float64), atol=1e-4)
