"""What all stages share: steps that a stage takes itself are those that Lightning would take."""

import lightning as L
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision
from torch import nn
from torch.utils.data import DataLoader

from r2flow.generators import Generated, Generator
from r2flow.stages import Stage

BATCHES = DataLoader(list(torch.randn(6, 4, generator=torch.Generator().manual_seed(1))))
CLIP = 0.1


class Linear(Generator):
    def __init__(self) -> None:
        nn.Module.__init__(self)
        self.layer = nn.Linear(4, 1)

    def forward(self, noise, condition=None, **options):
        return Generated.after(self.layer(noise), 1)


class Automatic(Stage):
    """Descends from the square of a linear map."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        super().__init__(Linear(), learning_rate=0.1, warmup_images=16)
        self.rates: list[float] = []
        self.other = nn.Linear(4, 1)

    def training_step(self, batch, batch_idx):
        return self.generator(batch).x.square().sum()

    def on_train_batch_end(self, outputs, batch, batch_idx) -> None:
        schedules = self.lr_schedulers()
        first = schedules[0] if isinstance(schedules, list) else schedules
        self.rates.append(first.get_last_lr()[0])


class Manual(Automatic):
    """The same by its own hand, beside a second loss with an optimiser of its own."""

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
    trainer = L.Trainer(
        accelerator="cpu", max_steps=6, max_epochs=-1, default_root_dir=folder, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        gradient_clip_val=CLIP if stage.automatic_optimization else None,
    )  # fmt: skip
    trainer.fit(stage, BATCHES)
    assert trainer.global_step == 6
    return stage


def test_steps_of_its_own_are_clipped_scheduled_and_counted_as_lightning_s(tmp_path):
    automatic, manual = fitted(Automatic(), tmp_path), fitted(Manual(), tmp_path)
    for a, b in zip(automatic.generator.parameters(), manual.generator.parameters(), strict=True):
        assert torch.equal(a, b)
    assert manual.rates == automatic.rates
    assert automatic.rates[:2] == pytest.approx([0.05, 0.1])  # a warm-up of 16 images is one of two steps
    untouched = Manual().other.weight
    assert not torch.equal(manual.other.weight, untouched)


class Slope(Stage):
    """One step of SGD, of the length of its clipped gradient."""

    def __init__(self, slope: float) -> None:
        super().__init__(Linear(), warmup_images=0)
        self.automatic_optimization, self.gradient_clip_val, self.slope = False, CLIP, slope

    def configure_optimizers(self):
        optimizer = torch.optim.SGD(self.generator.layer.parameters(), lr=1.0)
        return [optimizer], []

    def training_step(self, batch, batch_idx):
        self.take_step(self.own_optimizers()[0], self.slope * self.generator.layer.bias.sum())


@pytest.mark.parametrize("slope", [0.02, 0.5])
def test_gradients_are_clipped_after_they_were_scaled_back(tmp_path, slope):
    scaled = MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu", init_scale=256.0))
    stage = Slope(slope)
    before = stage.generator.layer.bias.detach().clone()
    trainer = L.Trainer(
        accelerator="cpu", max_steps=1, default_root_dir=tmp_path, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, plugins=[scaled],
    )  # fmt: skip
    trainer.fit(stage, BATCHES)
    assert float(before - stage.generator.layer.bias.detach()) == pytest.approx(min(slope, CLIP), rel=1e-3)
