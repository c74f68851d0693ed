from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from r2flow.callbacks import EMA, SamplePictures
from r2flow.callbacks.curvature import Curvature
from r2flow.callbacks.periodic import Periodic
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

from r2flow.base.noise import standard_normal
from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.reports import pictures
from r2flow.reports.training import read_curves
from tests.conftest import SENSOR, quiet_trainer
from tests.fields import Field

pytestmark = pytest.mark.filterwarnings("ignore:.*")

SPACE = ModelSpace(SENSOR, Encoding(SENSOR), SENSOR.rays())
# Of 1, 2 and 3 at steps 2 and 3: the average copies 1, takes 1 - 2^(-2/3) of it and the rest of 2,
# then half of 3.
AVERAGES = 1 + 2 ** (-2 / 3), (1 + 2 ** (-2 / 3) + 3) / 2


class Shrinking(nn.Module):
    """v = -a x, whose Euler path is x_0 (1 - a / n)^k; dropout would show in training mode."""

    def __init__(self, a: float) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.tensor(a))
        self.dropout = nn.Dropout(0.5)

    def forward(self, t, x):
        return -self.a * self.dropout(x)


class Stage(L.LightningModule):
    """Its parameter a takes the values 1, 2, 3, ... step by step."""

    def __init__(self) -> None:
        super().__init__()
        self.velocity = Shrinking(0.0)
        self.generator = Field(self.velocity, SPACE.shape, SPACE)
        self.seed = 7
        self.draws = []

    def training_step(self, batch, batch_idx):
        self.draws.append(torch.rand(()).item())
        assert self.velocity.dropout.training
        loss = 0.0 * self.velocity.a + batch.mean() * 0.0
        self.log("train/loss", loss + 1.0)
        return loss

    def optimizer_step(self, epoch, batch_idx, optimizer, closure):
        optimizer.step(closure)
        with torch.no_grad():
            self.velocity.a.add_(1.0)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.0)


def fit(tmp_path, callbacks, steps=6, logger=None, **options):
    torch.manual_seed(3)
    stage = Stage()
    loader = torch.utils.data.DataLoader(torch.zeros(64, 1), batch_size=1)
    logger = logger or CSVLogger(tmp_path, name="metrics")
    more = {
        "max_steps": steps,
        "callbacks": callbacks,
        "logger": logger,
        "log_every_n_steps": 1,
        **options,
    }
    quiet_trainer(tmp_path, **more).fit(stage, loader)
    return stage


def exact(a: float, n: int) -> tuple[float, float]:
    """(int s dt, the same over |d|^2) of Euler's n steps: v_k = -a x_0 (1 - a/n)^k, mean over two
    scans.
    """
    factors = [-a * (1 - a / n) ** k for k in range(n)]
    mean = sum(factors) / n
    variance = sum((f - mean) ** 2 for f in factors) / n
    norms = [
        standard_normal(SPACE.shape, 7, "evaluation", i).double().square().sum().item()
        for i in range(2)
    ]
    return variance * sum(norms) / 2, variance / mean**2


def test_the_logged_values_are_those_of_the_averaged_weights(tmp_path):
    fit(
        tmp_path,
        [EMA(decay=0.5, every=1, warmup_steps=0), Curvature(every=2, num=2, steps=4)],
        steps=3,
    )
    curves = read_curves(tmp_path, ("curvature/s", "curvature/bend", "train/loss"))
    assert curves["curvature/s"][0].tolist() == [2, 3]  # every second step, and the last
    assert curves["train/loss"][0].tolist() == [1, 2, 3]
    for index, a in enumerate(AVERAGES):
        s, normalised = exact(a, 4)
        assert curves["curvature/s"][1][index] == pytest.approx(s, rel=1e-4)
        assert curves["curvature/bend"][1][index] == pytest.approx(normalised, rel=1e-4)


def test_training_does_not_notice(tmp_path):
    plain = fit(tmp_path / "plain", [])
    measured = fit(tmp_path / "measured", [Curvature(every=2)])
    assert plain.draws == measured.draws  # torch's generator stands where it stood
    assert torch.equal(plain.velocity.a, measured.velocity.a)


def test_a_resumed_run_does_not_look_again_at_the_step_that_it_goes_on_from():
    """Under accumulation a batch of the next step ends before the step does."""

    class Counted(Periodic):
        def act(self, trainer, pl_module):
            looked.append(trainer.global_step)

    looked: list[int] = []
    trainer = SimpleNamespace(
        global_step=4, estimated_stepping_batches=8, is_global_zero=True, callbacks=[]
    )
    counted, module = Counted(every=2), nn.Module()
    counted.on_train_start(trainer, module)
    for trainer.global_step in (4, 5, 5, 6, 6):
        counted.on_train_batch_end(trainer, module, None, None, 0)
    assert looked == [6]


def test_pictures_show_scans_of_the_averaged_weights_from_the_same_noise(tmp_path, monkeypatch):
    sheets = []
    real = pictures.contact_sheet
    monkeypatch.setattr(
        "r2flow.callbacks.periodic.contact_sheet",
        lambda *given: sheets.append(given) or real(*given),
    )
    callbacks = [EMA(decay=0.5, every=1, warmup_steps=0), SamplePictures(every=2, num=2, steps=4)]
    fit(
        tmp_path,
        callbacks,
        steps=3,
        logger=TensorBoardLogger(tmp_path, name="tensorboard", version=""),
    )
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == [
        "step-00000002.png",
        "step-00000003.png",
    ]
    noise = torch.stack([standard_normal(SPACE.shape, 7, "evaluation", i) for i in range(2)])
    for a, (images, _, titles) in zip(AVERAGES, sheets, strict=True):
        expected = SPACE.decode(noise * (1 - a / 4) ** 4).numpy()  # Euler's path
        np.testing.assert_allclose(np.stack(images), expected, rtol=1e-3, atol=1e-3)
        assert titles in (["step 2"], ["step 3"])
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0}).Reload()
    assert [image.step for image in events.Images("samples")] == [2, 3]


def test_a_picture_that_is_there_is_kept_and_none_may_be_asked_for(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "step-00000002.png").write_bytes(b"kept")
    fit(tmp_path, [SamplePictures(every=2, num=1, steps=1)], steps=2)
    assert (tmp_path / "pictures" / "step-00000002.png").read_bytes() == b"kept"
    fit(tmp_path / "none", [SamplePictures(every=0)], steps=2)
    assert not (tmp_path / "none" / "pictures").exists()
