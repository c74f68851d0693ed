from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.data.datamodule import ScanDataModule
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import SENSORS
from tests.data.conftest import write_scan

SENSOR = SENSORS["hdl64e"].resized(16, 64)


def module(encoding: Encoding | None = None, **options) -> ScanDataModule:
    data = ScanDataModule(SENSOR, encoding or Encoding(SENSOR), 0, **options)
    data.setup()
    return data


def numbers(source) -> list[int]:
    return [round(float(source[i][0].max())) - 5 for i in range(len(source))]


def test_the_last_share_is_held_out(numbered: Path):
    data = module(name="folder", root=str(numbered), validation={"share": 0.25})
    assert numbers(data.training_source) == list(range(9))
    assert numbers(data.validation_source) == [9, 10, 11]


def test_another_data_set_can_be_held_out(numbered: Path, tmp_path: Path):
    for number in (20, 21):
        write_scan(tmp_path / "other/sequences/08/velodyne" / f"{number:06d}.bin", number)
    other = {"name": "odometry", "root": str(tmp_path / "other"), "split": "validation"}
    data = module(name="folder", root=str(numbered), validation={"data": other})
    assert numbers(data.training_source) == list(range(12))
    assert numbers(data.validation_source) == [20, 21]


def test_scans_too_many_for_memory_are_read_when_needed(numbered: Path):
    lazy = module(name="folder", root=str(numbered), memory_gib=0)
    kept = module(name="folder", root=str(numbered))
    assert lazy.training_source.paths  # a source of files
    np.testing.assert_array_equal(lazy.training_source[3], kept.training_source[3])


def test_validation_batches_are_the_same_every_time(numbered: Path):
    data = module(name="folder", root=str(numbered), validation={"share": 0.5}, batch_size=4)
    first, second = list(data.val_dataloader()), list(data.val_dataloader())
    assert [len(batch["k"]) for batch in first] == [4, 2]
    for a, b in zip(first, second, strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)


def test_simulated_scenes_of_training_and_validation_differ():
    data = module(name="simulated", scenes=6, validation={"share": 0.5})
    scans = np.concatenate([data.training_source.images, data.validation_source.images])
    assert len(np.unique(scans[:, 0].reshape(6, -1), axis=0)) == 6


def test_range_alone_reads_no_reflectance(numbered: Path):
    encoding = Encoding(SENSOR, reflectance=False)
    batch = next(iter(module(encoding, name="folder", root=str(numbered)).val_dataloader()))
    assert batch["x_1"].shape[1:] == (1, 16, 64)


def test_what_cannot_be_is_refused(numbered: Path):
    with pytest.raises(InputError, match="batch_size"):
        module(batch_size=0)
    with pytest.raises(InputError, match=r"no option 'shar'.*Did you mean 'share'"):
        module(validation={"shar": 0.1})
    with pytest.raises(InputError, match="data.root=FOLDER"):
        module(name="kitti_360")
    with pytest.raises(InputError, match="no standard split"):
        module(name="folder", root=str(numbered), split="train")
    with pytest.raises(InputError, match="on_bad_scan"):
        module(name="folder", root=str(numbered), on_bad_scan="ignore")
