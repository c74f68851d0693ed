"""A network for large images around one for small ones."""

import pytest
import torch
import torch.nn.functional as F
from tiny_backbones import COLUMNS, ROWS, image, rays, tiny, untrained
from torch import nn

from r2flow.backbones import build_backbone
from r2flow.backbones.base import precondition
from r2flow.backbones.layers import wrapped
from r2flow.errors import InputError
from tests.conftest import tiny_options

TIMES = (0.0, 0.01, 0.3, 0.7, 0.98, 1.0)


class OfAGaussian(nn.Module):
    """The velocity of the flow to N(0, std^2), which is linear."""

    def __init__(self, std: float) -> None:
        super().__init__()
        self.std = std

    def forward(self, t: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return precondition(t, self.std)[1] * y


@pytest.mark.parametrize("t", TIMES)
@pytest.mark.parametrize("factor", [[1, 2], [2, 4]])
def test_it_is_the_velocity_of_a_gaussian_whose_means_and_rest_are_independent(t, factor):
    """x_1 ~ N(0, C) with C = n S^2 Q + s^2 (1 - Q), Q the projection onto means: v = (t C - (1 - t)) V^-1 x_t, V the
    covariance t^2 C + (1 - t)^2 of x_t."""
    model = untrained("pyramid", factor=factor, below_std=0.3).double()
    model.inner = OfAGaussian(0.8)
    n, size = factor[0] * factor[1], ROWS * COLUMNS
    pixels = torch.eye(size, dtype=torch.float64).reshape(size, 1, ROWS, COLUMNS)
    q = F.avg_pool2d(pixels, factor).repeat_interleave(factor[0], 2).repeat_interleave(factor[1], 3).reshape(size, size)
    one = torch.eye(size, dtype=torch.float64)
    c = n * 0.8**2 * q + 0.3**2 * (one - q)
    x = torch.randn(2, size, dtype=torch.float64)
    expected = torch.linalg.solve(t**2 * c + (1 - t) ** 2 * one, x.T).T @ (t * c - (1 - t) * one)
    with torch.no_grad():
        found = model(t, x.reshape(1, 2, ROWS, COLUMNS)).reshape(2, size)
    assert torch.allclose(found, expected, rtol=1e-6, atol=1e-6)  # times are float32


def test_the_inner_network_sees_the_mean_rays():
    model = untrained("pyramid", factor=[2, 4])
    assert torch.allclose(model.inner.coords, rays(ROWS // 2, COLUMNS // 4), atol=1e-6)


@pytest.mark.parametrize("channel", [2, 3, 4])
def test_a_condition_is_seen_inside_and_around(channel):
    model, seen = tiny("pyramid", 5, 2), []
    model.inner.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[1]))
    x = image(1, 5)
    other = x.clone()
    other[:, channel] += torch.tensor([1.0, -1.0]).repeat(COLUMNS // 2)  # the means are what they were
    around = model(0.5, x), model(0.5, other)
    assert torch.allclose(*seen, atol=1e-6)
    assert (around[0] - around[1]).abs().max() > 1e-3
    assert torch.allclose(seen[0][:, 2:], F.avg_pool2d(x[:, 2:], (1, 2)), atol=1e-6)


def test_jumps_move_the_means_as_the_inner_network_does():
    """The mean of n pixels, x_t = t x_1 + (1 - t) x_0, is w / sqrt(n) times a state y of the small flow at t' =
    t sqrt(n) / w, w = t sqrt(n) + 1 - t. The inner network jumps from y to y + (s' - t') u'(y, t', s')."""
    model, x, root = tiny("pyramid", second_time=True), image(1), 2**0.5
    nn.init.zeros_(model.detail.answer.weight)  # what the path adds has a mean of its own
    nn.init.zeros_(model.detail.answer.bias)
    for t, s in ((0.0, 1.0), (0.3, 0.8), (0.9, 0.2)):
        w, w_s = (time * root + 1 - time for time in (t, s))
        later, later_s = t * root / w, s * root / w_s
        y = F.avg_pool2d(x, (1, 2)) * root / w
        with torch.no_grad():
            arrived = y + (later_s - later) * model.inner(later, y, later_s)
            found = F.avg_pool2d(x + (s - t) * model(t, x, s), (1, 2))
        assert torch.allclose(found, w_s / root * arrived, atol=1e-5)


@pytest.mark.parametrize(("options", "message"), [
    ({"factor": [1, 1]}, "backbone.factor must be of more than one pixel"),
    ({"factor": [2]}, "factor must be 2 integers"),
    ({"inner": {"name": "hdi"}}, "hdit"),
    ({"inner": {"depths": [1]}}, "needs a 'name'"),
    ({"inner": {"name": "hdit", "patch": [3, 4]}}, "height 16 cannot be used by HDiT"),
    ({"data_std": 0.5}, "leave backbone.data_std out"),
])  # fmt: skip
def test_what_cannot_be_built(options, message):
    with pytest.raises(InputError, match=message):
        untrained("pyramid", **options)


def test_images_that_the_inner_network_cannot_see_the_means_of():
    options = {"name": "pyramid", "inner": {**tiny_options("hdit"), "patch": [2, 4]}}
    for rows, columns in ((12, 64), (15, 64), (16, 48)):
        with pytest.raises(InputError, match=r"it must be a multiple of (8|32); nearest"):
            build_backbone(options, rays(rows, columns), 2)


@pytest.mark.parametrize(("left", "right", "columns"), [(1, 1, 8), (2, 1, 3), (0, 3, 5), (1, 1, 2), (1, 1, 1)])
def test_wrapped_is_circular_padding_with_its_gradient(left, right, columns):
    x = torch.randn(2, 3, 4, columns, requires_grad=True)
    weights = torch.randn(2, 3, 4, columns + left + right)
    ours, theirs = wrapped(x, left, right), F.pad(x, (left, right, 0, 0), mode="circular")
    assert torch.equal(ours, theirs)
    (a,), (b,) = (torch.autograd.grad((y * weights).sum(), x) for y in (ours, theirs))
    assert torch.allclose(a, b, atol=1e-6)
