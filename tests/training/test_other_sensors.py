"""One training step on real scans of other sensors, and on a sensor of one's own."""

import shutil
from pathlib import Path

import pytest

from r2flow.lidar.sensor_files import write_sensor
from r2flow.lidar.sensors import Sensor
from r2flow.model.checkpoint import load_checkpoint
from tests.training.conftest import TINY, in_process

CASES = {
    "vlp16": ["sensor=vlp16", "encoding.reflectance=false"],
    "nuscenes_hdl32e": ["sensor=hdl32e", "data.reading.reflectance_scale=255"],
    "rellis_vlp32c": ["sensor=vlp32c", "data.reading.reflectance_scale=255"],
    "rellis_os1_64": ["sensor=os1_64", "data.reading.reflectance_scale=0.012", "data.reading.projection=unfolding"],
}
# The sensors' own sizes, of TINY only the small network and what a test need not wait for.
SMALL = [part for part in TINY if not part.startswith(("sensor.", "data.validation", "trainer.val"))]


def one_step(folder: Path, *overrides: str) -> None:
    in_process(folder, [*overrides, "data.batch_size=1"])


@pytest.mark.parametrize("folder", list(CASES))
def test_other_sensors_train_one_step(shared, tmp_path, folder: str):
    root = shared / "real" / "other_sensors" / folder
    one_step(tmp_path, *SMALL, f"data.root={root}", *CASES[folder], "trainer.fast_dev_run=true")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "backbone"),
    [*((folder, "hdit_tiny") for folder in CASES), ("vlp16", "efficient_unet"), ("vlp16", "adm_unet")],
)
def test_other_sensors_train_one_step_of_a_whole_network(shared, tmp_path, folder, backbone):
    root = shared / "real" / "other_sensors" / folder
    network = ["data=folder", f"backbone={backbone}", "trainer=cpu", "callbacks.pictures=null"]
    one_step(tmp_path, *network, f"data.root={root}", *CASES[folder], "trainer.fast_dev_run=true")


MINE = Sensor(
    "sparse", (3.0, 1.0, 0.0, -1.0, -2.5, -6.0, -12.0, -24.0), columns=64, min_range=2.0, firing=(7, *range(7))
)


def test_a_sensor_of_one_s_own_trains_and_travels_in_the_checkpoint(scans: Path, tmp_path: Path):
    write_sensor(MINE, tmp_path / "conf" / "sensor" / "sparse.yaml", "a sensor of a test")
    one_step(
        tmp_path, "--config-dir", str(tmp_path / "conf"), *SMALL, f"data.root={scans}",
        "sensor=sparse", "name=own", "trainer.max_steps=1", "sampler.steps=1",
    )  # fmt: skip
    shutil.rmtree(tmp_path / "conf")
    assert load_checkpoint(tmp_path / "runs" / "own").sensor == MINE
