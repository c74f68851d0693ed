"""Curves, pictures and the config in the loggers that people have, without a network."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from r2flow.callbacks.loggers import LOGGERS, log_config, log_picture

from r2flow.base.errors import InputError

PIXELS = np.arange(8 * 16 * 3, dtype=np.uint8).reshape(8, 16, 3)


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_missing_package_names_its_extra(name, tmp_path, monkeypatch):
    monkeypatch.setattr("r2flow.base.errors.find_spec", lambda package: None)
    with pytest.raises(
        InputError, match=rf"loggers=\[{name}\] needs .* install 'r2flow\[{name}\]'"
    ):
        LOGGERS[name](tmp_path)
    assert not [*tmp_path.iterdir()]


def log_all(run: Path, name: str, loss: float, step: int) -> None:
    loggers = [logger := LOGGERS[name](run)]
    log_config(loggers, {"seed": step, "stage": {"name": "rectify"}})
    logger.log_metrics({"train/loss": loss}, step)
    log_picture(loggers, "samples", PIXELS, step)
    logger.finalize("success")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_mlflow_keeps_curves_pictures_and_the_config_in_the_run(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "")  # and put back what MLflow writes there
    monkeypatch.delenv("MLFLOW_TRACKING_URI")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    log_all(tmp_path, "mlflow", 0.5, 4)
    log_all(tmp_path / "other", "mlflow", 1.0, 4)
    log_all(tmp_path, "mlflow", 0.25, 8)  # the same run goes on
    client = mlflow.MlflowClient((tmp_path / "mlruns").as_uri())
    (experiment,) = client.search_experiments(filter_string="name = 'r2flow'")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.data.params["stage/name"] == "rectify"
    history = client.get_metric_history(run.info.run_id, "train/loss")
    assert [(m.step, m.value) for m in history] == [(4, 0.5), (8, 0.25)]
    pictures = sorted((tmp_path / "mlruns").rglob("images/*.png"))
    assert {re.split("[+%]", path.name)[0] for path in pictures} == {"samples"}
    np.testing.assert_array_equal(np.round(255 * imread(pictures[0])[..., :3]), PIXELS)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_wandb_keeps_curves_pictures_and_the_config_offline(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    log_all(tmp_path, "wandb", 0.5, 4)
    wandb.finish()
    log_all(tmp_path, "wandb", 0.25, 8)  # the same run goes on
    wandb.finish()
    folders = [path for path in (tmp_path / "wandb").glob("offline-run-*-*") if path.is_dir()]
    assert len({path.name.rsplit("-", 1)[1] for path in folders}) == 1
    pictures = [*(tmp_path / "wandb").rglob("media/images/*.png")]
    assert {path.name.split("_")[0] for path in pictures} == {"samples"}
    np.testing.assert_array_equal(np.round(255 * imread(pictures[0])[..., :3]), PIXELS)
    content = b"".join(path.read_bytes() for path in (tmp_path / "wandb").rglob("*.wandb"))
    assert b"train/loss" in content
    assert b"rectify" in content
