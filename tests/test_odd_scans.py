"""Scans and sensor files that are not what they seem: hanging, of a camera, of a doubtful scale."""

import numpy as np
import pytest

from r2flow.base.errors import _warned
from r2flow.data.datamodule import ScanDataModule
from r2flow.lidar.estimation import hangs
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import Points, write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate
from tests.conftest import refused


def street(sensor: str = "vlp16", number: int = 0) -> np.ndarray:
    """x, y, z of a simulated street."""
    scan = simulate(SENSORS[sensor], 0, number)
    return image_to_points(scan.image, SENSORS[sensor].rays())[0]


@pytest.mark.parametrize("sensor", ["vlp16", "hdl64e", "os1_64", "hdl32e"])
@pytest.mark.parametrize("negated", [(1, 2), (0, 2)])
def test_a_sensor_that_hangs_upside_down_is_told_and_its_height_is_not(
    r2flow, tmp_path, sensor, negated
):
    xyz = street(sensor)
    assert not hangs([Points(xyz)])
    xyz[:, negated] *= -1
    assert hangs([Points(xyz)])
    if sensor == "vlp16":
        write_points(tmp_path / "scan.bin", xyz, np.full(len(xyz), 0.5))
        done = r2flow("sensor", tmp_path / "scan.bin")
        assert "the ground lies above the sensor" in done.stderr
        assert "m above the ground" not in done.stdout


def test_a_hall_with_a_ceiling_does_not_hang():
    """Floor 1 m below, ceiling 4 m above, walls at 15 m."""
    e, a = np.meshgrid(np.radians(np.arange(-15, 16, 2)), np.radians(np.arange(0, 360, 0.5)))
    up = np.where(e > 0, 4.0, 1.0)
    r = np.minimum(up / abs(np.sin(e)), 15 / np.cos(e))
    xyz = np.stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)], -1)
    assert not hangs([Points(xyz.reshape(-1, 3).astype(np.float32))])


@pytest.mark.parametrize(
    ("columns", "step", "rows"), [(8000, 0.002, 4), (640, 0.09, 48), (300, 0.005, 16)]
)
def test_the_patch_of_a_camera_is_no_turn(r2flow, tmp_path, columns, step, rows):
    e, a = np.meshgrid(
        np.radians(np.linspace(20, -20, rows)), np.radians(step * np.arange(columns)), indexing="ij"
    )
    xyz = 5 * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    np.save(tmp_path / "patch.npy", xyz.astype(np.float32))
    out = tmp_path / "mine.yaml"
    assert "degrees of azimuth" in r2flow("sensor", tmp_path / "patch.npy", "--out", out).refusal
    assert not out.exists()


def test_scans_of_two_sensors_in_one_command_are_refused(r2flow, tmp_path):
    """None is read as the other's: their beams, and so all rows, differ."""
    for sensor in ("vlp16", "os1_64"):
        xyz = street(sensor)
        write_points(tmp_path / f"{sensor}.bin", xyz, np.full(len(xyz), 0.5))
    both = [tmp_path / "vlp16.bin", tmp_path / "os1_64.bin"]
    for scans in (both, [tmp_path]):
        for verb in (("complete", *scans, "--out", tmp_path / "o"), ("sensor", *scans)):
            assert "are of two sensors" in r2flow(*verb).refusal
    for verb in ("prepare", "show"):
        assert "are of two sensors" in r2flow(verb, tmp_path, "--out", tmp_path / "o").refusal
    assert not [*tmp_path.glob("o/*")]
    with refused("are of two sensors"):
        ScanDataModule("folder", "vlp16", root=str(tmp_path)).setup()


def test_sensor_says_of_a_doubtful_reflectance_what_show_says(r2flow, tmp_path):
    """9 % above 1, half of all below 0.6: 255 may be full reflectance, or not."""
    xyz = street()
    draws = np.random.default_rng(0)
    strength = draws.uniform(0, 0.6, len(xyz))
    strength[draws.random(len(xyz)) < 0.09] = 150
    np.save(tmp_path / "scan.npy", np.column_stack([xyz, strength]).astype(np.float32))
    for verb in (
        ("sensor", tmp_path / "scan.npy"),
        ("show", tmp_path / "scan.npy", "--out", tmp_path),
    ):
        _warned.clear()
        said = r2flow(*verb).stderr
        assert "the estimate of full reflectance may be wrong" in said
        assert "r2flow sensor" not in said  # it would send to itself


def test_the_same_sensor_command_finds_its_file(r2flow, tmp_path):
    xyz = street()
    write_points(tmp_path / "scan.bin", xyz, np.full(len(xyz), 0.5))
    out = tmp_path / "mine.yaml"
    for _ in range(2):
        assert r2flow("sensor", tmp_path / "scan.bin", "--out", out).returncode == 0
    out.write_text(out.read_text() + "# mine\n")
    assert "with other content" in r2flow("sensor", tmp_path / "scan.bin", "--out", out).refusal


def test_the_ceiling_above_a_low_robot_is_not_the_ground():
    """Its floor, 0.35 m below, is seen from 1 to 3 m; its ceiling, 2 m above, from 3 to 6 m."""
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    rings = [(r, -0.35) for r in np.linspace(1, 3, 20)] + [(r, 2.0) for r in np.linspace(3, 6, 20)]
    xyz = [np.c_[r * np.cos(azimuth), r * np.sin(azimuth), 0 * azimuth + z] for r, z in rings]
    assert not hangs([Points(np.concatenate(xyz).astype(np.float32))])


def test_a_sensor_file_with_aliases_or_long_values_is_one_short_line(r2flow, tmp_path):
    file = tmp_path / "mine.yaml"
    for text in (
        "name: mine\nelevations: &a [1.0, 2.0]\nfiring: [*a, *a]\n",
        f"name: {'x' * 10_000}\nelevations: [1.0, 2.0]\n",
        f"name: mine\nelevations: [{', '.join(['a'] * 10_000)}]\n",
        f"name: mine\ncolumns: {'9' * 5000}\nelevations: [2.0, 1.0]\n",
        f"{'x' * 10_000}: 1\n",
        f"name: mine\nelevations: {'[' * 1000}\n",
    ):
        file.write_text(text)
        line = r2flow("show", "simulated:0", "--sensor", file, "--out", tmp_path / "o").refusal
        assert len(line) < 5000
        assert str(file) in line or "sensor 'xxx" in line
    assert "aliases" not in line
