"""s(t) is known in closed form for a Gaussian flow and for a rotation."""

import cmath
import math

import pytest
import torch

from r2flow.flow.straightness import curvature, straightness

M, S = 0.7, 0.25  # x_1 ~ N(M, S^2), x_0 ~ N(0, 1), independent: the flow carries x_0 to t M + sigma_t x_0
OMEGA = 2.0


def sigma(t):
    return torch.sqrt((1 - t) ** 2 + (t * S) ** 2)


def gaussian(t, x):
    """E[x_1 - x_0 | x_t = x] of the Gaussian flow."""
    return M + (t * S**2 - (1 - t)) / sigma(t) ** 2 * (x - t * M)


def gaussian_s(x_0, t):
    """d - v_t = (S - 1 - sigma_t') x_0 on the exact path, summed over pixels: (B, n)."""
    slope = (t * S**2 - (1 - t)) / sigma(t)
    return (S - 1 - slope).square() * x_0.square().flatten(1).sum(1, keepdim=True)


def rotation(t, x):
    """x' = omega J x, a circle in every pair of channels."""
    return OMEGA * torch.stack([-x[:, 1], x[:, 0]], 1)


X_0 = torch.randn(3, 2, 2, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_s_of_a_gaussian_flow_is_the_closed_form():
    found = straightness(gaussian, X_0, steps=1024)
    exact = gaussian_s(X_0, found.t)
    assert found.s.shape == (3, 1024)
    # Euler's path is off by O(1/n); halving the step halves the difference.
    coarse = straightness(gaussian, X_0, steps=512)
    off, off_coarse = (found.s - exact).abs().max(), (coarse.s - gaussian_s(X_0, coarse.t)).abs().max()
    assert off < 5e-3 * exact.max()
    assert math.log2(off_coarse / off) == pytest.approx(1, abs=0.1)


def test_s_of_a_rotation_is_the_closed_form():
    found = straightness(rotation, X_0, steps=1024)
    turn = torch.tensor([abs(cmath.exp(1j * OMEGA) - 1 - 1j * OMEGA * cmath.exp(1j * OMEGA * t)) for t in found.t])
    exact = turn.square() * X_0.square().flatten(1).sum(1, keepdim=True)
    torch.testing.assert_close(found.s, exact.double(), rtol=0, atol=1e-2 * exact.max().item())
    lengths = abs(cmath.exp(1j * OMEGA) - 1) ** 2 * X_0.square().flatten(1).sum(1)
    torch.testing.assert_close(found.curvature.squared_length, lengths, rtol=1e-2, atol=0)
    torch.testing.assert_close(found.s_normalised, found.s / lengths[:, None], rtol=1e-2, atol=0)


def test_a_straight_flow_has_no_curvature_however_long_it_is():
    target = torch.randn(3, 2, 2, 8)
    x_0 = X_0.float()
    found = straightness(lambda t, x: 1e3 * (target - x_0), x_0, steps=16)
    assert found.s_normalised.max() < 1e-12
    assert curvature(lambda t, x: 1e3 * (target - x_0), x_0, steps=16).total.tolist() == [0, 0, 0]


@pytest.mark.parametrize("field", [gaussian, rotation])
def test_one_pass_finds_the_integral_of_s(field):
    once, twice = curvature(field, X_0, steps=64), straightness(field, X_0, steps=64)
    torch.testing.assert_close(once.total, twice.s.mean(1), rtol=1e-10, atol=0)
    torch.testing.assert_close(once.normalised, twice.s_normalised.mean(1), rtol=1e-10, atol=0)


def test_a_small_variance_survives_float32():
    # v = 100 + a (t - 1/2): variance a^2 / 12 (1 - 1/n^2), nine digits below |v|^2.
    a, n = 1e-2, 64
    found = curvature(lambda t, x: torch.full_like(x, 100) + a * (t - 0.5), torch.zeros(1, 1), steps=n)
    assert found.total.item() == pytest.approx(a**2 / 12 * (1 - 1 / n**2), rel=2e-3)


def test_the_most_curved_pixels_are_found_and_followed():
    # The Gaussian flow bends pixel x_0 by an amount proportional to x_0^2.
    found = straightness(gaussian, X_0, steps=32, most_curved=5)
    order = X_0.flatten().abs().argsort(descending=True)[:5]
    assert found.pixels.tolist() == order.tolist()
    assert found.trajectories.shape == (5, 33)
    torch.testing.assert_close(found.trajectories[:, 0], X_0.flatten()[order])
    torch.testing.assert_close(found.trajectories[:, -1], found.curvature.x_1.flatten()[order])
    times = torch.arange(33) / 32
    exact = times * M + sigma(times) * X_0.flatten()[order][:, None]
    torch.testing.assert_close(found.trajectories, exact, rtol=0, atol=0.15)
    assert found.curvature.per_pixel.flatten()[found.pixels].diff().max() <= 0


def test_a_path_that_is_not_finite_is_not_the_most_curved():
    def velocity(t, x):
        spoiled = torch.tensor([False, True, False]).view(-1, 1, 1, 1)
        return torch.where(spoiled, math.nan, rotation(t, x))

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
