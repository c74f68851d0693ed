"""The memory of a solver does not grow with the number of steps."""

import weakref

import pytest
import torch

from r2flow.flow.solvers import SOLVERS, solve


def most_alive(method: str, steps: int, tolerance: float) -> tuple[int, int]:
    """(states alive at once, evaluations) of a solution, counted when the velocity is called."""
    seen: list[weakref.ref] = []
    most = 0

    def velocity(t, x):
        nonlocal most
        most = max(most, sum(ref() is not None for ref in seen))
        v = torch.cos(20 * t).reshape(-1, 1, 1, 1) * x
        seen.extend([weakref.ref(x), weakref.ref(v)])
        return v

    solution = solve(velocity, torch.randn(2, 2, 4, 8), method=method, steps=steps, tolerance=tolerance)
    return most, int(solution.evaluations.max())


@pytest.mark.parametrize("method", [*SOLVERS, "torchdiffeq:dopri5", "torchdiffeq:rk4"])
def test_memory_does_not_grow_with_the_number_of_steps(method: str):
    few, short = most_alive(method, 8, 1e-3)
    many, long = most_alive(method, 64, 1e-6)
    assert long >= 2 * short
    assert many <= few + 2
