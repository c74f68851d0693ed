"""Orders are measured against an exact solution on which no method superconverges."""

import math

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.flow.solvers import SOLVERS, EmbeddedMethod, FixedStep, named_grid, solve
from r2flow.samplers import build_sampler
from tests.fields import Field
from tests.reference import assert_near, backbone_of, load_case


def logistic(t, x):
    """x' = (1 + t) x (1 - x), solved by x = 1 / (1 + (1/x_0 - 1) exp(-(t + t^2 / 2)))."""
    return (1 + expand_time(t, x)) * x * (1 - x)


def logistic_solution(x_0, t):
    return 1 / (1 + (1 / x_0 - 1) * math.exp(-(t + t**2 / 2)))


X_0 = torch.tensor([[0.1], [0.3], [0.6]], dtype=torch.float64)

FIXED = [name for name, entry in SOLVERS.items() if isinstance(entry, FixedStep)]
ADAPTIVE = [name for name, entry in SOLVERS.items() if isinstance(entry, EmbeddedMethod)]


@pytest.mark.parametrize("method", [*SOLVERS, "torchdiffeq:dopri5"])
def test_a_state_may_be_one_number_of_each_scene(method):
    column, found = (solve(logistic, x, method=method, steps=16) for x in (X_0, X_0[:, 0]))
    assert torch.equal(found.x, column.x[:, 0])
    torch.testing.assert_close(found.x, logistic_solution(X_0[:, 0], 1), rtol=0, atol=0.02)


@pytest.mark.parametrize("method", ADAPTIVE)
def test_an_adaptive_method_of_equal_steps_has_its_order(method):
    # A tolerance of 1000 accepts every step, and none may be longer than its share of the interval.
    def error(steps):
        solution = solve(logistic, X_0, method=method, tolerance=1e3, max_step=1 / steps)
        assert solution.accepted.tolist() == [steps] * 3
        return (solution.x - logistic_solution(X_0, 1)).abs().max().item()

    assert math.log2(error(32) / error(64)) == pytest.approx(SOLVERS[method].order, abs=0.35)
    # Between the stages, a path is of order 4 (Hairer II.6): exact, as its slope, for a velocity
    # t^q up to q = 3.
    nodes, theta = np.array([0.0, *SOLVERS[method].nodes]), np.linspace(0, 1, 9)
    exact = [[theta ** (q + 1) / (q + 1), theta**q] for q in range(4)]
    found = [
        [weights.T @ nodes**q for weights in SOLVERS[method].interpolant(theta)] for q in range(4)
    ]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", FIXED)
@pytest.mark.parametrize("grid", ["uniform", "waves", "power:1.75"])
def test_halving_the_steps_shrinks_the_error_by_the_order(method, grid):
    def error(steps):
        times = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
        waves = times + 0.1 * torch.sin(2 * math.pi * times)
        end = solve(
            logistic, X_0, method=method, steps=steps, grid=waves if grid == "waves" else grid
        ).x
        return (end - logistic_solution(X_0, 1)).abs().max().item()

    few = 128 if SOLVERS[method].multistep else 16  # a multistep method has a start to get over
    steps, within = (few, 0.25) if grid == "uniform" else (2 * few, 0.3)
    assert math.log2(error(steps) / error(2 * steps)) == pytest.approx(
        SOLVERS[method].order, abs=within
    )


@pytest.mark.parametrize("by", ["", "torchdiffeq:"])
def test_solutions_of_a_network_are_the_published_ones(shared, by):
    case = load_case(shared, "solvers.pt")
    model = backbone_of("hdit", case).eval()
    for name, published in case["results"].items():
        method, number = name.removeprefix("inversion_").split("-", 1)
        if by or method in SOLVERS:
            fixed, back = float(number) >= 1, "x0" in published
            x, end = (published["x1"], published["x0"]) if back else (case["x0"], published["x1"])
            how = {"steps": int(number)} if fixed else {"tolerance": float(number)}
            with torch.no_grad():
                found = solve(model, x, float(back), float(not back), by + method, **how)
            assert_near(found.x, end, 1e-5 if fixed else 2e-2)
            assert not fixed or back or found.evaluations.tolist() == [published["nfe"]] * len(x)


def test_a_power_grid_is_denser_towards_one_end_and_the_same_backward():
    for name, times in {
        # 1 - t = (1 - i/4)^2 and t = (i/4)^3, by hand
        "power:2": 1 - torch.tensor([1, 9 / 16, 1 / 4, 1 / 16, 0], dtype=torch.float64),
        "power:1": torch.tensor([0, 0.25, 0.5, 0.75, 1], dtype=torch.float64),
    }.items():
        torch.testing.assert_close(named_grid(name)(0.0, 1.0, 4), times)
        torch.testing.assert_close(named_grid(name)(1.0, 0.0, 4), times.flip(0))
    # A part of the way: equal steps of (1 - t)^(1/2) from .8 to .4.
    torch.testing.assert_close(
        named_grid("power:2")(0.36, 0.84, 2), torch.tensor([0.36, 0.64, 0.84], dtype=torch.float64)
    )


@pytest.mark.parametrize("method", FIXED)
def test_the_finish_is_one_euler_step(method):
    # x' = e^t: exact to 1 - eps, then eps e^(1 - eps), which lacks eps^2 / 2 e.
    eps, calls = 0.1, []
    flow = Field(lambda t, x: expand_time(torch.exp(t), x) + 0 * x, X_0.shape[1:])
    sampler = build_sampler(method, steps=65, finish=eps)
    made = flow(X_0, sampler=sampler, progress=lambda: calls.append(1))
    expected = X_0 + math.exp(1 - eps) - 1 + eps * math.exp(1 - eps)
    torch.testing.assert_close(made.x, expected, rtol=0, atol=2e-2 if method == "euler" else 1e-4)
    assert made.evaluations.tolist() == [len(calls)] * 3 == [sampler.evaluations(flow)] * 3


@pytest.mark.parametrize("method", ["dopri5", "exprb43", "torchdiffeq:bosh3"])
def test_the_global_error_is_estimated_and_its_cost_counted(method):
    asked = {"method": method, "tolerance": 1e-4}
    # a default device of the user's
    with torch.device("cpu" if method.startswith("torchdiffeq") else "meta"):
        plain, owned = (
            solve(logistic, X_0, **asked),
            solve(logistic, X_0, **asked, global_error=True),
        )
    error = (owned.x - logistic_solution(X_0, 1)).square().mean(1).sqrt()
    assert torch.equal(plain.x, owned.x)
    assert plain.global_error is None
    assert (owned.evaluations > plain.evaluations).all()
    assert (owned.global_error > error / 5).all()
    assert (owned.global_error < error * 5).all()


def test_an_unknown_or_wrong_grid_is_refused():
    assert torch.equal(
        solve(logistic, X_0, np.float32(0), grid=[0, 0.5, 1]).x, solve(logistic, X_0, steps=2).x
    )
    for grid in ("power", "power:0.5", "power:nan", "power:11", "start-power:2"):
        with pytest.raises(InputError, match=f"P from 1 to 10; found '{grid}'"):
            solve(logistic, X_0, grid=grid)
    for times in ([0.0, 0.6, 0.5, 1.0], [0.0, 0.5, 0.9]):
        with pytest.raises(InputError, match="time grid"):
            solve(logistic, X_0, grid=torch.tensor(times))
    with pytest.raises(InputError, match="time grid"):
        solve(logistic, X_0, steps=0)


@pytest.mark.parametrize(
    "method", [*SOLVERS, "torchdiffeq:dopri5", "torchdiffeq:rk4", "torchdiffeq:midpoint"]
)
def test_backward_in_time_returns_to_the_start(method):
    end = solve(logistic, X_0, 0, 1, method, steps=256, tolerance=1e-9).x
    back = solve(logistic, end, 1, 0, method, steps=256, tolerance=1e-9).x
    torch.testing.assert_close(back, X_0, rtol=0, atol=2e-3 if method == "euler" else 1e-5)


def test_the_state_stays_in_float32_around_a_half_precision_network():
    # 256 steps of 1/256 in bfloat16 would stall: 1 + 1/256 rounds to 1 there.
    end = solve(lambda t, x: torch.ones_like(x, dtype=torch.bfloat16), torch.ones(1, 1), steps=256)
    assert end.x.item() == pytest.approx(2, abs=1e-5)
    assert end.x.dtype == torch.float32


@pytest.mark.parametrize("method", [*FIXED, "dopri5", "torchdiffeq:dopri5", "torchdiffeq:bosh3"])
def test_a_scene_does_not_depend_on_its_neighbours(method):
    hard = torch.tensor([[20.0]], dtype=torch.float64)  # steep at the start
    together = solve(logistic, torch.cat([X_0, hard]), method=method, tolerance=1e-3)
    alone = solve(logistic, hard, method=method, tolerance=1e-3)
    assert torch.equal(together.x[3:], alone.x)
    assert together.evaluations[3] == alone.evaluations[0]
    if method not in FIXED:
        assert together.evaluations[0] < together.evaluations[3]
