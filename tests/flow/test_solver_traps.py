"""Velocities that a solver must not trust: shared buffers, poles, noise, oscillating stiffness."""

import math

import pytest
import torch
from torch import Tensor

from r2flow.flow.problems import GaussianMixture
from r2flow.flow.solvers import SOLVERS, solve

X = torch.randn(1, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("method", sorted(SOLVERS))
def test_a_velocity_may_write_each_output_into_the_same_buffer(method: str):
    def pure(t: Tensor, x: Tensor) -> Tensor:
        return torch.cos(9 * t).reshape(-1, 1) - 3 * x

    buffer = torch.empty_like(X)
    shared = solve(lambda t, x: buffer.copy_(pure(t, x)), X, method=method, tolerance=1e-6)
    assert torch.equal(shared.x, solve(pure, X, method=method, tolerance=1e-6).x)


@pytest.mark.parametrize("place", [0.31, 0.4567, 0.5, 0.6180339, 0.777])
@pytest.mark.parametrize(("power", "tolerance"), [(1, 1e-2), (1, 1e-3), (1, 1e-4), (2, 1e-2), (2, 1e-4)])
def test_no_solution_crosses_a_pole(place: float, power: int, tolerance: float):
    solution = solve(
        lambda t, x: ((t - place) ** -power).reshape(-1, 1) + 0 * x, X, method="dopri5", tolerance=tolerance
    )
    assert not solution.converged.item()


def test_noise_in_a_velocity_is_no_jacobian():
    noise = torch.Generator().manual_seed(1)
    solution = solve(
        lambda t, x: 0.1 * torch.randn(x.shape, generator=noise, dtype=x.dtype) - x, X, method="exprb43", tolerance=1e-4
    )
    assert not solution.converged.item()
    assert solution.x.abs().max() < 10


def test_auto_hands_damped_oscillations_over():
    damped = torch.tensor([[-200.0, 2000.0], [-2000.0, -200.0]], dtype=torch.float64)
    start = torch.ones(1, 2, dtype=torch.float64)
    # x' = A x + b cos t with b = (1, 1) ends on Re(c e^it), (i - A) c = b; the transient e^-200 is gone.
    system = 1j * torch.eye(2, dtype=torch.complex128) - damped
    exact = (torch.linalg.solve(system, torch.ones(2, dtype=torch.complex128)) * complex(math.cos(1), math.sin(1))).real

    found = {
        method: solve(lambda t, x: x @ damped.T + torch.cos(t).reshape(-1, 1), start, method=method, tolerance=1e-5)
        for method in ("auto", "dopri5")
    }
    assert found["auto"].converged.item()
    assert (found["auto"].x - exact).abs().max() < 1e-5
    assert found["auto"].evaluations.item() < found["dopri5"].evaluations.item() / 2


@pytest.mark.parametrize("x_0", [-12.0, -9.0, -8.2, 8.2, 9.0, 12.0])
def test_exact_ends_of_a_mixture_in_the_far_tail(x_0: float):
    """A mixture of two equal Gaussians is one Gaussian, whose flow is x_1 = mean + std x_0."""
    mixture = GaussianMixture((0.5, 0.5), (0.3, 0.3), (0.05, 0.05))
    end = mixture.solution(torch.tensor([[x_0]], dtype=torch.float64), 1.0)
    assert end.item() == pytest.approx(0.3 + 0.05 * x_0, abs=1e-9)
