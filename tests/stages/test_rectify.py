"""k-RF and k-TD on a Gaussian, whose flow is known: it carries x_0 to M + S x_0."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import nn

from r2flow.base.errors import InputError
from r2flow.base.noise import standard_normal
from r2flow.data.datamodule import ScanDataModule
from r2flow.flow.solvers import solve
from r2flow.generators import USUAL, build_generator
from r2flow.samplers import build_sampler
from r2flow.stages import STAGES
from r2flow.stages.base import learning_rate_factor
from r2flow.stages.rectify import Distill, Rectify, Reflow
from r2flow.training import build, compose
from tests.conftest import CONFIG, SENSOR, quiet_trainer
from tests.fields import Field


def test_the_schedule_is_the_reference_s(shared):
    reference = torch.load(shared / "oracle" / "training.pt", weights_only=False)["lr"]
    factors = [
        learning_rate_factor(step, reference["warmup"], reference["total"])
        for step in reference["steps"]
    ]
    assert factors == pytest.approx(reference["factor"], abs=1e-6)
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


def pairs(step: int) -> dict[str, torch.Tensor]:
    draw = torch.Generator().manual_seed(step)
    x_0 = torch.randn(256, 1, 2, 2, generator=draw)
    return {"x_0": x_0, "x_1": M + S * x_0, "u": torch.rand(256, generator=draw)}


def fitted(stage: Rectify, batch: Callable[[int], dict[str, torch.Tensor]], steps: int) -> Rectify:
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    optimizer = torch.optim.Adam(stage.parameters(), lr=3e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        optimizer.zero_grad()
        stage.training_step(batch(step), step).backward()
        optimizer.step()
        schedule.step()
    return stage


def test_an_untrained_stage_has_the_loss_of_predicting_nothing():
    # v = 0: the loss is E|x_1 - x_0|^2 / d = M^2 + S^2 + 1.
    stage = Rectify(generator=affine())
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    x_0 = torch.stack([standard_normal((1, 32, 32), 0, "training", k) for k in range(64)])
    x_1 = M + S * torch.stack([standard_normal((1, 32, 32), 0, "evaluation", k) for k in range(64)])
    loss = stage.training_step({"x_0": x_0, "x_1": x_1, "u": torch.rand(64)}, 0)
    assert loss.item() == pytest.approx(M**2 + S**2 + 1, abs=5 / math.sqrt(x_0.numel()))


X_0 = torch.linspace(-2, 2, 64).reshape(1, 1, 8, 8)


@pytest.mark.parametrize(
    ("stage", "options", "steps"), [(Reflow, {}, 1), *((Distill, {"steps": k}, k) for k in (1, 4))]
)
def test_a_reflowed_gaussian_takes_one_step_and_a_distilled_one_its_own_number(
    stage, options: dict, steps: int
):
    flow = fitted(stage(generator=affine(), **options), pairs, 1200).generator
    end = solve(flow.velocity, X_0, steps=steps).x.detach()
    torch.testing.assert_close(end, M + S * X_0, rtol=0, atol=0.02)


@pytest.mark.parametrize(
    ("k", "grid"), [(1, "uniform"), (2, "uniform"), (4, "uniform"), (4, "power:2")]
)
def test_distillation_trains_at_the_times_of_its_steps_alone(k: int, grid: str):
    seen = set()

    class Spy(Affine):
        def forward(self, t, x):
            seen.update(t.tolist())
            return super().forward(t, x)

    stage = Distill(generator=affine(Spy()), steps=k, grid=grid)
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    stage.training_step(pairs(0), 0)
    assert seen == (
        {i / k for i in range(k)} if grid == "uniform" else {0, 7 / 16, 12 / 16, 15 / 16}
    )
    assert stage.generator.sampler == build_sampler("euler", steps=k, grid=grid)
    assert stage.generator.fixed


def test_the_paper_s_loss_and_times_are_the_defaults():
    stage = Reflow(generator=affine())
    # Most of the U-shaped density lies at the ends: e^(4t) + e^(4(1 - t)) puts 2 e^2 sinh(1) / (e^4
    # - 1) = 0.324 inside (1/4, 3/4), where a uniform one has 0.5.
    t = stage.time(torch.linspace(0, 1, 20001)[:-1])
    assert ((t > 0.25) & (t < 0.75)).float().mean().item() == pytest.approx(0.324, abs=2e-3)
    r = torch.full((256, 1, 2, 2), 0.3)
    c = 0.00054 * 4**0.5
    paper = ((0.3**2 * 4 + c**2) ** 0.5 - c) / 4**0.5
    assert stage.loss(r, torch.zeros_like(r)).mean().item() == pytest.approx(paper, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(
            ({"name": name, "learning_rat": 1.0}, r"Did you mean 'learning_rate'\?")
            for name in STAGES
        ),
        (
            {"name": "distill", "steps": 0},
            "stage 'distill': steps: input should be greater than or equal to 1",
        ),
        ({"name": "distill", "steps": 2, "time": {"name": "uniform"}}, r"no option 'time'; it has"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        STAGES.build({**options, "generator": affine()})


@pytest.mark.parametrize(
    ("stage", "data"), [("reflow", "simulated"), ("distill", "folder"), ("rectify", "pairs")]
)
def test_stage_and_data_belong_together(stage: str, data: str, saved):
    given = [
        f"stage={stage}",
        f"data={data}",
        f"stage.parent={saved[0]}",
        "data.root=x" * (data == "folder"),
    ]
    config = compose([one for one in given if one])
    with pytest.raises(InputError, match=f"stage={stage} learns from"):
        build(config)


def test_stage_and_data_belong_together_in_lightning_too(tmp_path):
    trainer, data = quiet_trainer(tmp_path, max_steps=1), ScanDataModule(sensor=SENSOR)
    with pytest.raises(
        InputError, match="stage=reflow learns from pairs: give data=pairs, not simulated"
    ):
        trainer.fit(Reflow(generator=build_generator(CONFIG)), data)


def test_a_straightened_generator_is_drawn_without_fresh_noise():
    """Its pairs of noise and scan belong together; SDE and DDPM would part them."""
    own = build_sampler("heun2", steps=5)
    for before, after in (
        (build_sampler("sde"), USUAL),
        (build_sampler("renoise"), USUAL),
        (own, own),
    ):
        flow = affine()
        flow.sampler = before
        assert Reflow(generator=flow).generator.sampler == after


def test_a_distilled_flow_keeps_the_steps_that_it_learns():
    assert Distill(generator=affine(), steps=2, sampler={"steps": 2}).generator.sampler.steps == 2
    for other in ({"steps": 8}, {"name": "adams3"}):
        with pytest.raises(InputError, match=r"distilled for euler, 2 steps alone"):
            Distill(generator=affine(), steps=2, sampler=other)
