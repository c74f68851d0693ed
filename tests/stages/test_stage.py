"""What all stages share: steps that a stage takes itself are those that Lightning would take."""

import copy
import inspect
from typing import Any

import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision
from torch import nn
from torch.utils.data import DataLoader

from r2flow.base.errors import InputError
from r2flow.data.datamodule import ScanDataModule
from r2flow.generators import Generated, Generator
from r2flow.samplers import FixedSteps
from r2flow.stages import STAGES, Distill, Rectify, Stage
from r2flow.stages.base import SingleLoss
from r2flow.stages.muon import Muon, is_hidden_matrix, orthogonalised
from tests.conftest import quiet_trainer

BATCHES = DataLoader(list(torch.randn(6, 4, generator=torch.Generator().manual_seed(1))))
CLIP = 0.1


class Linear(Generator):
    def __init__(self) -> None:
        nn.Module.__init__(self)
        self.layer = nn.Linear(4, 1)
        self.run_by(FixedSteps())

    def forward(self, noise, condition=None, **options):
        return Generated.after(self.layer(noise), 1)


class Automatic(Stage):
    def __init__(self) -> None:
        torch.manual_seed(0)
        super().__init__(generator=Linear(), learning_rate=0.1, warmup_images=2)
        self.rates: list[float] = []
        self.other = nn.Linear(4, 1)

    def training_step(self, batch, batch_idx):
        return self.generator(batch).x.square().sum()

    def on_train_batch_end(self, outputs, batch, batch_idx) -> None:
        schedules = self.lr_schedulers()
        self.rates.append(
            (schedules[0] if isinstance(schedules, list) else schedules).get_last_lr()[0]
        )


class Manual(Automatic):
    def __init__(self) -> None:
        super().__init__()
        self.automatic_optimization, self.gradient_clip_val = False, CLIP

    def configure_optimizers(self):
        return self.optimizers_for(self.generator.parameters(), self.other.parameters())

    def training_step(self, batch, batch_idx):
        first, second = self.own_optimizers()
        self.take_step(second, (self.other(batch) * self.generator(batch).x).sum())
        self.take_step(first, super().training_step(batch, batch_idx))


def fitted(stage: Stage, folder) -> Stage:
    trainer = quiet_trainer(
        folder, max_steps=6, gradient_clip_val=CLIP if stage.automatic_optimization else None
    )
    trainer.fit(stage, BATCHES)
    assert trainer.global_step == 6
    return stage


def test_steps_of_its_own_are_clipped_scheduled_and_counted_as_lightning_s(tmp_path):
    automatic, manual = fitted(Automatic(), tmp_path), fitted(Manual(), tmp_path)
    for a, b in zip(automatic.generator.parameters(), manual.generator.parameters(), strict=True):
        assert torch.equal(a, b)
    assert manual.rates == automatic.rates
    # a warm-up of two images is one of two steps
    assert automatic.rates[:2] == pytest.approx([0.05, 0.1])
    assert not torch.equal(manual.other.weight, Manual().other.weight)
    stage = type(
        "Own",
        (Automatic,),
        {"training_step": lambda self, batch, _: self.other(batch).square().sum()},
    )()
    assert not torch.equal(fitted(stage, tmp_path).other.weight, Automatic().other.weight)


def batch_of(loss: float) -> dict[str, object]:
    return {"x_1": torch.zeros(1), "x_0": torch.zeros(1), "u": loss, "k": 0}


class Given(SingleLoss):
    def regression_loss(self, batch, u):
        return u.mean() + 0 * self.generator.layer.bias.sum()


def test_the_logged_loss_is_the_mean_over_the_parts_of_a_step(tmp_path):
    trainer = quiet_trainer(tmp_path, max_steps=2, accumulate_grad_batches=2)
    trainer.fit(
        Given(generator=Linear()), DataLoader([batch_of(loss) for loss in (1.0, 2.0, 4.0, 8.0)])
    )
    assert trainer.callback_metrics["train/loss"] == (4 + 8) / 2


class Slope(Stage):
    def __init__(self, slope: float) -> None:
        super().__init__(generator=Linear(), warmup_images=0)
        self.automatic_optimization, self.gradient_clip_val, self.slope = False, CLIP, slope

    def configure_optimizers(self):
        return [torch.optim.SGD(self.generator.layer.parameters(), lr=1.0)], []

    def training_step(self, batch, batch_idx):
        self.take_step(self.own_optimizers()[0], self.slope * self.generator.layer.bias.sum())


def test_a_wrapped_network_is_refused_and_one_compiled_in_place_trains(tmp_path):
    compiled, wrapped = Automatic(), Automatic()
    compiled.generator.layer.compile(backend="eager")
    assert fitted(compiled, tmp_path).state_dict().keys() == wrapped.state_dict().keys()
    wrapped.generator.layer = torch.compile(wrapped.generator.layer)
    with pytest.raises(InputError, match=r"use module\.compile"):
        fitted(wrapped, tmp_path)


@pytest.mark.parametrize("slope", [0.02, 0.5])
def test_gradients_are_clipped_after_they_were_scaled_back(tmp_path, slope):
    scaled = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu", init_scale=256.0))
    stage = Slope(slope)
    before = stage.generator.layer.bias.detach().clone()
    quiet_trainer(tmp_path, max_steps=1, plugins=[scaled]).fit(stage, BATCHES)
    assert float(before - stage.generator.layer.bias.detach()) == pytest.approx(
        min(slope, CLIP), rel=1e-3
    )


RATE, MOMENTUM = 0.05, 0.9
ADAMW = {"lr": 1e-2, "betas": (0.9, 0.99), "weight_decay": 0.1}


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(2, 16, 3), nn.Conv2d(16, 32, 3), nn.Flatten(), nn.Linear(32, 48), nn.Linear(48, 2)
    )


def gradients(model: nn.Module, seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    for p in model.parameters():
        p.grad = torch.randn(p.shape, generator=rng)


@pytest.mark.parametrize("shape", [(24, 24), (64, 16), (16, 200)])
def test_singular_values_come_near_one_and_directions_stay(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    u, _, v = torch.linalg.svd(matrix.double(), full_matrices=False)
    in_its_directions = u.T @ orthogonalised(matrix).double() @ v.T
    values = in_its_directions.diagonal()
    # five steps of the polynomial leave [0.68, 1.14] for values above 1e-2 of the largest; bfloat16
    # adds its rounding
    assert values.min() > 0.6
    assert values.max() < 1.2
    assert (in_its_directions - values.diag()).abs().max() < 0.05
    assert not orthogonalised(0 * matrix).any()


def test_matrices_between_hidden_layers_are_learned_so():
    assert {name for name, p in network().named_parameters() if is_hidden_matrix(p)} == {
        "1.weight",
        "3.weight",
    }


def test_all_other_weights_are_adamw_s():
    model, other = network(), network()
    ours = Muon(model.parameters(), RATE, MOMENTUM, **ADAMW)
    theirs = torch.optim.AdamW([p for p in other.parameters() if not is_hidden_matrix(p)], **ADAMW)
    for seed in range(3):
        gradients(model, seed), gradients(other, seed)
        ours.step(), theirs.step()
    for p, q in zip(model.parameters(), other.parameters(), strict=True):
        assert torch.equal(p, q) != is_hidden_matrix(p)


# 32 rows of 144 columns, 48 of 32
@pytest.mark.parametrize(("layer", "factor"), [(1, 1), (3, 1.5**0.5)])
def test_a_step_of_a_matrix_is_the_equation(layer, factor):
    model = network()
    ours = Muon(model.parameters(), RATE, MOMENTUM, **ADAMW)
    matrix = model[layer].weight
    expected, average = matrix.detach().clone().flatten(1), torch.zeros_like(matrix).flatten(1)
    for seed, rate in enumerate((RATE, RATE / 2)):
        ours.param_groups[1]["lr"] = rate  # as a schedule does
        gradients(model, seed)
        g = matrix.grad.flatten(1)
        average = MOMENTUM * average + (1 - MOMENTUM) * g
        step = orthogonalised((1 - MOMENTUM) * g + MOMENTUM * average)
        # sqrt(max(1, rows / columns))
        expected = expected * (1 - rate * 0.1) - rate * factor * step
        ours.step()
    assert torch.allclose(matrix.flatten(1), expected, atol=1e-5)


def test_it_goes_on_from_its_state_bit_for_bit():
    model = network()
    ours = Muon(model.parameters(), RATE, **ADAMW)
    gradients(model, 0), ours.step()
    later = copy.deepcopy(model)
    resumed = Muon(later.parameters(), RATE, **ADAMW)
    resumed.load_state_dict(copy.deepcopy(ours.state_dict()))
    for net, optimizer in ((model, ours), (later, resumed)):
        gradients(net, 1), optimizer.step()
    assert all(
        torch.equal(p, q) for p, q in zip(model.parameters(), later.parameters(), strict=True)
    )


def test_a_closure_clears_the_gradients_of_all_weights():
    """Lightning hands the whole of a step over as a closure; gradients of earlier steps must not
    stay.
    """
    model, other = network(), network()
    ours, theirs = (Muon(net.parameters(), RATE, **ADAMW) for net in (model, other))
    for x in torch.randn(3, 2, 2, 5, 5, generator=torch.Generator().manual_seed(0)):

        def closure(x: torch.Tensor = x) -> float:
            ours.zero_grad()
            loss = model(x).square().sum()
            loss.backward()
            return float(loss.detach())

        ours.step(closure)
        other.zero_grad()
        other(x).square().sum().backward()
        theirs.step()
    assert all(
        torch.equal(p, q) for p, q in zip(model.parameters(), other.parameters(), strict=True)
    )


@pytest.mark.parametrize("name", STAGES)
def test_every_argument_is_named_typed_and_described(name):
    for kind in (STAGES[name], ScanDataModule):
        for one in inspect.signature(kind).parameters.values():
            assert one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY), one
            assert one.annotation not in (one.empty, Any), one
            assert one.default is not one.empty, one
            assert f"\n    {one.name}: " in kind.__doc__, one


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        (lambda: Rectify(lr=1e-3), "learning_rate"),
        (lambda: Rectify(backbon="hdit"), "backbone"),
        (lambda: ScanDataModule(num_workers=2), "workers"),
        (lambda: ScanDataModule(data_dir="scans"), "root"),
    ],
)
def test_a_wrong_name_is_answered_with_the_right_one(wrong, right):
    with pytest.raises(InputError, match=rf"no option '\w+'; .*Did you mean '{right}'\?"):
        wrong()


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        (lambda: Rectify(learning_rate=-1), "learning_rate"),
        (lambda: Rectify("hdit_tiny", 64), "sensor"),
        (lambda: Distill(steps=0), "steps"),
        (lambda: Distill(betas=(0.9, 1)), r"betas\.1"),
        (lambda: ScanDataModule(batch_size=0), "batch_size"),
    ],
)
def test_a_value_out_of_bounds_is_refused_by_its_name(wrong, name):
    with pytest.raises(InputError, match=rf"^\w+: {name}"):
        wrong()
