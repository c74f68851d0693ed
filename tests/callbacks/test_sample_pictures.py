import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from r2flow.callbacks import EMA, SamplePictures
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import SENSORS
from r2flow.lidar.space import ModelSpace
from r2flow.noise import standard_normal
from r2flow.reports import pictures
from tests.callbacks.test_curvature import Stage, fit
from tests.fields import Field

SENSOR = SENSORS["hdl64e"].resized(8, 64)
SPACE = ModelSpace(SENSOR, Encoding(SENSOR), SENSOR.rays())


class Drawn(Stage):
    """Its velocity is -a x, with a = 1, 2, 3, ... step by step."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = Field(self.velocity, SPACE.shape, SPACE)


@pytest.mark.filterwarnings("ignore:.*")
def test_pictures_show_scans_of_the_averaged_weights_from_the_same_noise(tmp_path, monkeypatch):
    sheets = []
    real = pictures.contact_sheet
    monkeypatch.setattr(pictures, "contact_sheet", lambda *given: sheets.append(given) or real(*given))
    callbacks = [EMA(decay=0.5, every=1, warmup_steps=0), SamplePictures(tmp_path / "p", 7, every=2, num=2, steps=4)]
    logger = TensorBoardLogger(tmp_path, name="tensorboard", version="")
    fit(tmp_path, callbacks, steps=3, stage=Drawn(), logger=logger)
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == ["step-00000002.png", "step-00000003.png"]
    noise = torch.stack([standard_normal(SPACE.shape, 7, "evaluation", i) for i in range(2)])
    # The average copies 1, takes 1 - 2^(-2/3) of it and the rest of 2, then half of 3; Euler gives x_0 (1 - a/4)^4.
    second = 1 + 2 ** (-2 / 3)
    for a, (images, _, titles) in zip((second, (second + 3) / 2), sheets, strict=True):
        expected = SPACE.decode(noise * (1 - a / 4) ** 4).numpy()
        np.testing.assert_allclose(np.stack(images), expected, rtol=1e-3, atol=1e-3)
        assert titles in (["step 2"], ["step 3"])
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"images": 0}).Reload()
    assert [image.step for image in events.Images("samples")] == [2, 3]


@pytest.mark.filterwarnings("ignore:.*")
def test_a_picture_that_is_there_is_kept_and_none_may_be_asked_for(tmp_path):
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "step-00000002.png").write_bytes(b"kept")
    fit(tmp_path, [SamplePictures(tmp_path / "p", 0, every=2, num=1, steps=1)], steps=2, stage=Drawn())
    assert (tmp_path / "p" / "step-00000002.png").read_bytes() == b"kept"
    fit(tmp_path, [SamplePictures(tmp_path / "none", 0, every=0)], steps=2, stage=Drawn())
    assert not (tmp_path / "none").exists()
