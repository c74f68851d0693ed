"""Range images in .npy files; test_scan_files_damage.py has damaged ones."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.reading import Reading, read_image
from r2flow.lidar.scan_files import read_range_image
from r2flow.lidar.sensors import SENSORS
from tests.conftest import memory_below

SENSOR = SENSORS["hdl64e"].resized(8, 32)
READING = Reading(SENSOR, reflectance=True, on_bad_scan="error")
IMAGE = np.random.default_rng(0).uniform(2, 70, (2, 8, 32)).astype(np.float32)


def test_range_images_are_read_as_they_were(tmp_path: Path):
    for number, array in enumerate(
        (IMAGE, np.asfortranarray(IMAGE), IMAGE[:1], IMAGE.astype(np.float64))
    ):
        path = tmp_path / f"{number}.npy"
        np.save(path, array)
        np.testing.assert_array_equal(read_range_image(path), array)
    holes = IMAGE.copy()
    holes[0, 0, :3] = np.nan, np.inf, -np.inf
    np.save(tmp_path / "holes.npy", holes)
    np.testing.assert_array_equal(read_range_image(tmp_path / "holes.npy")[0, 0, :3], 0)
    np.save(tmp_path / "points.npy", np.ones((9, 4), np.float32))
    assert read_range_image(tmp_path / "points.npy") is None
    assert read_range_image(tmp_path / "image.bin") is None
    np.save(tmp_path / "whole.npy", IMAGE.astype(np.int32))
    with pytest.raises(InputError, match="not points"):
        read_image(tmp_path / "whole.npy", READING)
    np.save(tmp_path / "far.npy", 1000 * IMAGE)
    with pytest.raises(InputError, match=r"far\.npy: .* Are these millimetres"):
        read_range_image(tmp_path / "far.npy")


def test_no_more_memory_is_taken_than_a_few_times_the_file(tmp_path: Path):
    path = tmp_path / "large.npy"
    np.save(path, np.ones((2, 512, 2048), np.float32))
    with memory_below(4 * path.stat().st_size):
        read_range_image(path)


@pytest.mark.parametrize("absurd", [-5.0, 500.0, 1e30])
def test_ranges_that_no_lidar_measures_are_reported_and_are_no_returns(
    tmp_path: Path, caplog, absurd: float
):
    image = np.full((2, 8, 32), 0.5, np.float32)
    image[0] = 20
    np.save(tmp_path / "whole.npy", image)
    assert np.array_equal(read_range_image(tmp_path / "whole.npy"), image)
    for count in (1, 4, 2):
        image[0, 3, 5:9], image[0, 3, 5 : 5 + count] = 20, absurd
        np.save(tmp_path / f"{count}.npy", image)
        read_range_image(tmp_path / f"{count}.npy")
    found = read_range_image(tmp_path / "4.npy")
    assert caplog.text.count("ranges below 0") == 1  # once a folder
    assert (
        f"{tmp_path / '1.npy'}: ranges below 0 or above 400 m are taken as no return" in caplog.text
    )
    image[:, 3, 5:9] = 0
    assert np.array_equal(found, image)
