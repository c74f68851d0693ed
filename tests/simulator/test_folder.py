"""`r2flow simulate`: the files hold the simulator's scans, however many processes write them and in
whatever order.
"""

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.projection import project
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate
from r2flow.simulator.folder import SimulatedFolder
from r2flow.store import manifest_of
from tests.conftest import files

SMALL = SENSORS["hdl64e"].resized(16, 128)


def write_folder(folder: SimulatedFolder, items, workers: int) -> int:
    folder.begin()
    missing = folder.missing(items)
    folder.make(missing, folder.simulate, workers)
    return len(missing)


def test_files_hold_what_the_simulator_draws(tmp_path):
    folder = SimulatedFolder(tmp_path / "a", SMALL, 3, ("bin", "npy"), labels=True)
    assert write_folder(folder, range(5, 7), workers=1) == 2
    (folder.folder / "000006.label").unlink()  # the last file of a scan, as after a kill
    assert write_folder(folder, range(5, 7), workers=1) == 1
    names = {f"{index:06d}.{ending}" for index in (5, 6) for ending in ("bin", "npy", "label")}
    assert set(files(folder.folder)) == {*names, "manifest.json"}
    scan = simulate(SMALL, 3, 6)
    np.testing.assert_array_equal(np.load(folder.folder / "000006.npy"), scan.image)
    points = read_points(folder.folder / "000006.bin")
    labels = np.fromfile(folder.folder / "000006.label", "<u4")
    assert len(labels) == len(points.xyz) == (scan.image[0] > 0).sum()
    np.testing.assert_allclose(
        project(points.xyz, points.reflectance, SMALL), scan.image, atol=1e-5
    )
    np.testing.assert_array_equal(
        project(points.xyz, labels.astype(np.float32), SMALL)[1], scan.labels
    )


def test_a_folder_of_another_seed_or_sensor_is_refused(tmp_path):
    write_folder(SimulatedFolder(tmp_path, SMALL, 0), range(1), workers=1)
    before = files(tmp_path)
    for sensor, seed, words in (
        (SMALL, 1, "holds other simulated scans: seed=0 there, 1 here"),
        (SENSORS["vlp16"], 0, r"reading.sensor.columns=\d+ there"),
    ):
        with pytest.raises(InputError, match=words):
            write_folder(SimulatedFolder(tmp_path, sensor, seed), range(2), workers=1)
        assert files(tmp_path) == before


def test_the_verb_writes_the_scans_of_any_sensor(r2flow, tmp_path, sensor):
    asked = (
        "--num",
        1,
        "--sensor",
        sensor.name,
        "--seed",
        4,
        "--format",
        "npy,ply",
        "--size",
        "16x64",
    )
    assert "1 scan (npy, ply)" in r2flow("simulate", *asked, "--out", tmp_path).said
    np.testing.assert_array_equal(
        np.load(tmp_path / "000000.npy"), simulate(sensor.resized(16, 64), 4, 0).image
    )
    assert manifest_of(tmp_path)["recipe"]["reading"]["sensor"]["name"] == sensor.name
