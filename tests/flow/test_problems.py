"""Exact solutions against their velocities, their start and their marginals."""

import math

import pytest
import torch

from r2flow.flow.problems import PROBLEMS, Gaussian, NarrowJet, PointMass, RayDrop, Rotating, Straight, TwoModes
from r2flow.flow.solvers import solve


def straightness_of(problem, x_0, t):
    """s(t) = |(x_1 - x_0) - v(t, x_t)|^2 (the paper's eq. 5), exact, (B,)."""
    t = torch.as_tensor(t, dtype=torch.float64)
    return (problem.solution(x_0, 1.0) - x_0 - problem(t, problem.solution(x_0, t))).square().flatten(1).sum(1)


X_0 = torch.randn(3, 8, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.mark.parametrize("name", list(PROBLEMS))
@pytest.mark.parametrize("t", [0.25, 0.75])
def test_the_solution_moves_with_the_velocity(name, t):
    problem, h = PROBLEMS[name](), 1e-6
    central = (problem.solution(X_0, t + h) - problem.solution(X_0, t - h)) / (2 * h)
    velocity = problem(torch.tensor(t, dtype=torch.float64), problem.solution(X_0, t))
    torch.testing.assert_close(central, velocity, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_the_solution_at_time_0_is_x_0(name):
    torch.testing.assert_close(PROBLEMS[name]().solution(X_0, 0.0), X_0, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_a_time_for_each_scene_is_as_one_for_all(name):
    problem, t = PROBLEMS[name](), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    whole = problem(t, X_0)
    assert whole.shape == X_0.shape
    for scene in range(3):
        torch.testing.assert_close(whole[scene], problem(t[scene], X_0[scene : scene + 1])[0])
        torch.testing.assert_close(
            problem.solution(X_0, t)[scene], problem.solution(X_0[scene : scene + 1], t[scene].item())[0]
        )


def test_results_do_not_depend_on_the_shape():
    image = X_0.view(3, 2, 2, 2)
    for name in PROBLEMS:
        problem, t = PROBLEMS[name](), torch.full((3,), 0.4, dtype=torch.float64)
        torch.testing.assert_close(problem(t, image).flatten(1), problem(t, X_0))
        torch.testing.assert_close(problem.solution(image, 1.0).flatten(1), problem.solution(X_0, 1.0))


def test_a_gaussian_flow_ends_at_mean_plus_std_x_0():
    torch.testing.assert_close(Gaussian(0.7, 0.25).solution(X_0, 1.0), 0.7 + 0.25 * X_0)


def test_the_distribution_function_is_constant_along_paths_of_a_mixture():
    # F_1(x_1) = Phi(x_0), with F_1 the distribution that x_1 is drawn from.
    problem = RayDrop(dropped=0.3, std=1e-3)
    x_1 = problem.solution(X_0, 1.0)
    below = 0.3 * torch.special.ndtr((x_1 + 1) / 1e-3) + 0.7 * torch.special.ndtr((x_1 - 0.3) / 0.3)
    torch.testing.assert_close(below, torch.special.ndtr(X_0), rtol=0, atol=1e-11)


def test_a_mixture_of_one_is_a_gaussian():
    from r2flow.flow.problems import GaussianMixture

    torch.testing.assert_close(
        GaussianMixture([1.0], [0.7], [0.25]).solution(X_0, 0.6), Gaussian(0.7, 0.25).solution(X_0, 0.6)
    )


def test_two_modes_are_symmetric():
    torch.testing.assert_close(TwoModes().solution(-X_0, 1.0), -TwoModes().solution(X_0, 1.0))


def test_straight_flows_have_no_curvature():
    for problem in (Straight(), PointMass()):
        for t in (0.0, 0.3, 0.9):
            assert straightness_of(problem, X_0, t).max() < 1e-24


def test_the_gaussian_s_curvature_is_the_square_of_its_rate():
    # x_t = t m + sigma_t x_0: (x_1 - x_0) - v_t = ((s - 1) - sigma_t') x_0
    s, t = 0.25, 0.6
    sigma = math.hypot(1 - t, t * s)
    rate = (t * s**2 - (1 - t)) / sigma
    expected = ((s - 1) - rate) ** 2 * X_0.square().sum(1)
    torch.testing.assert_close(straightness_of(Gaussian(0.7, s), X_0, t), expected)


def test_a_half_turn_negates():
    torch.testing.assert_close(Rotating(turns=0.5).solution(X_0, 1.0), -X_0)


def test_a_wide_jet_has_its_exact_solution():
    # Where the jet is wide, the error function at its start is not that of -infinity.
    problem = NarrowJet(width=0.3, at=0.3)
    assert (problem.solution(X_0, 0.0) - X_0).abs().max() < 1e-14
    end = solve(problem, X_0, method="dopri5", tolerance=1e-13).x
    torch.testing.assert_close(end, problem.solution(X_0, 1.0), rtol=0, atol=1e-11)
