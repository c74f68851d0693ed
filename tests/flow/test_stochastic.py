"""Samplers with fresh noise on the way, against closed forms: they draw the same scans, along other
paths.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.noise import Draws
from r2flow.flow.solvers import named_grid
from r2flow.generators import USUAL, build_generator
from r2flow.samplers import SDE, build_sampler
from r2flow.samplers.stochastic import back, sde, sde_step
from tests.fields import CONFIG, Field

STD = 0.4  # of x_1 ~ N(0, STD^2), where everything is linear


def times(steps: int, grid: str = "power:2") -> Tensor:
    return named_grid(grid)(0.0, 1.0, steps)


def estimate(t: Tensor, x: Tensor) -> Tensor:
    return t * STD**2 / (t**2 * STD**2 + (1 - t) ** 2) * x


def variance(t: float) -> float:
    return t**2 * STD**2 + (1 - t) ** 2


def variances(steps: int, c: float, grid: str = "power:2") -> list[float]:
    """Var x_t after each step, exactly: of a linear method, the squares of what each draw of noise
    becomes.
    """
    units = torch.eye(steps + 1, dtype=torch.float64)[:, :, None]
    states = sde(estimate, units[0], times(steps, grid), c, lambda j: units[j])
    return [float(x.square().sum()) for x in states]


@pytest.mark.parametrize("c", [0.0, 0.5, 1.0, 3.0])
def test_at_any_share_of_fresh_noise_the_law_of_x_t_is_the_flow_s_and_its_error_of_order_2(c):
    errors = []
    for steps in (40, 80, 160):
        # the last step is Euler's, of a length that shrinks as its square
        grid = times(steps).tolist()[1:-1]
        found = variances(steps, c)
        errors.append(max(abs(v / variance(t) - 1) for t, v in zip(grid, found[:-1], strict=True)))
        assert found[-1] == pytest.approx(STD**2, rel=2 * errors[-1] + 2e-3)
    assert errors[-1] < 1e-3 * (1 + c)
    assert min(math.log2(a / b) for a, b in pairwise(errors)) > 1.7


@pytest.mark.parametrize("c", [0.0, 1.0, 2.5])
def test_a_step_is_exact_where_the_estimate_is_linear_in_time(c):
    """Against the mean's own equation, dx/dt = (D - x) / (1 - t) - c (x - t D) / (t (1 - t)), by
    scipy.
    """
    t_b, t, s, a, b, x = 0.1, 0.35, 0.8, 0.7, -1.9, 0.3
    step = sde_step(t, s, c, t_b)

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        end = a + b * t
        return (end - x) / (1 - t) - c * (x - t * end) / (t * (1 - t))

    expected = solve_ivp(slope, (t, s), [x], rtol=1e-11, atol=1e-12).y[0, -1]
    assert step.keep * x + step.now * (a + b * t) + step.before * (a + b * t_b) == pytest.approx(
        expected, abs=1e-9
    )


def test_the_first_step_is_euler_s_and_the_last_one_goes_to_the_estimate():
    assert sde_step(0.0, 0.3, 2.0) == pytest.approx((0.7, 0.3, 0.0, 0.0))
    assert sde_step(0.6, 1.0, 2.0, 0.5) == (0.0, 1.0, 0.0, 0.0)


@pytest.mark.parametrize("r", [0.55, 0.8, 1.0])
def test_going_back_by_fresh_noise_keeps_the_law(r):
    units, s = torch.eye(2, dtype=torch.float64)[:, :, None], 0.55
    there = math.sqrt(variance(r)) * units[0]  # the flow map of a Gaussian scales its deviation
    assert float(back(there, r, s, units[1]).square().sum()) == pytest.approx(
        variance(s), rel=1e-12
    )


def normal() -> Field:
    return Field(
        lambda t, x: (estimate(t, x) - x) / (1 - t), (2, 8, 32), build_generator(CONFIG).space
    )


@pytest.mark.parametrize("method", ["sde", "sde:churn=3"])
def test_a_flow_draws_the_data_s_distribution(method):
    flow, who = normal(), Draws(3, range(48))
    how = build_sampler(method, steps=32, grid="power:2", finish=1 / 64)
    made = flow(who.start(flow.noise_shape), sampler=how, draws=who)
    count = made.x.numel()  # 24,576 values
    # Of an Euler step over 1/64 the deviation lacks (1/64)^2 / (2 STD^2), the rest is the steps'
    # error of order 2.
    assert float(made.x.std()) == pytest.approx(STD, abs=5 * STD / (2 * count) ** 0.5 + 0.004)
    assert float(made.x.mean()) == pytest.approx(0, abs=5 * STD / count**0.5)
    assert made.evaluations.tolist() == [32] * 48
    assert how.evaluations(flow) == 32
    assert made.converged.all()


def test_what_needs_the_ode_says_so():
    flow = build_generator({**CONFIG, "generator": {"name": "flow_map"}}).eval()
    x_0 = torch.zeros(1, *flow.noise_shape)
    for method in ("sde", "jump", "renoise"):
        with pytest.raises(InputError, match=f"sampler {method} does not follow the flow's paths"):
            flow.solve(x_0, sampler=build_sampler(method, steps=2))


def test_another_sampler_has_its_own_defaults_and_the_number_of_steps():
    flow = build_generator(CONFIG)
    assert flow.sampler == USUAL
    assert flow.choose("sde") == build_sampler("sde", steps=16, grid="power:2.5", finish=1 / 128)
    assert flow.choose("dopri5") == build_sampler("dopri5")
    assert flow.choose("adams3", steps=8) == build_sampler(
        "adams3", steps=8, grid="power:1.5", finish=1 / 32
    )
    assert flow.choose("euler", grid=(0.0, 0.5, 1.0), steps=None).times().tolist() == [0, 0.5, 1]
    # one that is not registered
    assert type("Own", (SDE,), {})(steps=9).text.startswith("Own:steps=9:")


def test_without_fresh_noise_mmps_needs_no_draws():
    flow, x_0 = normal(), torch.ones(1, 2, 8, 32)
    known = torch.zeros_like(x_0)
    known[:, :, ::2] = 1
    told = {"image": 0.3 * known, "known": known}
    assert flow(
        x_0, told, sampler=build_sampler("mmps", products=1, churn=0, steps=2)
    ).converged.all()
