"""The wrong sensor is said, the right one is not doubted: every sensor with every other one's scans."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.data.preparing import plan_files
from r2flow.errors import InputError
from r2flow.lidar.beams import RING_AFTER_RING, RINGS, find_beams
from r2flow.lidar.recognition import other_sensor
from r2flow.lidar.scan_files import Points, read_points, write_points
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


def test_scans_whose_beams_are_lost_are_judged_by_the_view(shared: Path):
    points = read_points(next((shared / "real" / "kitti360").rglob("*.bin")))
    lost = Points(np.random.default_rng(0).permutation(points.xyz))
    with pytest.raises(InputError, match="cannot be told apart"):
        find_beams([lost])
    assert other_sensor([lost], SENSORS["hdl64e"]) is None
    seen, name, _ = other_sensor([lost], SENSORS["vlp16"])
    assert name is None
    assert "of the returns lie in its view" in seen


def test_sensors_of_one_s_own_are_judged_by_empty_rows_too():
    mine = Sensor("mine", tuple(np.linspace(3, -25, 24).tolist()))
    assert other_sensor([scan(mine, RING_AFTER_RING)], mine) is None
    assert other_sensor([scan(SENSORS["vlp16"], RING_AFTER_RING)], mine) is not None
    seen, *_ = other_sensor([scan(mine, RING_AFTER_RING)], Sensor("fine", tuple(np.linspace(4, -26, 64).tolist())))
    assert "rows between others stay empty" in seen


def test_a_few_returns_tell_nothing():
    few = scan(SENSORS["pandar64"], RING_AFTER_RING)
    assert other_sensor([Points(few.xyz[:900])], SENSORS["vlp16"]) is None


def without_beams(pattern: str) -> Points:
    """The ground and a wall, seen by scanners whose pattern does not repeat: two sweeps whose rates have no ratio."""
    t, turn = np.linspace(0, 1, 60_000), 2 * np.pi
    if pattern == "turning":  # all around, up and down
        azimuth, elevation = turn * 431.7 * t, np.radians(22.5 + 29.5 * np.sin(turn * 1093.37 * t))
    elif pattern == "rosette":  # two prisms
        azimuth = np.radians(19.2) * (np.cos(turn * 1215.7 * t) + np.cos(-turn * 777.3 * t))
        elevation = np.radians(19.2) * (np.sin(turn * 1215.7 * t) + np.sin(-turn * 777.3 * t))
    else:
        azimuth, elevation = (
            np.pi * (1 - 2 * np.random.default_rng(0).random(t.size)),
            0.4 * np.cos(turn * np.sqrt(2) * t),
        )
        elevation = np.random.default_rng(1).permutation(elevation)
    r = np.minimum(np.where(elevation < 0, 1.7 / np.sin(np.maximum(-elevation, 1e-9)), np.inf), 25 / np.cos(elevation))
    direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return Points((r * direction).T.astype(np.float32))


@pytest.mark.parametrize("pattern", ["turning", "rosette", "random"])
def test_scanners_without_beams_are_refused_with_the_reason(tmp_path: Path, pattern: str):
    scan = without_beams(pattern)
    with pytest.raises(InputError, match="lie on no beams, as those of a Livox"):
        find_beams([scan])
    write_points(tmp_path / "0.ply", scan.xyz)
    with pytest.raises(InputError, match="lie on no beams"):
        plan_files("folder", tmp_path, SENSORS["hdl64e"])
    for name in SENSORS:
        assert other_sensor([scan], SENSORS[name]).hopeless


def test_the_beams_of_shuffled_scans_are_there(shared: Path):
    for pattern, (count, _) in REAL.items():
        for path in sorted((shared / "real").glob(pattern))[:count]:
            points = read_points(path)
            order = np.random.default_rng(0).permutation(len(points.xyz))
            found = other_sensor([Points(points.xyz[order])], SENSORS["hdl64e"])
            assert found is None or not found.hopeless
