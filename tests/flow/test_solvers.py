"""Orders are measured against an exact solution on which no method superconverges."""

import math

import pytest
import torch

from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.flow.problems import Gaussian, RayDrop
from r2flow.flow.solvers import GRIDS, SOLVERS, EmbeddedMethod, FixedStep, calibrated_grid, solve
from r2flow.flow.solvers.external import is_fixed, torchdiffeq_methods


def logistic(t, x):
    """x' = (1 + t) x (1 - x), solved by x = 1 / (1 + (1/x_0 - 1) exp(-(t + t^2 / 2)))."""
    return (1 + expand_time(t, x)) * x * (1 - x)


def logistic_solution(x_0, t):
    return 1 / (1 + (1 / x_0 - 1) * math.exp(-(t + t**2 / 2)))


X_0 = torch.tensor([[0.1], [0.3], [0.6]], dtype=torch.float64)


FIXED = [name for name, entry in SOLVERS.items() if isinstance(entry, FixedStep)]
ADAPTIVE = [name for name, entry in SOLVERS.items() if isinstance(entry, EmbeddedMethod)]


@pytest.mark.parametrize("method", FIXED)
def test_halving_the_step_shrinks_the_error_by_the_order(method):
    def error(steps):
        return (solve(logistic, X_0, method=method, steps=steps).x - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(16) / error(32)) == pytest.approx(SOLVERS[method].order, abs=0.25)


@pytest.mark.parametrize("method", ADAPTIVE)
def test_an_adaptive_method_of_equal_steps_has_its_order(method):
    # A tolerance of 1000 accepts every step, and none may be longer than its share of the interval.
    def error(steps):
        solution = solve(logistic, X_0, method=method, tolerance=1e3, max_step=1 / steps)
        assert solution.accepted.tolist() == [steps] * 3
        return (solution.x - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(32) / error(64)) == pytest.approx(SOLVERS[method].order, abs=0.35)


THEIR_FIXED = [name for name in torchdiffeq_methods() if is_fixed(name)]


@pytest.mark.parametrize("method", THEIR_FIXED)
def test_torchdiffeq_s_methods_have_their_order_through_our_call(method):
    def error(steps):
        end = solve(logistic, X_0, method=f"torchdiffeq:{method}", steps=steps).x
        return (end - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(16) / error(32)) == pytest.approx(torchdiffeq_methods()[method].order, abs=0.25)


@pytest.mark.parametrize("method", FIXED)
def test_a_method_keeps_its_order_on_steps_of_different_length(method):
    def error(steps):
        times = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
        end = solve(logistic, X_0, method=method, grid=times + 0.1 * torch.sin(2 * math.pi * times)).x
        return (end - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(32) / error(64)) == pytest.approx(SOLVERS[method].order, abs=0.3)


def test_a_quadratic_grid_is_denser_towards_t_1_and_the_same_backward():
    times = GRIDS["quadratic"](0.0, 1.0, 4)
    # 1 - t = (1 - i/4)^2
    torch.testing.assert_close(1 - times, torch.tensor([1, 9 / 16, 1 / 4, 1 / 16, 0], dtype=torch.float64))
    torch.testing.assert_close(GRIDS["quadratic"](1.0, 0.0, 4), times.flip(0))


def test_a_calibrated_grid_puts_its_steps_where_the_velocity_turns():
    # dv/dt = e^(-(t - .7)^2 / 2 (.05)^2): equal local errors need steps of h ~ |dv/dt|^(-1/2).
    def velocity(t, x):
        z = (t - 0.7) / 0.05
        return 0.05 * math.sqrt(2 * math.pi) * torch.special.ndtr(z) + 0 * x

    x_0 = torch.zeros(2, 3, dtype=torch.float64)
    times = calibrated_grid(velocity, x_0, 16)
    steps = times[1:] - times[:-1]
    assert times[0] == 0
    assert times[-1] == 1
    assert (steps > 0).all()
    nearest = (times[:-1] - 0.7).abs().argmin()
    assert steps[nearest] < 0.4 / 16
    # x(1) = integral of .05 sqrt(2 pi) Phi((t - .7) / .05)
    fine = solve(velocity, x_0, method="rk4", steps=512).x
    equal, calibrated = (solve(velocity, x_0, grid=grid, steps=16).x for grid in ("uniform", times))
    assert (calibrated - fine).abs().max() < (equal - fine).abs().max()


@pytest.mark.parametrize("method", [*FIXED, *ADAPTIVE, "torchdiffeq:dopri5", "torchdiffeq:rk4"])
def test_the_finish_is_one_euler_step(method):
    # x' = e^t: exact to 1 - eps, then eps e^(1 - eps), which lacks eps^2 / 2 e.
    eps = 0.1
    solution = solve(
        lambda t, x: expand_time(torch.exp(t), x) + 0 * x, X_0, method=method, steps=64, tolerance=1e-9, finish=eps
    )
    expected = X_0 + math.exp(1 - eps) - 1 + eps * math.exp(1 - eps)
    torch.testing.assert_close(solution.x, expected, rtol=0, atol=2e-2 if method == "euler" else 1e-3)
    if method == "rk4":
        torch.testing.assert_close(solution.x, expected, rtol=0, atol=1e-9)
        assert solution.evaluations.tolist() == [64 * 4 + 1] * 3


@pytest.mark.parametrize("method", ["euler", "heun3", "rk4", "dopri5", "torchdiffeq:midpoint", "torchdiffeq:bosh3"])
def test_the_global_error_is_estimated_and_its_cost_counted(method):
    asked = {"method": method, "steps": 16, "tolerance": 1e-4}
    plain, owned = solve(logistic, X_0, **asked), solve(logistic, X_0, **asked, global_error=True)
    error = (owned.x - logistic_solution(X_0, 1)).square().mean(1).sqrt()
    assert torch.equal(plain.x, owned.x)
    assert plain.global_error is None
    assert (owned.evaluations > plain.evaluations).all()
    assert (owned.global_error > error / 5).all()
    assert (owned.global_error < error * 5).all()


@pytest.mark.parametrize("method", ["rk4", *ADAPTIVE, "torchdiffeq:dopri5"])
@pytest.mark.parametrize(("problem", "finish"), [
    (Gaussian(std=1e-2), 1e-2), (Gaussian(std=1e-3), 1e-3), (Gaussian(std=1e-4), 1e-3), (RayDrop(), 1e-2),
], ids=str)  # fmt: skip
def test_the_error_estimate_includes_the_finish(method, problem, finish):
    # At this tolerance the one Euler step at the end makes nearly all of the error.
    x_0 = torch.randn(3, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    end = solve(problem, x_0, method=method, steps=512, tolerance=1e-7, finish=finish, global_error=True)
    error = (end.x - problem.solution(x_0, 1.0)).square().mean(1).sqrt()
    assert error.min() > 1e-5
    assert (end.global_error > error / 5).all()
    assert (end.global_error < error * 5).all()


def test_the_evaluations_of_the_estimate_are_counted_apart():
    for method in ("euler", "dopri5"):
        plain, owned = (solve(logistic, X_0, method=method, finish=0.1, global_error=asked) for asked in (False, True))
        assert plain.estimate_evaluations is None
        assert torch.equal(owned.evaluations - owned.estimate_evaluations, plain.evaluations)


def test_an_unknown_or_wrong_grid_is_refused():
    with pytest.raises(InputError, match=r"no time grid named 'quadratik'.*Did you mean 'quadratic'\?"):
        solve(logistic, X_0, grid="quadratik")
    with pytest.raises(InputError, match="must be \\(N \\+ 1,\\) times that run in one direction"):
        solve(logistic, X_0, grid=torch.tensor([0.0, 0.6, 0.5, 1.0]))
    with pytest.raises(InputError, match="this time grid runs from 0 to 0.9, the solution from 0.0 to 1.0"):
        solve(logistic, X_0, grid=torch.tensor([0.0, 0.5, 0.9]))
    with pytest.raises(InputError, match="cannot go beyond it"):
        solve(logistic, X_0, 0.0, 1.5, grid="quadratic")


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


@pytest.mark.parametrize("method", FIXED)
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


@pytest.mark.parametrize("method", ["euler", "rk4", "bosh3", "dopri5", "torchdiffeq:dopri5", "torchdiffeq:bosh3"])
def test_a_scene_does_not_depend_on_its_neighbours(method):
    hard = torch.tensor([[20.0]], dtype=torch.float64)  # steep at the start
    together = solve(logistic, torch.cat([X_0, hard]), method=method, tolerance=1e-3)
    alone = solve(logistic, hard, method=method, tolerance=1e-3)
    assert torch.equal(together.x[3:], alone.x)
    assert together.evaluations[3] == alone.evaluations[0]
    if method not in FIXED:
        assert together.evaluations[0] < together.evaluations[3]


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match=r"Did you mean 'euler'\?"):
        solve(logistic, X_0, method="eulr")
    with pytest.raises(InputError, match="at least 1 step"):
        solve(logistic, X_0, steps=0)
    with pytest.raises(InputError, match="torchdiffeq has no method 'dopri55'"):
        solve(logistic, X_0, method="torchdiffeq:dopri55")
    with pytest.raises(InputError, match="explicit_adams is left out: its Adams methods lose their order"):
        solve(logistic, X_0, method="torchdiffeq:explicit_adams")
    with pytest.raises(InputError, match="must be positive"):
        solve(logistic, X_0, method="torchdiffeq:dopri5", tolerance=0)
