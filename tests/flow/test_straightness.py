"""s(t) against the exact paths of a Gaussian flow and of a rotation."""

import math

import pytest
import torch

from r2flow.flow.problems import Gaussian, Rotating
from r2flow.flow.straightness import curvature, straightness

GAUSSIAN, ROTATION = Gaussian(), Rotating(turns=1 / math.pi)
X_0 = torch.randn(3, 2, 2, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("problem", [GAUSSIAN, ROTATION], ids=["gaussian", "rotation"])
def test_s_is_that_of_the_exact_path(problem):
    chord = problem.solution(X_0, 1.0) - X_0
    off = []
    for steps in (512, 1024):
        found = straightness(problem, X_0, steps=steps)
        assert found.s.shape == (3, steps)
        velocities = torch.stack([problem(t, problem.solution(X_0, t)) for t in found.t.double()], 1)
        exact = (chord[:, None] - velocities).square().flatten(2).sum(2)
        off.append((found.s - exact).abs().max() / exact.max())
    # Euler's path is off by O(1/n); halving the step halves the difference.
    assert off[1] < 5e-3
    assert math.log2(off[0] / off[1]) == pytest.approx(1, abs=0.1)
    lengths = chord.square().flatten(1).sum(1)
    torch.testing.assert_close(found.curvature.squared_length, lengths, rtol=1e-2, atol=0)


@pytest.mark.parametrize("field", [GAUSSIAN, ROTATION])
def test_one_pass_finds_the_integral_of_s(field):
    once, twice = curvature(field, X_0, steps=64), straightness(field, X_0, steps=64)
    torch.testing.assert_close(once.total, twice.s.mean(1), rtol=1e-10, atol=0)
    torch.testing.assert_close(once.normalised, twice.s.mean(1) / twice.curvature.squared_length, rtol=1e-10, atol=0)


def test_a_small_variance_survives_float32():
    # v = 100 + a (t - 1/2): variance a^2 / 12 (1 - 1/n^2), nine digits below |v|^2.
    a, n = 1e-2, 64
    found = curvature(lambda t, x: torch.full_like(x, 100) + a * (t - 0.5), torch.zeros(1, 1), steps=n)
    assert found.total.item() == pytest.approx(a**2 / 12 * (1 - 1 / n**2), rel=2e-3)


def test_the_most_curved_pixels_are_found_and_followed():
    # The Gaussian flow bends pixel x_0 by an amount proportional to x_0^2.
    found = straightness(GAUSSIAN, X_0, steps=32, most_curved=5)
    order = X_0.flatten().abs().argsort(descending=True)[:5]
    assert found.pixels.tolist() == order.tolist()
    assert found.trajectories.shape == (5, 33)
    torch.testing.assert_close(found.trajectories[:, 0], X_0.flatten()[order])
    torch.testing.assert_close(found.trajectories[:, -1], found.curvature.x_1.flatten()[order])
    start = X_0.flatten()[order][:, None]
    exact = torch.cat([GAUSSIAN.solution(start, i / 32) for i in range(33)], 1)
    torch.testing.assert_close(found.trajectories, exact, rtol=0, atol=0.15)
    assert found.curvature.per_pixel.flatten()[found.pixels].diff().max() <= 0


def test_a_path_that_is_not_finite_is_not_the_most_curved():
    def velocity(t, x):
        spoiled = torch.tensor([False, True, False]).view(-1, 1, 1, 1)
        return torch.where(spoiled, math.nan, ROTATION(t, x))

    found = straightness(velocity, X_0, steps=8, most_curved=20)
    of_scene = found.pixels // X_0[0].numel()
    assert 1 not in of_scene.tolist()
    assert found.trajectories.isfinite().all()


def test_a_network_that_can_learn_is_followed_too():
    """Nothing is kept for a gradient, and the figures are those of a network that cannot."""
    layer = torch.nn.Linear(8, 8, dtype=torch.float64)
    for measure in (curvature, straightness):
        found = measure(lambda t, x: layer(x), X_0, 4)
        with torch.no_grad():
            again = measure(lambda t, x: layer(x), X_0, 4)
        one, other = (getattr(each, "curvature", each).total for each in (found, again))
        assert torch.equal(one, other)
        assert not one.requires_grad
