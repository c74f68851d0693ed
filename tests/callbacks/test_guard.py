"""Non-finite numbers: what is skipped, what stops, and what is never written."""

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import LambdaCallback
from lightning.pytorch.plugins import MixedPrecision
from r2flow.callbacks.checkpoints import AtomicCheckpointIO
from r2flow.callbacks.ema import EMA
from r2flow.callbacks.guard import Guard
from torch import nn
from torch.utils.data import DataLoader, Dataset

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.data.loader import Permutations, RunSampler
from r2flow.model.paths import checkpoints_of
from tests.conftest import quiet_trainer, refused

NAN, INF = float("nan"), float("inf")


class Line(L.LightningModule):
    """Fits y = a x + b; `offset` is added to the loss and has no part in the gradient."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.inner = nn.Linear(1, 4)
        self.outer = nn.Linear(4, 1)

    def training_step(self, batch, batch_idx):
        x, offset = batch
        return (self.outer(self.inner(x)) - 3 * x).square().mean() + offset.mean()

    def configure_optimizers(self):
        return torch.optim.AdamW(self.parameters(), lr=0.05, betas=(0.9, 0.99))


def batches(*values: float, offset: dict[int, float] | None = None) -> DataLoader:
    """One number a step, in order; `offset` by step."""
    return DataLoader(
        [
            (torch.tensor([x]), torch.tensor((offset or {}).get(i, 0.0)))
            for i, x in enumerate(values)
        ]
    )


def fit(
    module: L.LightningModule, loader, tmp_path, *callbacks: L.Callback, **options
) -> L.Trainer:
    clip = 1.0 if module.automatic_optimization else None
    own = {
        "max_steps": 100,
        "max_epochs": 1,
        "gradient_clip_val": clip,
        "use_distributed_sampler": False,
    }
    plugins = [AtomicCheckpointIO(), *options.pop("plugins", [])]
    trainer = quiet_trainer(tmp_path, callbacks=list(callbacks), plugins=plugins, **own, **options)
    trainer.fit(module, loader)
    return trainer


@pytest.mark.parametrize(("value", "offset"), [(NAN, 0.0), (INF, 0.0), (2.0, INF)])
def test_a_skipped_step_is_as_if_it_had_never_been(tmp_path, value: float, offset: float):
    # AdamW at a constant rate counts its own steps: without the broken one the same weights come
    # out. An infinite offset makes the loss infinite and leaves its gradient finite.
    skipped, without, guard = Line(), Line(), Guard()
    fit(skipped, batches(1.0, 2.0, value, -1.0, 0.5, offset={2: offset}), tmp_path, guard)
    fit(without, batches(1.0, 2.0, -1.0, 0.5), tmp_path)
    torch.testing.assert_close(skipped.state_dict(), without.state_dict(), rtol=0, atol=0)
    assert (guard.total, guard.in_a_row) == (1, 0)


def test_only_steps_in_a_row_end_a_run(tmp_path):
    guard = Guard(skips=3)
    fit(Line(), batches(1.0, NAN, NAN, 1.0, NAN, NAN, 1.0), tmp_path, guard)
    assert guard.total == 4
    with pytest.raises(
        InputError, match="stopped at step 4: steps skipped in a row .*: 3, 3 in the run"
    ):
        fit(Line(), batches(1.0, NAN, NAN, NAN, 1.0), tmp_path, Guard(skips=3))


def test_the_count_survives_a_resumption(tmp_path):
    guard = Guard()
    guard.load_state_dict({"in_a_row": 9, "total": 9})
    assert guard.state_dict() == {"in_a_row": 9, "total": 9}
    with pytest.raises(InputError, match="steps skipped in a row .*: 10,"):
        fit(Line(), batches(NAN), tmp_path, guard)


class Numbered(Dataset):
    """x of scan i is 1, of the broken ones NaN."""

    def __init__(self, broken: set[int]) -> None:
        self.broken = broken

    def __getitem__(self, key: tuple[int, int]):
        return torch.tensor([NAN if key[1] in self.broken else 1.0]), torch.tensor(0.0)


class Batches(L.LightningDataModule):
    """Steps of 4 images, in parts of 2."""

    batch_size = 4

    def __init__(self, broken: set[int]) -> None:
        super().__init__()
        self.dataset = Numbered(broken)

    def train_dataloader(self) -> DataLoader:
        return DataLoader(self.dataset, batch_size=2, sampler=RunSampler(Permutations(6, 0), 40))


def test_the_line_names_everything_needed_to_look_further(tmp_path):
    # Two accumulated batches of 2: the first step takes images 0 to 3, the second 4 to 7.
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "step-00000001.ckpt").touch()
    order = [
        int(s) for epoch in range(2) for s in noise.generator(0, "shuffle", epoch).permutation(6)
    ]
    data = Batches({order[5]} - set(order[:4]))
    with refused(
        "stopped at step 2: steps skipped in a row for a non-finite loss or gradient: 1",
        "Loss nan",
        "loss scale 1 of 32-true",
        "images k = 4 to 7, scans " + ", ".join(map(str, order[4:8])),
        f"last good checkpoint is {tmp_path}/checkpoints/step-00000001.ckpt",
    ):
        fit(Line(), data, tmp_path, Guard(skips=1), accumulate_grad_batches=2)
    with refused("stopped at step 2: steps skipped in a row", "images unknown to the loader"):
        fit(Line(), data.train_dataloader(), tmp_path, Guard(skips=1), accumulate_grad_batches=2)


def half(scale: float) -> MixedPrecision:
    """16-mixed, which Lightning has on GPUs only, with a scale to start from."""
    return MixedPrecision(
        "16-mixed", "cpu", torch.amp.GradScaler("cpu", init_scale=scale, growth_interval=1000)
    )


def test_a_loss_scale_that_finds_its_place_is_no_defect(tmp_path):
    # Half precision ends at 65504 < 2^16: gradients of size one overflow until the scale is well
    # below that.
    plugin, guard = half(2.0**20), Guard()
    fit(Line(), batches(*[1.0] * 20), tmp_path, guard, plugins=[plugin])
    assert plugin.scaler.get_scale() < 2.0**17
    assert (guard.total, guard.in_a_row) == (0, 0)


def test_a_loss_scale_that_finds_no_place_ends_the_run(tmp_path):
    with pytest.raises(InputError, match=r"in a row .*: 3, 0 in the run.* loss scale 262144"):
        fit(Line(), batches(*[1.0] * 20), tmp_path, Guard(skips=3), plugins=[half(2.0**20)])
    with pytest.raises(InputError, match=r"in a row .*: 1, .* loss scale 1.04858e\+06"):
        fit(Line(), batches(1.0), tmp_path, Guard(lowest_scale=2.0**21), plugins=[half(2.0**20)])


def test_a_loss_that_is_no_number_is_a_defect_whatever_the_scale(tmp_path):
    guard = Guard()
    fit(Line(), batches(NAN, *[1.0] * 9), tmp_path, guard, plugins=[half(2.0**20)])
    assert guard.total == 1  # and not the steps behind it, which lower the scale


@pytest.mark.parametrize("averaged", [False, True])
def test_broken_weights_are_never_written(tmp_path, averaged: bool):
    def spoil(trainer, module, *_):
        if trainer.global_step == 3:
            module.inner.bias.data[0] = NAN
        trainer.save_checkpoint(tmp_path / f"checkpoints/step-{trainer.global_step:08d}.ckpt")

    callbacks = [EMA(every=1)] * averaged + [Guard(), LambdaCallback(on_train_batch_end=spoil)]
    stopped = "stopped at step 3: the weights or their average are no longer finite, so no"
    with refused(stopped, "step-00000002.ckpt, from which the same command resumes"):
        fit(Line(), batches(*[1.0] * 9), tmp_path, *callbacks)
    assert [p.name for p in checkpoints_of(tmp_path)] == [
        "step-00000002.ckpt",
        "step-00000001.ckpt",
    ]


class TwoLosses(Line):
    """Each layer has an optimiser of its own; the gradient of the outer one is broken at the step
    of a negative x.
    """

    def __init__(self) -> None:
        super().__init__()
        self.automatic_optimization = False

    def training_step(self, batch, batch_idx):
        x, _ = batch
        for optimizer, layer in zip(self.optimizers(), (self.inner, self.outer), strict=True):
            optimizer.zero_grad()
            self.manual_backward(self.outer(self.inner(x)).square().mean())
            if layer is self.outer and x < 0:
                layer.weight.grad[0, 0] = NAN
            optimizer.step()

    def configure_optimizers(self):
        return [
            torch.optim.AdamW(layer.parameters(), lr=0.05) for layer in (self.inner, self.outer)
        ]


def test_of_two_optimizers_the_one_with_broken_gradients_skips_its_step(tmp_path):
    module, guard = TwoLosses(), Guard()
    before = {name: p.detach().clone() for name, p in module.named_parameters()}
    fit(module, batches(-1.0), tmp_path, guard)
    changed = {name for name, p in module.named_parameters() if not torch.equal(p, before[name])}
    assert changed == {"inner.weight", "inner.bias"}
    assert (guard.total, guard.in_a_row) == (1, 1)


def test_the_other_optimizer_s_steps_do_not_end_a_row(tmp_path):
    with pytest.raises(InputError, match="steps skipped in a row .*: 3,"):
        fit(TwoLosses(), batches(1.0, -1.0, -1.0, -1.0, -1.0), tmp_path, Guard(skips=3))
    guard = Guard(skips=3)
    fit(TwoLosses(), batches(-1.0, -1.0, 1.0, -1.0, -1.0), tmp_path, guard)
    assert (guard.total, guard.in_a_row) == (4, 2)
