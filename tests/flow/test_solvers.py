"""Orders are measured against an exact solution on which no method superconverges."""

import math

import pytest
import torch

from r2flow.errors import InputError
from r2flow.flow.solvers import SOLVERS, solve


def logistic(t, x):
    """x' = (1 + t) x (1 - x), solved by x = 1 / (1 + (1/x_0 - 1) exp(-(t + t^2 / 2)))."""
    return (1 + t) * x * (1 - x)


def logistic_solution(x_0, t):
    return 1 / (1 + (1 / x_0 - 1) * math.exp(-(t + t**2 / 2)))


X_0 = torch.tensor([[0.1], [0.3], [0.6]], dtype=torch.float64)


@pytest.mark.parametrize("method", list(SOLVERS))
def test_halving_the_step_shrinks_the_error_by_the_order(method):
    def error(steps):
        return (solve(logistic, X_0, method=method, steps=steps).x - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(16) / error(32)) == pytest.approx(SOLVERS[method].order, abs=0.25)


@pytest.mark.parametrize("method", [*SOLVERS, "torchdiffeq:dopri5", "torchdiffeq:rk4", "torchdiffeq:midpoint"])
def test_backward_in_time_returns_to_the_start(method):
    end = solve(logistic, X_0, 0, 1, method, steps=256, tolerance=1e-9).x
    back = solve(logistic, end, 1, 0, method, steps=256, tolerance=1e-9).x
    torch.testing.assert_close(back, X_0, rtol=0, atol=2e-3 if method == "euler" else 1e-5)


def test_a_straight_flow_takes_one_euler_step():
    target = torch.randn(2, 2, 4, 8)
    x_0 = torch.randn(2, 2, 4, 8)
    end = solve(lambda t, x: target - x_0, x_0, steps=1)
    torch.testing.assert_close(end.x, target)
    assert end.evaluations.tolist() == [1, 1]


@pytest.mark.parametrize("method", list(SOLVERS))
def test_evaluations_are_counted(method):
    per_step = SOLVERS[method].evaluations
    calls = []
    solution = solve(lambda t, x: -x, X_0, method=method, steps=5, progress=lambda: calls.append(1))
    assert solution.evaluations.tolist() == [5 * per_step] * 3
    assert len(calls) == 5 * per_step


def test_torchdiffeq_solves_to_its_tolerance():
    end = solve(logistic, X_0, method="torchdiffeq:dopri5", tolerance=1e-8)
    torch.testing.assert_close(end.x, logistic_solution(X_0, 1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", ["euler", "midpoint", "heun2", "heun3", "rk4"])
def test_fixed_steps_are_torchdiffeq_s(method):
    # torchdiffeq's rk4 is the 3/8 rule, another method of the same order.
    ours = solve(logistic, X_0, method=method, steps=8).x
    theirs = solve(logistic, X_0, method=f"torchdiffeq:{method}", steps=8).x
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-4 if method == "rk4" else 1e-12)


def test_the_state_stays_in_float32_around_a_half_precision_network():
    # 256 steps of 1/256 in bfloat16 would stall: 1 + 1/256 rounds to 1 there.
    end = solve(lambda t, x: torch.ones_like(x, dtype=torch.bfloat16), torch.ones(1, 1), steps=256)
    assert end.x.item() == pytest.approx(2, abs=1e-5)
    assert end.x.dtype == torch.float32


@pytest.mark.parametrize("method", ["euler", "rk4", "torchdiffeq:dopri5", "torchdiffeq:bosh3"])
def test_a_scene_does_not_depend_on_its_neighbours(method):
    hard = torch.tensor([[20.0]], dtype=torch.float64)  # steep at the start
    together = solve(logistic, torch.cat([X_0, hard]), method=method, tolerance=1e-3)
    alone = solve(logistic, hard, method=method, tolerance=1e-3)
    assert torch.equal(together.x[3:], alone.x)
    assert together.evaluations[3] == alone.evaluations[0]
    if "torchdiffeq" in method:
        assert together.evaluations[0] < together.evaluations[3]


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match=r"Did you mean 'euler'\?"):
        solve(logistic, X_0, method="eulr")
    with pytest.raises(InputError, match="at least 1 step"):
        solve(logistic, X_0, steps=0)
    with pytest.raises(InputError, match="torchdiffeq has no method 'dopri55'"):
        solve(logistic, X_0, method="torchdiffeq:dopri55")
    with pytest.raises(InputError, match="must be positive"):
        solve(logistic, X_0, method="torchdiffeq:dopri5", tolerance=0)
