"""s(t) against the exact paths of a Gaussian flow and of a rotation."""

import math

import pytest
import torch

from r2flow.flow.problems import Gaussian, Rotating
from r2flow.flow.straightness import straightness

GAUSSIAN, ROTATION = Gaussian(), Rotating(turns=1 / math.pi)
X_0 = torch.randn(3, 2, 2, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("problem", [GAUSSIAN, ROTATION], ids=["gaussian", "rotation"])
def test_s_is_that_of_the_exact_path(problem):
    chord = problem.solution(X_0, 1.0) - X_0
    off = []
    for steps in (512, 1024):
        found = straightness(problem, X_0, steps=steps)
        assert found.s.shape == (3, steps)
        velocities = torch.stack(
            [problem(t, problem.solution(X_0, t)) for t in found.t.double()], 1
        )
        exact = (chord[:, None] - velocities).square().flatten(2).sum(2)
        off.append((found.s - exact).abs().max() / exact.max())
    assert off[1] < 5e-3  # Euler's path is off by O(1/n); halving the step halves the difference
    assert math.log2(off[0] / off[1]) == pytest.approx(1, abs=0.1)
    torch.testing.assert_close(
        found.squared_length, chord.square().flatten(1).sum(1), rtol=1e-2, atol=0
    )


def test_a_small_variance_survives_float32():
    # v = 100 + a (t - 1/2): variance a^2 / 12 (1 - 1/n^2), nine digits below |v|^2.
    a, n = 1e-2, 64
    found = straightness(
        lambda t, x: torch.full_like(x, 100) + a * (t - 0.5), torch.zeros(1, 1), steps=n
    )
    assert found.s.mean().item() == pytest.approx(a**2 / 12 * (1 - 1 / n**2), rel=2e-3)


def test_a_path_that_is_not_finite_is_not_the_most_curved():
    def velocity(t, x):
        spoiled = torch.tensor([False, True, False]).view(-1, 1, 1, 1)
        return torch.where(spoiled, math.nan, ROTATION(t, x))

    assert straightness(velocity, X_0, steps=8, most_curved=20).trajectories.isfinite().all()


def test_a_network_that_can_learn_is_followed_too():
    layer = torch.nn.Linear(8, 8, dtype=torch.float64)
    assert not any(
        part.requires_grad for part in straightness(lambda t, x: layer(x), X_0, 4, most_curved=1)
    )


def test_a_network_may_give_its_velocities_in_one_buffer():
    buffer = torch.empty_like(X_0)
    found = straightness(lambda t, x: buffer.copy_(ROTATION(t, x)), X_0, 8)
    assert torch.equal(found.s, straightness(ROTATION, X_0, 8).s)
