"""Stages and scans in a Trainer of Lightning, as docs/lightning.md shows them."""

import copy
import json
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import BasePredictionWriter, EarlyStopping, ModelCheckpoint
from r2flow.callbacks import EMA, ReflowPairs
from torch.utils.data import DataLoader

import r2flow
from r2flow import Distill, Rectify, Reflow, ScanDataModule
from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.lidar.sensors import SENSORS
from tests.conftest import ROOT, quiet_trainer

pytestmark = pytest.mark.filterwarnings("ignore:.*")

BLOCK = re.compile(r"^```python( script)?\n(.*?)^```", re.M | re.S)
SENSOR = {"name": "hdl64e", "rows": 8, "columns": 64}
BACKBONE = {
    "name": "hdit",
    "base_channels": 8,
    "depths": [1, 1],
    "num_heads": [1, 2],
    "time_channels": 16,
}


def scans(**options) -> ScanDataModule:
    return ScanDataModule("simulated", sensor=SENSOR, scenes=12, batch_size=4, **options)


def flow(**options) -> Rectify:
    return Rectify(BACKBONE, SENSOR, warmup_images=8, **options)


def test_the_page_runs_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    blocks = BLOCK.findall((ROOT / "docs" / "lightning.md").read_text())
    assert len(blocks) == 9
    for number, (is_script, code) in enumerate(blocks):
        if is_script:
            script = tmp_path / "script.py"
            script.write_text(code)
            environment = {
                "PYTHONPATH": str(ROOT),
                "PATH": "",
                "OMP_NUM_THREADS": "1",
                "HOME": str(tmp_path),
            }
            subprocess.run(
                [sys.executable, script], check=True, timeout=200, cwd=tmp_path, env=environment
            )
        else:
            exec(compile(code, f"docs/lightning.md, block {number + 1}", "exec"), names)
    assert {"test/panel", "test/run lengths"} <= names["trainer"].callback_metrics.keys() | set(
        names["tested"]
    )
    assert names["scans"][0].shape == (4, 2, 32, 256)
    assert names["flow"].hparams.learning_rate == 2e-3


def test_an_epoch_is_a_pass_over_the_scans(tmp_path: Path):
    data = scans(validation={"share": 0.4})  # 7 are left
    data.setup("fit")
    batches = list(data.train_dataloader())
    assert [len(batch["k"]) for batch in batches] == [4]  # whole batches
    data = scans(validation={"share": 0.3})  # 8 are left
    seen: list[torch.Tensor] = []

    class Recorder(L.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            seen.append(batch["x_1"])

    trainer = quiet_trainer(tmp_path, max_epochs=2, callbacks=[Recorder()])
    trainer.fit(flow(), data)
    assert trainer.global_step == 4
    for epoch in (torch.cat(seen[:2]), torch.cat(seen[2:])):
        assert len(torch.unique(epoch, dim=0)) == 8
    assert not torch.equal(seen[0], seen[2])  # in another order


def ended(trainer: L.Trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.lightning_module.state_dict().items()}


# an epoch has 3 batches of 4 of the 12 - 2 scans ... 2 whole ones
@pytest.mark.parametrize("stopped_at", [2, 3, 4])
def test_a_run_resumed_anywhere_ends_with_the_same_bits(tmp_path: Path, stopped_at: int):
    def trainer(steps: int, *callbacks: L.Callback) -> L.Trainer:
        return quiet_trainer(
            tmp_path, max_steps=steps, callbacks=[EMA(every=1), *callbacks], gradient_clip_val=1.0
        )

    whole = trainer(7)
    whole.fit(flow(), scans())
    keep = ModelCheckpoint(
        tmp_path, every_n_train_steps=stopped_at, save_top_k=1, monitor=None, filename="kept"
    )
    first = quiet_trainer(
        tmp_path, max_steps=7, callbacks=[EMA(every=1), keep, StopAfter(stopped_at)], gradient_clip_val=1.0,
        enable_checkpointing=True,
    )  # fmt: skip
    first.fit(flow(), scans())
    assert first.global_step == stopped_at
    second = trainer(7)
    second.fit(flow(), scans(), ckpt_path=tmp_path / "kept.ckpt")
    for name, value in ended(whole).items():
        assert torch.equal(value, ended(second)[name]), name


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 2)])
def test_a_run_resumed_with_other_parts_of_a_batch_sees_the_same_images(tmp_path, before, after):
    seen: list[int] = []

    class Recorder(L.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            seen.extend(batch["k"].tolist())

    keep = ModelCheckpoint(tmp_path, every_n_train_steps=3, monitor=None, filename="kept")
    first = quiet_trainer(
        tmp_path, max_steps=7, callbacks=[Recorder(), keep, StopAfter(3)], enable_checkpointing=True,
        accumulate_grad_batches=before,
    )  # fmt: skip
    first.fit(flow(), scans())
    second = quiet_trainer(
        tmp_path, max_steps=7, callbacks=[Recorder()], accumulate_grad_batches=after
    )
    second.fit(flow(), scans(), ckpt_path=tmp_path / "kept.ckpt")
    whole = quiet_trainer(tmp_path, max_steps=7)
    whole.fit(flow(), scans())
    assert seen == list(range(7 * 4))
    assert (second.global_step, second.current_epoch) == (whole.global_step, whole.current_epoch)
    for name, value in ended(whole).items():
        torch.testing.assert_close(ended(second)[name], value, rtol=0, atol=2e-6)  # 2.8e-7 seen


class StopAfter(L.Callback):
    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        trainer.should_stop = trainer.global_step == self.step


def test_a_checkpoint_of_a_plain_trainer_is_complete(tmp_path: Path):
    trainer = quiet_trainer(tmp_path, max_steps=2, callbacks=[EMA(every=1)])
    data = scans()
    trainer.fit(flow(learning_rate=1e-3, sampler={"steps": 3}, seed=5), data)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    loaded = Rectify.load_from_checkpoint(tmp_path / "last.ckpt")
    assert (loaded.hparams.learning_rate, loaded.hparams.seed, loaded.sensor.shape) == (
        1e-3,
        5,
        (8, 64),
    )
    model = r2flow.load(tmp_path / "last.ckpt")
    assert model.generator.sampler == loaded.generator.sampler
    assert model.generator.sampler.steps == 3
    for (name, value), other in zip(
        model.generator.named_parameters(), loaded.generator.parameters(), strict=True
    ):
        assert torch.equal(value, other), name
    drawn = torch.cat(quiet_trainer(tmp_path).predict(loaded, data))
    torch.testing.assert_close(drawn, model.sample(len(drawn), seed=5, batch_size=4))


def test_lightning_s_options_work(tmp_path: Path):
    stop = EarlyStopping("val/loss", patience=0, min_delta=1e9)
    best = ModelCheckpoint(tmp_path / "best", monitor="val/loss")
    trainer = quiet_trainer(
        tmp_path, max_epochs=9, callbacks=[stop, best], enable_checkpointing=True
    )
    trainer.fit(flow(), scans())
    assert trainer.current_epoch == 2  # the second epoch was not better by a thousand million
    assert r2flow.load(best.best_model_path).step in (2, 4)
    for options in (
        {"fast_dev_run": True},
        {"max_epochs": 1, "limit_train_batches": 1, "limit_val_batches": 1},
        {"max_epochs": 2, "overfit_batches": 1},
        {"max_epochs": 1, "accumulate_grad_batches": 2},
        {"max_steps": 3, "val_check_interval": 1},
        {"max_epochs": 1, "precision": "bf16-mixed"},
        {"max_epochs": 1, "reload_dataloaders_every_n_epochs": 1},
    ):
        trainer = quiet_trainer(tmp_path, **options)
        trainer.fit(flow(), scans())
        assert trainer.global_step >= 1
    (figures,) = quiet_trainer(tmp_path, limit_test_batches=1).test(flow(), scans(), verbose=False)
    assert figures["test/panel"] > 0


def test_overfitting_sees_the_same_scans(tmp_path: Path):
    seen: list[torch.Tensor] = []
    module = flow()
    module.on_train_batch_end = lambda outputs, batch, batch_idx: seen.append(batch["x_1"])
    quiet_trainer(tmp_path, max_epochs=3, overfit_batches=1).fit(module, scans())
    assert len(seen) == 3
    assert torch.equal(seen[0], seen[1])
    assert torch.equal(seen[0], seen[2])


def test_straightening_and_distilling(tmp_path: Path):
    trainer = quiet_trainer(tmp_path, max_steps=1)
    trainer.fit(flow(), scans())
    trainer.save_checkpoint(tmp_path / "1rf.ckpt")
    parent = "1rf"
    for name, stage, first in (("2rf", Reflow, 0), ("2td", Distill, 8)):
        data = ScanDataModule(
            "pairs", pairs={"num": 8, "batch_size": 4, "sampler": {"name": "euler", "steps": 2}}
        )
        trainer = quiet_trainer(tmp_path, max_steps=1, callbacks=[ReflowPairs()])
        trainer.fit(stage(parent=tmp_path / f"{parent}.ckpt"), data)
        trainer.save_checkpoint(tmp_path / f"{name}.ckpt")
        assert data.pairs.first == first  # the noise of new pairs was not learned from
        assert len(list((tmp_path / f"{parent}-pairs").glob("*.safetensors"))) == 1
        parent = name
    child = Distill.load_from_checkpoint(tmp_path / "2td.ckpt")  # without its parent's file
    assert child.hparams.parent["stage"] == "reflow"
    assert child.generator.fixed


def test_scans_of_any_loader(tmp_path: Path):
    images = torch.rand(8, 2, 8, 64) * torch.tensor([50.0, 1.0])[:, None, None]
    module = flow()
    x_1 = module.encoding.encode(images)
    trainer = quiet_trainer(tmp_path, max_epochs=1)
    trainer.fit(module, DataLoader(x_1, batch_size=4), DataLoader(x_1, batch_size=4))
    assert trainer.global_step == 2
    assert trainer.callback_metrics["val/loss"] > 0


def test_other_scans_than_the_module_s_are_refused(tmp_path: Path):
    with pytest.raises(
        InputError, match="the module's images are of hdl64e 64x1024, the data's of"
    ):
        quiet_trainer(tmp_path, max_steps=1).fit(Rectify("hdit_tiny"), scans())


def test_a_loader_by_itself_draws_new_noise_in_every_epoch(tmp_path: Path):
    seen: list[int] = []

    class Note(L.Callback):
        def on_train_batch_start(self, trainer, module, batch, batch_idx):
            seen.extend(batch["k"].tolist())

    data = scans()
    loader = data.train_dataloader()
    quiet_trainer(tmp_path, max_epochs=2, callbacks=[Note()], limit_val_batches=0).fit(
        flow(), loader
    )
    assert seen == list(range(2 * len(loader.sampler)))


def test_a_loader_by_itself_is_shared_by_processes(monkeypatch):
    sampler = scans().train_dataloader().sampler
    seen = []
    for rank in range(2):
        monkeypatch.setattr("r2flow.data.loader.rank_and_world_size", lambda rank=rank: (rank, 2))
        seen.append([k for k, _ in sampler])
        assert len(sampler) == len(seen[-1])
    assert sorted(seen[0] + seen[1]) == list(range(8))


def test_weights_that_do_not_fit_are_loaded_where_asked(tmp_path: Path):
    trainer = quiet_trainer(tmp_path, max_steps=1, limit_val_batches=0)
    trainer.fit(flow(), scans())
    trainer.save_checkpoint(tmp_path / "a.ckpt")

    class Other(Rectify):
        def __init__(self, *model, **options):
            super().__init__(*model, **options)
            self.head = torch.nn.Linear(2, 2)

    with pytest.raises(InputError, match=r"2 names missing \['head.bias', 'head.weight'\]"):
        Other.load_from_checkpoint(tmp_path / "a.ckpt")
    loaded = Other.load_from_checkpoint(tmp_path / "a.ckpt", strict=False)
    expected = trainer.lightning_module.state_dict()
    assert all(torch.equal(loaded.state_dict()[name], expected[name]) for name in expected)


@pytest.mark.parametrize("shape", [(4, 1, 8, 64), (4, 2, 1, 64), (4, 2, 16, 64)])
def test_scans_of_another_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]):
    with pytest.raises(InputError, match="x_1 must be scans"):
        flow().whole_batch({"x_1": torch.rand(shape)})
    with pytest.raises(InputError, match=r"up to 80: encode metres"):
        flow().whole_batch({"x_1": torch.full((1, 2, 8, 64), 80.0)})


def test_loaders_of_any_kind(tmp_path: Path):
    x_1 = list(torch.rand(8, 2, 8, 64))
    batches = torch.utils.data.BatchSampler(range(8), 2, drop_last=True)
    loaders = (
        DataLoader(x_1, batch_sampler=batches),
        DataLoader(x_1, None, collate_fn=lambda x: x[None]),
    )
    for loader in loaders:
        trainer = quiet_trainer(tmp_path, max_steps=1, val_check_interval=1)
        trainer.fit(flow(), loader, [DataLoader(x_1, 2), DataLoader(x_1, 4)])
        assert {"val/loss/dataloader_idx_0", "val/loss/dataloader_idx_1"} <= set(
            trainer.callback_metrics
        )


class OwnNetwork(torch.nn.Module):
    """v(t, x), with a convolution that sees t as a channel."""

    def __init__(self, width: int = 4) -> None:
        super().__init__()
        self.first = torch.nn.Conv2d(3, width, 3, padding=1)
        self.last = torch.nn.Conv2d(width, 2, 1)

    def forward(self, t, x):
        t = t[:, None, None, None].expand(-1, 1, *x.shape[2:])
        return self.last(torch.relu(self.first(torch.cat([x, t], 1))))


def test_any_module_is_a_velocity(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    network = OwnNetwork()
    first = copy.deepcopy(network)
    module = Rectify(network, SENSOR, warmup_images=8)
    assert module.backbone is network
    x = torch.randn(3, 2, 8, 64)
    assert torch.equal(module(torch.tensor(0.25), x), network(torch.full((3,), 0.25), x))
    last = tmp_path / "1rf.ckpt"
    keep = ModelCheckpoint(tmp_path, filename="1rf", every_n_train_steps=2, monitor=None)
    stop = StopAfter(2)  # of four, which the learning rate depends on
    trainer = quiet_trainer(
        tmp_path, max_steps=4, callbacks=[EMA(every=1), keep, stop], enable_checkpointing=True
    )
    trainer.fit(module, scans())
    for load in (Rectify.load_from_checkpoint, r2flow.load, lambda path: Reflow(parent=path)):
        with pytest.raises(
            InputError, match=r"is a OwnNetwork.*give --plugin .* backbone=OwnNetwork"
        ):
            load(last)
    loaded = Rectify.load_from_checkpoint(last, backbone=OwnNetwork())
    model = r2flow.load(last, backbone=OwnNetwork())
    torch.testing.assert_close(loaded.sample(2, seed=3), model.sample(2, seed=3))
    monkeypatch.setattr(BACKBONES, "_entries", {})
    BACKBONES.add("own_net", OwnNetwork)  # as by a plug-in
    assert r2flow.load(last).config.backbone == "own_net"
    torch.testing.assert_close(r2flow.load(last).sample(2, seed=3), model.sample(2, seed=3))
    monkeypatch.setattr(OwnNetwork.__init__, "__defaults__", (6,))
    with pytest.raises(InputError, match=r"shape \(4, .* class by its defaults\) makes it \(6, "):
        r2flow.load(last)
    monkeypatch.undo()
    averaged = torch.load(last)["state_dict"]["generator.backbone.network.last.weight"]
    assert torch.equal(loaded.backbone.last.weight, averaged)
    ends = []
    for start, path in ((OwnNetwork(), last), (first, None)):
        trainer = quiet_trainer(tmp_path, max_steps=4, callbacks=[EMA(every=1)])
        trainer.fit(Rectify(start, SENSOR, warmup_images=8), scans(), ckpt_path=path)
        ends.append(start.last.weight)
    assert torch.equal(*ends)


def test_a_flow_of_any_module_is_straightened_and_distilled(tmp_path: Path):
    trainer = quiet_trainer(tmp_path, max_steps=1)
    trainer.fit(Rectify(OwnNetwork(), SENSOR), scans())
    trainer.save_checkpoint(tmp_path / "1rf.ckpt")
    data = ScanDataModule(
        "pairs", pairs={"num": 8, "batch_size": 4, "sampler": {"name": "euler", "steps": 2}}
    )
    trainer = quiet_trainer(tmp_path, max_steps=1, callbacks=[ReflowPairs()])
    straight = Reflow(backbone=OwnNetwork(), parent=tmp_path / "1rf.ckpt")
    # the weights of the parent, not those that its own network had
    first = torch.load(tmp_path / "1rf.ckpt")["state_dict"]
    assert torch.equal(
        straight.backbone.first.weight, first["generator.backbone.network.first.weight"]
    )
    trainer.fit(straight, data)
    trainer.save_checkpoint(tmp_path / "2rf.ckpt")
    student = Distill(backbone=OwnNetwork(), parent=tmp_path / "2rf.ckpt", steps=1)
    assert student.hparams.parent["stage"] == "reflow"
    assert student.sample(1).shape == (1, 2, 8, 64)


def test_a_training_loader_is_whole_before_during_and_after_a_fit(tmp_path: Path):
    data = scans(validation={"share": 0.3})  # 8 are left
    data.setup("fit")

    def numbers() -> list[int]:
        return [k for batch in data.train_dataloader() for k in batch["k"].tolist()]

    assert numbers() == list(range(8))
    module = flow()
    for epochs in (1, 2):
        quiet_trainer(tmp_path, max_epochs=epochs).fit(module, data)
        assert numbers() == list(range(8))
        quiet_trainer(tmp_path).validate(module, data, verbose=False)
        assert numbers() == list(range(8))
    trainer = quiet_trainer(tmp_path, max_steps=3)
    trainer.fit(module, data)  # within the second epoch
    assert numbers() == list(range(8))


PROCESSES = """
import json, sys
import lightning as L
from r2flow import Rectify, ScanDataModule

class Numbers(L.Callback):
    def on_predict_batch_end(self, trainer, module, outputs, batch, *_):
        assert len(outputs) == len(batch["k"])
        seen.extend(batch["k"].tolist())

seen = []
devices, scenes, backbone, sensor = json.loads(sys.argv[1])
data = ScanDataModule(sensor=sensor, scenes=scenes, batch_size=4, validation={"share": 0.25})
trainer = L.Trainer(
    accelerator="cpu", devices=devices, strategy="ddp" if devices > 1 else "auto", max_epochs=1,
    logger=False, enable_checkpointing=False, enable_progress_bar=False, callbacks=[Numbers()],
)
flow = Rectify(backbone, sensor)
trainer.fit(flow, data)
loss = float(trainer.callback_metrics["val/loss"])
(figures,) = trainer.test(flow, data, verbose=False)
trainer.predict(flow, data)
with open(f"{sys.argv[2]}/{trainer.global_rank}.json", "w") as file:
    json.dump([loss, figures["test/panel"], seen], file)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("devices", "scenes"), [(2, 20), (4, 12)])
def test_processes_measure_as_one(tmp_path: Path, devices: int, scenes: int):
    held_out = scenes // 4  # 5 by two, 3 by four
    (tmp_path / "script.py").write_text(PROCESSES)
    found = {}
    for number in (1, devices):
        folder = tmp_path / str(number)
        folder.mkdir()
        given = json.dumps([number, scenes, BACKBONE, SENSOR])
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        subprocess.run(
            [sys.executable, tmp_path / "script.py", given, folder],
            check=True, timeout=300, env=environment, capture_output=True,
        )  # fmt: skip
        found[number] = [json.loads((folder / f"{n}.json").read_text()) for n in range(number)]
    ((loss, panel, numbers),) = found[1]
    assert numbers == list(range(held_out))
    shared = found[devices]
    assert sorted(k for one in shared for k in one[2]) == numbers
    for one in shared:
        # the weights differ by the order of sums
        assert one[:2] == [pytest.approx(loss, rel=1e-5), pytest.approx(panel, abs=1e-5)]


class Writer(BasePredictionWriter):
    def write_on_epoch_end(self, trainer, module, predictions, batch_indices):
        self.written = torch.cat(predictions)
        self.numbers = batch_indices


def test_a_writer_of_predictions_is_told_the_scans_by_number(tmp_path: Path):
    writer = Writer("epoch")
    data = ScanDataModule(
        "simulated", sensor=SENSOR, scenes=10, batch_size=3, validation={"share": 0.5}
    )
    trainer = quiet_trainer(tmp_path, callbacks=[writer])
    trainer.predict(flow(), data, return_predictions=False)
    assert writer.numbers == [[[0, 1, 2], [3, 4]]]  # one loader of two batches
    assert writer.written.shape == (5, 2, 8, 64)


class Saving(Rectify):
    def __init__(self, extra: int = 3, **options) -> None:
        super().__init__(**options)
        self.save_hyperparameters()


def test_a_stage_that_saves_its_arguments_again_is_loaded(tmp_path: Path):
    trainer = quiet_trainer(tmp_path, max_steps=1)
    trainer.fit(
        Saving(extra=5, backbone=BACKBONE, sensor=SENSORS["hdl64e"].resized(8, 64)), scans()
    )
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    loaded = Saving.load_from_checkpoint(tmp_path / "a.ckpt", weights_only=True)
    assert loaded.hparams.extra == 5
    expected = loaded.sample(1)
    torch.testing.assert_close(r2flow.load(tmp_path / "a.ckpt").sample(1), expected)


def test_an_average_is_pickled():
    average = pickle.loads(pickle.dumps(EMA(rule="ratio")))
    average._step = 9
    assert average._decay() == (1 + 10) / (10 + 10)


@pytest.mark.parametrize("callback", [ModelCheckpoint, EarlyStopping])
def test_a_monitor_of_another_name_is_answered_before_training(tmp_path: Path, callback):
    trainer = quiet_trainer(
        tmp_path, max_steps=1, callbacks=[callback(monitor="val_loss")], enable_checkpointing=True
    )
    with pytest.raises(InputError, match=r"monitors 'val_loss'.*Did you mean 'val/loss'\?"):
        trainer.fit(flow(), scans())


def test_a_folder_is_no_kind_of_scans(tmp_path: Path):
    with pytest.raises(InputError, match="is a folder: give 'folder', or its kind, and root="):
        ScanDataModule(str(tmp_path))


def test_a_test_of_a_few_scans_says_so(tmp_path: Path, caplog):
    quiet_trainer(tmp_path).test(flow(sampler={"steps": 1}), scans(), verbose=False)
    assert "2 held-out scans are too few" in caplog.text
