"""Errors of added points, from the density of the range of each ray."""

import math

import pytest
import torch
from torch import Tensor

from r2flow.generators.answers import NEVER, Answers


def density(logits: Tensor, ranges: Tensor, scales: Tensor, returns: float = 0.0) -> Answers:
    """Answers of N rays from parameters of the candidates, (7, N)."""
    logits, ranges, scales = (x[None, :, None] for x in (logits, ranges, scales))
    one = logits[:, :1]
    return Answers(
        logits.log_softmax(1), ranges, scales, torch.full_like(one, returns), 0 * logits, one[:, :0]
    )


def test_the_error_of_one_laplace_density_is_its_quantile():
    b = torch.tensor([0.001, 0.03, 0.4])
    never = torch.full((6, 3), NEVER)
    r = torch.tensor([1.0, 5.0, 40.0])
    logits = torch.cat([torch.zeros(1, 3), never])
    answers = density(logits, r.log().expand(7, -1), b.expand(7, -1))
    found = answers.error(r[None, None, None], [0.5, 0.68, 0.95])[:, 0, 0]
    for level, error in zip([0.5, 0.68, 0.95], found, strict=True):
        torch.testing.assert_close(error, -r * b * math.log(1 - level), rtol=1e-4, atol=0)


@pytest.mark.parametrize("level", [0.5, 0.68, 0.95])
def test_the_error_holds_as_much_of_a_mixture_as_it_says(level):
    draws = torch.Generator().manual_seed(0)
    logits = 2 * torch.randn(7, 4000, generator=draws)
    ranges = 2 + 0.2 * torch.randn(7, 4000, generator=draws)
    scales = 10 ** (-2 + 1.5 * torch.rand(7, 4000, generator=draws))
    answers = density(logits, ranges, scales)
    k = answers.least_error()
    center = answers.ranges.gather(1, k)
    w = answers.error(center.exp(), [level])[0, 0] / center.exp()[0, 0]
    z = torch.stack([w[0] - ranges + center[0, 0, 0], -w[0] - ranges + center[0, 0, 0]]) / scales
    shares = torch.where(z < 0, z.exp() / 2, 1 - (-z).exp() / 2)
    inside = (logits.softmax(0) * (shares[0] - shares[1])).sum(0)
    assert inside.mean().item() == pytest.approx(level, abs=0.01)
    assert (inside - level).abs().mean() < 0.05


def test_measured_rays_and_those_without_a_return_have_no_error():
    one = torch.zeros(7, 2)
    measured = density(one, one, one + 0.1, returns=-NEVER)
    assert not measured.error(torch.tensor([[[[3.0, 4.0]]]]), [0.68]).any()
    hidden = density(one, one, one + 0.1)
    found = hidden.error(torch.tensor([[[[3.0, 0.0]]]]), [0.68])
    assert found[0, 0, 0, 0] > 0
    assert found[0, 0, 0, 1] == 0
