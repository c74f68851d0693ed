"""Steps of every scene's own: fewer evaluations, no influence of other scenes, nothing outside the
interval.
"""

import math

import pytest
import torch

from benchmarks.solvers import Mixed
from r2flow.base.noise import standard_normal
from r2flow.flow.path import expand_time
from r2flow.flow.problems import (
    PROBLEMS,
    Discontinuous,
    Gaussian,
    Pulse,
    RayDrop,
    Rotating,
    StiffLinear,
    Straight,
    TwoModes,
)
from r2flow.flow.solvers import solve


def noise(scenes, elements=256, seed=0):
    return torch.stack(
        [standard_normal((elements,), seed, "evaluation", scene) for scene in range(scenes)]
    )


def worst(x, exact):
    return (x.double() - exact).square().mean(1).sqrt().max().item()


def test_a_scene_s_result_is_the_same_alone_in_any_batch_and_in_any_place():
    problems = [
        Straight(),
        TwoModes(),
        RayDrop(),
        Gaussian(),
        Gaussian(std=0.01),
        StiffLinear(),
        Rotating(),
    ]
    problems += [Discontinuous(), Pulse()]
    x_0 = noise(len(problems), 96)
    together = solve(Mixed(problems), x_0, method="dopri5", tolerance=1e-4, global_error=True)
    order = torch.tensor([3, 6, 8, 0, 5, 1, 7, 4, 2])
    shuffled = solve(
        Mixed(problems).select(order),
        x_0[order],
        method="dopri5",
        tolerance=1e-4,
        global_error=True,
    )
    assert len(set(together.evaluations.tolist())) > 3
    for name in ("x", "evaluations", "accepted", "rejected", "stiff", "converged", "global_error"):
        assert torch.equal(getattr(together, name)[order], getattr(shuffled, name)), name
    for scene, problem in enumerate(problems):
        alone = solve(problem, x_0[scene : scene + 1], method="dopri5", tolerance=1e-4)
        assert torch.equal(alone.x[0], together.x[scene])
        assert alone.accepted[0] == together.accepted[scene]


def test_a_scene_that_has_arrived_is_not_evaluated():
    seen = []

    class Watched(Mixed):
        def __call__(self, t, x):
            seen.append(len(x))
            return super().__call__(t, x)

    solution = solve(
        Watched([Straight()] * 3 + [TwoModes()]), noise(4), method="dopri5", tolerance=1e-4
    )
    assert seen[0] == 4
    assert seen[-1] == 1
    assert sum(seen) == solution.evaluations.sum().item()


@pytest.mark.parametrize("method", ["heun2", "rk4", "dopri5"])
@pytest.mark.parametrize(("t_0", "t_1"), [(0.0, 1.0), (1.0, 0.0), (0.2, 0.7), (0.1, 0.3000001)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_is_evaluated_outside_the_interval(method, t_0, t_1, dtype):
    asked = []

    def velocity(t, x):
        asked.append(t.clone())
        return Gaussian(std=0.05)(t, x)

    solution = solve(velocity, noise(5).to(dtype), t_0, t_1, method=method, steps=7, tolerance=1e-4)
    ends = torch.tensor([t_0, t_1], dtype=torch.float64).to(dtype)
    for t in asked:
        assert t.dtype == dtype
        assert (t >= ends.min()).all()
        assert (t <= ends.max()).all()
    assert any((t == ends[1]).any() for t in asked)
    assert solution.converged.all()


THEIRS = ["dopri8", "dopri5", "bosh3", "fehlberg2", "adaptive_heun"]


@pytest.mark.parametrize("method", THEIRS)
@pytest.mark.parametrize(("t_0", "t_1"), [(0.0, 1.0), (1.0, 0.0), (0.2, 0.7)])
@pytest.mark.parametrize("speed", [0.0, 1e-4, 3.0])
def test_torchdiffeq_stays_in_the_interval_and_ends_at_its_end(method, t_0, t_1, speed):
    asked = []

    def velocity(t, x):
        asked.append(float(t))
        return torch.full_like(x, speed)

    found = solve(velocity, torch.ones(2, 3), t_0, t_1, "torchdiffeq:" + method, tolerance=1e-4)
    assert torch.allclose(found.x, torch.tensor(1 + speed * (t_1 - t_0)), atol=1e-6)
    ends = sorted(torch.tensor([t_0, t_1]).tolist())
    assert ends[0] <= min(asked)
    assert max(asked) <= ends[1]


@pytest.mark.parametrize("method", ["dopri8", "dopri5", "bosh3"])
def test_torchdiffeq_keeps_to_its_tolerance(method):
    """x' = -3 x + sin 5 t: x = (3 sin 5 t - 5 cos 5 t) / 34 + C exp(-3 t)."""

    def exact(x_0, t):
        return (3 * math.sin(5 * t) - 5 * math.cos(5 * t)) / 34 + (x_0 + 5 / 34) * math.exp(-3 * t)

    def velocity(t, x):
        return -3 * x + torch.sin(5 * t)

    x_0 = torch.ones(1, 1, dtype=torch.float64)
    for tolerance in (1e-4, 1e-6, 1e-8):
        found = solve(velocity, x_0, method="torchdiffeq:" + method, tolerance=tolerance)
        assert abs(found.x.item() - exact(1.0, 1.0)) < tolerance


def test_stiff_scenes_are_flagged_and_smooth_ones_are_not():
    stiff, smooth = (
        [StiffLinear(10.0**k) for k in (2, 4, 6)],
        [Straight(), Gaussian(), Gaussian(std=0.01), TwoModes()],
    )
    batch = Mixed([*stiff, *smooth, RayDrop()])
    solution = solve(
        batch, noise(8).double(), method="dopri5", tolerance=1e-3, max_evaluations=3000
    )
    assert solution.stiff.tolist() == [True] * 3 + [False] * 5
    assert solution.converged[0]  # where stability limits the steps


def in_tolerances(solution, exact, tolerance):
    return (solution.x - exact).square().mean(1).sqrt() / tolerance


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_jumps_in_time_are_located(tolerance):
    at, by = torch.rand(2, 60, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    drawn = zip((0.02 + 0.96 * at).tolist(), (0.5 + 2.5 * by).tolist(), strict=True)
    jumps = Mixed([Discontinuous(jump, where) for where, jump in drawn])
    x_0 = noise(60, 16).double()
    error = in_tolerances(
        solve(jumps, x_0, method="dopri5", tolerance=tolerance), jumps.solution(x_0, 1.0), tolerance
    )
    assert error.median() < 2
    assert error.max() < 30


def test_a_jump_in_some_of_the_elements_is_located():
    # 4 of 64 elements jump: their error is that of the scene.
    some = torch.arange(64) < 4

    def velocity(t, x):
        return torch.where(some & (expand_time(t, x) >= 0.4142), 3.0, 1.0).to(x.dtype) - x

    x_0 = noise(1, 64).double()
    late = -math.expm1(-(1 - 0.4142))
    exact = x_0 * math.exp(-1) - math.expm1(-1) + 2 * late * some
    assert (solve(velocity, x_0, method="dopri5", tolerance=1e-4).x - exact).abs().max() < 10e-4


@pytest.mark.parametrize("width", [0.16, 0.2])
def test_no_pulse_longer_than_0_16_of_the_interval_is_missed(width):
    # v is 0 before and after: nothing else makes the steps short.
    pulses = Mixed(
        [Pulse(width, at) for at in torch.linspace(width / 2, 1 - width / 2, 40).tolist()]
    )
    for tolerance in (1e-2, 1e-4):
        x_0 = torch.zeros(40, 4, dtype=torch.float64)
        found = solve(pulses, x_0, method="dopri5", tolerance=tolerance)
        assert (found.converged & ~found.stiff).all()
        assert in_tolerances(found, pulses.solution(x_0, 1.0), tolerance).max() < 10


@pytest.mark.parametrize("width", [0.05, 0.08, 0.1])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_no_pulse_that_any_step_saw_is_stepped_over(width, tolerance):
    """v is 0 outside of a pulse of integral 1 and height 2 / width; seen: any evaluation above 1."""
    seen = torch.zeros(80, dtype=torch.float64)

    class Pulses:
        def __init__(self, scenes):
            self.scenes = scenes
            self.at = width / 2 + (1 - width) * scenes / 79

        def select(self, scenes):
            return Pulses(self.scenes[scenes])

        def __call__(self, t, x):
            z = (t - self.at) / width
            v = torch.where(z.abs() < 0.5, 1 + torch.cos(2 * math.pi * z), 0) / width
            seen[self.scenes] = torch.maximum(seen[self.scenes], v)
            return v[:, None] + 0 * x

    x_0 = torch.zeros(80, 1, dtype=torch.float64)
    found = solve(Pulses(torch.arange(80)), x_0, method="dopri5", tolerance=tolerance)
    assert (seen > 1).sum() > 20
    assert (found.x[seen > 1] - 1).abs().max() < 0.05


def test_a_velocity_that_does_not_depend_on_x_is_not_stiff():
    for speed in (40.0, 80.0, 160.0):
        found = solve(
            lambda t, x, w=speed: torch.cos(w * expand_time(t, x)) + 0 * x, noise(4).double(), method="dopri5",
            tolerance=1e-6,
        )  # fmt: skip
        assert found.accepted.min() > 30
        assert not found.stiff.any()


def test_looking_for_pulses_and_jumps_costs_at_most_a_twentieth():
    # Of what the steps take, and the two evaluations of a start by Hairer's rule, over the exact
    # flows.
    looked = stepped = 0.0
    for name in ("straight", "gaussian", "two_modes", "ray_drop", "narrow_gaussian", "anisotropic"):
        for tolerance in (1e-3, 1e-5):
            found = solve(
                PROBLEMS[name](), noise(8, 64).double(), method="dopri5", tolerance=tolerance
            )
            assert name != "straight" or not found.rejected.any()
            looked += found.evaluations.sum().item()
            stepped += (2 + 6 * (found.accepted + found.rejected)).sum().item()
    assert looked < 1.05 * stepped


X_0 = torch.randn(2, 16, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize("rate", [1e2, 3e4, 1e6])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_stiff_scenes_are_solved_to_1e_3_in_300_evaluations(rate, dtype):
    problem, x_0 = StiffLinear(rate), X_0[:1].to(dtype)
    found = solve(problem, x_0, method="exprb43", tolerance=1e-3)
    assert found.converged.all()
    assert found.evaluations.max() < 300
    assert worst(found.x, problem.solution(x_0, 1.0)) < 1e-3


def test_a_network_in_lower_precision_leaves_the_steps_as_they_are():
    class Rounded(StiffLinear):
        precision = torch.bfloat16

    x_0 = X_0[:1].float()
    plain = solve(Rounded(1e4), x_0, method="exprb43", tolerance=1e-2)
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
    found = solve(velocity, X_0, method="exprb43", tolerance=1e-4)
    assert found.converged.all()
    assert worst(found.x, exact) < 1e-3
    assert found.evaluations.max() < 2000


@pytest.mark.parametrize(
    ("k", "t_1", "tolerance"), [(1e4, 0.1, 1e-2), (1e6, 0.02, 1e-3), (1e6, 0.1, 1e-2)]
)
def test_a_quadratic_remainder_has_an_error(k, t_1, tolerance):
    """x' = 1 - k x^2 from 0, where J = 0: x = tanh(sqrt(k) t) / sqrt(k). Below -1 / sqrt(k) it runs
    away.
    """
    x_0 = torch.zeros(1, 1, dtype=torch.float64)
    found = solve(lambda t, x: 1 - k * x**2, x_0, 0.0, t_1, "exprb43", tolerance=tolerance)
    exact = math.tanh(math.sqrt(k) * t_1) / math.sqrt(k)
    assert not found.converged or abs(found.x.item() - exact) < tolerance
    assert found.converged or tolerance > 1 / math.sqrt(k)


def test_the_order_is_at_least_4():
    # Error against the number of steps; the reference is dopri5 at 1e-13.
    def velocity(t, x):
        return expand_time(t, x).cos() * x - x**3 / 2

    x_0 = X_0[:1, :4].clone()
    exact = solve(velocity, x_0, method="dopri5", tolerance=1e-13).x
    coarse, fine = (
        solve(velocity, x_0, method="exprb43", tolerance=tolerance) for tolerance in (1e-4, 1e-7)
    )
    gained = math.log(worst(coarse.x, exact) / worst(fine.x, exact))
    assert gained / math.log(fine.accepted[0] / coarse.accepted[0]) > 3.5
    assert (
        solve(velocity, x_0, method="exprb43", tolerance=0.1, max_step=1 / 32).accepted.item() == 32
    )


def test_a_scene_that_runs_away_does_not_end_its_batch():
    """Robertson's reactions to t = 40 at a tolerance above their smallest component, beside the
    same in balance.
    """

    def reactions(t, x):
        a, b, c = x.unbind(-1)
        slow, fast = 0.04 * a - 1e4 * b * c, 3e7 * b * b
        return 40 * torch.stack([-slow, slow - fast, fast], -1)

    x_0 = torch.tensor([[1.0, 0, 0], [0.0, 0, 1]], dtype=torch.float64)
    found = solve(reactions, x_0, method="exprb43", tolerance=1e-4)
    assert found.converged.all()
    assert torch.equal(found.x[1], x_0[1])
    exact = [0.715827069, 9.18553476e-06, 0.284163746]  # scipy's Radau at 1e-12
    assert torch.allclose(found.x[0], torch.tensor(exact, dtype=torch.float64), atol=1e-3)
    close = solve(reactions, x_0[:1], method="exprb43", tolerance=1e-6)
    assert close.converged.all()
    assert torch.allclose(close.x[0], torch.tensor(exact, dtype=torch.float64), atol=1e-4)
