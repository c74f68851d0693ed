"""Exact solutions against their velocities, their start and their marginals."""

import pytest
import torch

from r2flow.flow.problems import PROBLEMS, NarrowJet
from r2flow.flow.solvers import solve

X_0 = torch.randn(3, 8, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_the_solution_begins_at_x_0_and_moves_with_the_velocity(name):
    problem, h = PROBLEMS[name](), 1e-6
    torch.testing.assert_close(problem.solution(X_0, 0.0), X_0, rtol=0, atol=1e-14)
    for t in (0.25, 0.75):
        central = (problem.solution(X_0, t + h) - problem.solution(X_0, t - h)) / (2 * h)
        velocity = problem(torch.tensor(t, dtype=torch.float64), problem.solution(X_0, t))
        torch.testing.assert_close(central, velocity, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_a_time_for_each_scene_is_as_one_for_all_in_any_shape(name):
    problem, t = PROBLEMS[name](), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    whole = problem(t, X_0)
    torch.testing.assert_close(problem(t, X_0.view(3, 2, 2, 2)), whole.view(3, 2, 2, 2))
    torch.testing.assert_close(
        problem.solution(X_0.view(3, 2, 2, 2), t).flatten(1), problem.solution(X_0, t)
    )
    for scene in range(3):
        torch.testing.assert_close(whole[scene], problem(t[scene], X_0[scene : scene + 1])[0])
        torch.testing.assert_close(
            problem.solution(X_0, t)[scene],
            problem.solution(X_0[scene : scene + 1], t[scene].item())[0],
        )


def test_a_wide_jet_has_its_exact_solution():
    # Where the jet is wide, the error function at its start is not that of -infinity.
    problem = NarrowJet(width=0.3, at=0.3)
    assert (problem.solution(X_0, 0.0) - X_0).abs().max() < 1e-14
    end = solve(problem, X_0, method="dopri5", tolerance=1e-13).x
    torch.testing.assert_close(end, problem.solution(X_0, 1.0), rtol=0, atol=1e-11)
