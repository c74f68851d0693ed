"""The wrong sensor is said, the right one is not doubted: every sensor with every other one's scans."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.lidar.beams import RING_AFTER_RING, RINGS, UNORDERED
from r2flow.lidar.recognition import other_sensor
from r2flow.lidar.scan_files import Points, read_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of
from tests.lidar.test_calibration import scan

HDL64E = {"hdl64e", "hdl64e_rings"}
SIZED = {
    **dict(SENSORS.items()),
    "hdl64e 16x256": SENSORS["hdl64e"].resized(16, 256),
    "vlp16 8x128": SENSORS["vlp16"].resized(8, 128),
    "pandar64 32x512": SENSORS["pandar64"].resized(32, 512),
}
# Real scans: how many are looked at, and whose they are. Alone, each of KITTI's calibrations must do.
REAL = {
    "kitti360/**/*.bin": (3, "hdl64e"),
    "raw/**/*0005*/**/*.bin": (3, "hdl64e"),
    "odometry/**/00/velodyne/*.bin": (3, "hdl64e"),
    "object/**/*.bin": (3, "hdl64e"),
    "other_sensors/nuscenes_hdl32e/*.pcd.bin": (1, "hdl32e"),
    "other_sensors/rellis_os1_64/*.bin": (1, "os1_64"),
    "other_sensors/rellis_vlp32c/*.bin": (1, "vlp32c"),
    "other_sensors/vlp16/*.pcd": (3, "vlp16"),
}


def refuse_wrong_answers(scans: list[Points], true: str) -> None:
    """Every sensor but the true one is doubted, and the true one is named."""
    for name, sensor in SIZED.items():
        found = other_sensor(scans, sensor)
        if name.split()[0] == true or {name.split()[0], true} <= HDL64E:
            assert found is None, (name, found)
        else:
            assert found is not None, name
            assert found[1] == true.removesuffix("_rings"), (name, found)


@pytest.mark.parametrize("name", [name for name in SENSORS if name != "hdl64e"])
def test_every_pair_of_sensors_is_told_apart(name: str):
    sensor = SENSORS[name].resized(columns=384)
    for how in (RINGS, RING_AFTER_RING):
        refuse_wrong_answers([scan(sensor, how, seed) for seed in range(2)], name)


@pytest.mark.parametrize("pattern", list(REAL))
def test_real_scans_are_of_their_own_sensor_alone(shared: Path, pattern: str):
    count, true = REAL[pattern]
    scans = [read_points(path) for path in sorted((shared / "real").glob(pattern))[:count]]
    assert len(scans) == count
    refuse_wrong_answers(scans, true)
    for one in scans:
        for name in HDL64E if true in HDL64E else {true}:
            assert other_sensor([one], SENSORS[name]) is None


def test_scans_of_even_rows_are_of_the_sensor_of_even_rows():
    """Point clouds of a flow lie on its rows."""
    for size in ((64, 1024), (32, 512), (16, 256)):
        sensor = SENSORS["hdl64e"].resized(*size)
        assert other_sensor([scan(sensor, RING_AFTER_RING)], sensor) is None
    half = [scan(SENSORS["hdl64e"].resized(32, 512), RING_AFTER_RING)]
    assert other_sensor(half, SENSORS["hdl64e"].resized(8, 64)) is None
    assert other_sensor(half, SENSORS["hdl64e"]) is not None


def test_a_part_of_the_view_is_enough(shared: Path):
    """A camera's field of view: 82 degrees wide, and of 64 rings the lower 16 cut off."""
    for path in sorted((shared / "real" / "object").rglob("*.bin")):
        points = read_points(path)
        elevation, azimuth = elevations_of(points.xyz), np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
        part = points.xyz[(np.abs(azimuth) < np.radians(41)) & (elevation > -15.7)]
        assert len(part) < len(points.xyz) / 4
        assert other_sensor([Points(part)], SENSORS["hdl64e"]) is None
        assert other_sensor([Points(part)], SENSORS["vlp16"]) is not None


def test_scans_whose_beams_are_lost_are_judged_by_the_view_and_by_empty_rows():
    hdl64e = scan(SENSORS["hdl64e_rings"], UNORDERED)
    jitter = np.random.default_rng(0).normal(0, 0.005, hdl64e.xyz.shape) * np.linalg.norm(hdl64e.xyz, axis=1)[:, None]
    lost = Points((hdl64e.xyz + jitter).astype(np.float32))
    assert other_sensor([lost], SENSORS["hdl64e"]) is None
    seen, name = other_sensor([lost], SENSORS["vlp16"])
    assert name is None
    assert "of the returns lie in its view" in seen
    mine = Sensor("mine", tuple(np.linspace(3, -25, 24).tolist()))
    assert other_sensor([scan(mine, RING_AFTER_RING)], mine) is None
    assert other_sensor([scan(SENSORS["vlp16"], RING_AFTER_RING)], mine) is not None
    seen, _ = other_sensor([scan(mine, RING_AFTER_RING)], Sensor("fine", tuple(np.linspace(4, -26, 64).tolist())))
    assert "rows between others stay empty" in seen


def test_a_few_returns_tell_nothing():
    few = scan(SENSORS["pandar64"], RING_AFTER_RING)
    assert other_sensor([Points(few.xyz[:900])], SENSORS["vlp16"]) is None
