import math

import pytest
import torch
from torch import nn

from r2flow.errors import InputError
from r2flow.flow.solvers import solve
from r2flow.noise import standard_normal
from r2flow.stages import STAGES
from r2flow.stages.base import learning_rate_factor
from r2flow.stages.rectify import Rectify
from tests.fields import Field


def test_the_schedule_is_the_reference_s(shared):
    reference = torch.load(shared / "oracle" / "training.pt", weights_only=False)["lr"]
    factors = [learning_rate_factor(step, reference["warmup"], reference["total"]) for step in reference["steps"]]
    assert factors == pytest.approx(reference["factor"], abs=1e-6)


def test_the_schedule_ends_at_zero_and_never_passes_one():
    factors = [learning_rate_factor(step, 10, 100) for step in range(101)]
    assert max(factors) == 1
    assert factors[-1] == pytest.approx(0)
    assert learning_rate_factor(0, 0, 1) == 1  # no warm-up


class Affine(nn.Module):
    """v(t, x) = a(t) x + b(t) by interpolating a table: enough for a Gaussian target, exactly."""

    def __init__(self) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.zeros(2, 33))

    def forward(self, t, x):
        place = t.reshape(-1, 1, 1, 1) * 32
        low = place.long().clamp(max=31)
        a, b = torch.lerp(self.table[:, low], self.table[:, low + 1], place - low)
        return a * x + b


def affine(network: Affine | None = None) -> Field:
    return Field(network or Affine(), (1, 2, 2))


M, S = 0.7, 0.25  # x_1 ~ N(M, S^2), x_0 ~ N(0, 1), independent: the flow carries x_0 to M + S x_0


@pytest.fixture(scope="module")
def trained() -> Rectify:
    stage = Rectify(affine())
    optimizer = torch.optim.Adam(stage.parameters(), lr=3e-2)
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    for step in range(1500):
        for group in optimizer.param_groups:
            group["lr"] = 3e-2 * learning_rate_factor(step, 10, 1500)
        draw = torch.Generator().manual_seed(step)
        shape = (512, 1, 2, 2)
        batch = {
            "x_0": torch.randn(shape, generator=draw),
            "x_1": M + S * torch.randn(shape, generator=draw),
            "u": torch.rand(512, generator=draw),
        }
        optimizer.zero_grad()
        stage.training_step(batch, step).backward()
        optimizer.step()
    return stage


def test_a_gaussian_is_carried_to_a_gaussian(trained):
    x_0 = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8)
    end = solve(trained.generator.velocity, x_0, steps=256).x.detach()
    torch.testing.assert_close(end, M + S * x_0, rtol=0, atol=0.05)


def test_the_velocity_is_the_conditional_mean(trained):
    # E[x_1 - x_0 | x_t] of jointly Gaussian variables: cov / var times the deviation, plus the mean.
    for t in (0.25, 0.5, 0.75):
        x = torch.tensor([-0.5, 0.5, 1.0]).reshape(3, 1, 1, 1)
        slope = (t * S**2 - (1 - t)) / (t**2 * S**2 + (1 - t) ** 2)
        expected = M + slope * (x - t * M)
        estimate = trained.generator.velocity(torch.full((3,), t), x).detach()
        torch.testing.assert_close(estimate, expected, rtol=0, atol=0.08)


@pytest.mark.parametrize("name", list(STAGES))
def test_every_stage_refuses_unknown_options(name):
    with pytest.raises(InputError, match=r"Did you mean 'learning_rate'\?"):
        STAGES.build({"name": name, "learning_rat": 1.0}, affine())


def test_an_untrained_stage_has_the_loss_of_predicting_nothing():
    # v = 0: the loss is E|x_1 - x_0|^2 / d = M^2 + S^2 + 1.
    stage = Rectify(affine())
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    x_0 = torch.stack([standard_normal((1, 32, 32), 0, "training", k) for k in range(64)])
    x_1 = M + S * torch.stack([standard_normal((1, 32, 32), 0, "evaluation", k) for k in range(64)])
    loss = stage.training_step({"x_0": x_0, "x_1": x_1, "u": torch.rand(64)}, 0)
    assert loss.item() == pytest.approx(M**2 + S**2 + 1, abs=5 / math.sqrt(x_0.numel()))
