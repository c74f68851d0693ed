"""`r2flow sensor` and a user's own sensors."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import r2flow as package
from r2flow.base.errors import InputError
from r2flow.data.detection import reading_for
from r2flow.data.opening import open_scans
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS, Sensor, read_sensor
from r2flow.store import manifest_of
from tests.training.conftest import TINY, in_process

MINE = Sensor("mine", (12.0, 5.0, 1.0, 0.0, -1.5, -4.0, -9.0, -20.0), columns=128)


def write_scans(folder: Path, sensor: Sensor, count: int, most: int) -> Path:
    """Scans of ground 1.5 m below and a wall 40 m away, with reflectance up to a number."""
    for index in range(count):
        draw, e = np.random.default_rng(index), sensor.rays().numpy()[0]
        r = np.minimum(np.where(e < 0, 1.5 / np.sin(np.maximum(-e, 1e-9)), np.inf), 40 / np.cos(e))
        image = np.stack([r, draw.integers(0, 256, r.shape) * (most / 255)]) * (
            draw.random(r.shape) < 0.9
        )
        write_points(
            folder / f"{index:06d}.bin", *image_to_points(image.astype(np.float32), sensor.rays())
        )
    return folder


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    return write_scans(tmp_path / "scans", MINE, 3, 255)


def test_a_sensor_estimated_from_scans_is_accepted_by_the_verbs(
    r2flow, scans: Path, tmp_path: Path
):
    out = tmp_path / "conf" / "mine.yaml"
    printed = " ".join(r2flow("sensor", scans, "--out", out).quiet.split())
    for words in (
        "beams 8:",
        "128 steps a turn",
        "scale=255",
        "lie 0.00 from",
        "1.50 m above",
        "ring after ring",
    ):
        assert words in printed
    np.testing.assert_allclose(
        yaml.safe_load(out.read_text())["elevations"], MINE.elevations, atol=1e-3
    )
    assert sorted(path.name for path in out.parent.iterdir()) == ["mine.yaml"]

    npy, image = ("--format", "npy", "-o", tmp_path / "image"), tmp_path / "image" / "000000.npy"
    assert r2flow("show", scans / "000000.bin", "--sensor", out, *npy).said
    assert np.load(image).shape == (2, 8, 128)
    assert (np.load(image)[0] > 0).mean() == pytest.approx(0.9, abs=0.03)
    assert r2flow("show", scans / "000000.bin", "--sensor", out, "--size", "4x64", *npy).said
    assert np.load(image).shape == (2, 4, 64)


def test_points_of_another_frame_are_warned_of(r2flow, tmp_path: Path):
    xyz, ring = (
        image_to_points(np.full((1, 8, 128), 2.5, np.float32), MINE)[0],
        np.arange(8).repeat(128),
    )
    for mount, warned in ((1.5, True), (0, False)):
        write_points(tmp_path / "0.ply", xyz + np.float32([mount, 0, mount]), ring=ring)
        code, said, error = r2flow("sensor", tmp_path / "0.ply")
        assert (code, "of one sensor, in its own frame" in error) == (0, warned)
    assert "1.73 m above the ground, assumed" in said  # a round room without a floor


def test_the_sensor_of_scan_files_is_detected_and_another_is_warned_of(r2flow, tmp_path: Path):
    given, out = (
        write_scans(tmp_path / "scans", SENSORS["pandar64"].resized(columns=384), 2, 1),
        tmp_path / "out",
    )
    for verb in (
        ("show", given, "--format", "npy"),
        ("prepare", given, "--workers", 1),
        ("evaluate", given, given / "000000.bin", "--metrics", "jsd", "--workers", 0),
    ):
        for sensor in ((), ("--sensor", "hdl64e")):
            code, _, error = r2flow(*verb, *sensor, "--out", out / (verb[0] + "".join(sensor)))
            warnings = [line for line in error.splitlines() if line.startswith("WARNING")]
            assert code == 0, error
            # one for each set
            assert len(warnings) == 1 + (verb[0] == "evaluate" and sensor != ()), error
            words = (
                ("64 beams from +14.9 to -24.9 degrees", "sensor=pandar64")
                if sensor
                else ("scans of pandar64",)
            )
            assert all(word in warnings[0] for word in words)
    assert manifest_of(out / "prepare")["recipe"]["reading"]["sensor"]["name"] == "pandar64"
    images = [np.load(out / f"show{forced}" / "000000.npy") for forced in ("", "--sensorhdl64e")]
    # hdl64e sees 92 % of the returns
    assert (images[0][0] > 0).sum() > 1.1 * (images[1][0] > 0).sum()
    assert r2flow("show", given, "--sensor", "pandar64", "--format", "npy", "--out", out).quiet
    # of `complete`, next to the scans: no scans, and the scans stay the sensor's own
    (given / "answers").mkdir()
    shutil.copy(out / "prepare" / "manifest.json", given / "answers")
    shutil.copy(given / "000000.bin", given / "answers")
    assert len(open_scans(given)) == 2
    detected = package.read(given / "000000.bin")
    assert torch.equal(detected, package.read(given / "000000.bin", "pandar64"))
    assert torch.equal(detected, open_scans(given / "000000.bin").source.batch([0])[0])
    assert open_scans(given, reading_for([given], sensor="vlp16", size=(4, 64))).sensor.shape == (
        4,
        64,
    )
    for wrong in (given, f"folder:{given}"):
        with pytest.raises(InputError, match="is a folder"):
            package.read(wrong)


def test_pictures_of_an_unknown_sensor_are_of_its_own_beams(r2flow, scans: Path, tmp_path: Path):
    code, _, error = r2flow("show", scans, "--num", 1, "--format", "npy", "--out", tmp_path / "out")
    assert (code, len(error.splitlines())) == (0, 1), error
    assert "no built-in sensor fits; read by its own 8 beams from +12.0 to -20.0" in error
    (image,) = map(np.load, (tmp_path / "out").glob("*.npy"))
    assert image.shape == (2, 8, 128)
    # All of `write_scans` but a tenth, in the rows that see the ground or the wall.
    assert (image[0] > 0).mean() == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("verb", ["show", "sensor", "complete"])
def test_two_sensors_in_one_folder_are_named(r2flow, scans: Path, tmp_path: Path, verb: str):
    other = write_scans(tmp_path / "other", SENSORS["vlp16"].resized(columns=384), 1, 1)
    shutil.copy(other / "000000.bin", scans / "000003.bin")
    options = () if verb == "sensor" else ("--out", tmp_path / "out")
    _, _, error = r2flow(verb, scans, *options)
    (line,) = [one for one in error.splitlines() if "are of two" in one]
    assert f"{scans / '000000.bin'} (8 beams from +12.0 to -20.0 degrees) and" in line
    assert f"{scans / '000003.bin'} (16 beams from +15.0 to -15.0 degrees) are of two" in line


def test_a_thinned_scan_is_not_taken_for_another_sensors(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    quarter = Sensor("quarter", SENSORS["hdl64e_rings"].elevations[::4], columns=1024)
    assert package.read(write_scans(tmp_path / "scans", quarter, 1, 1) / "000000.bin").shape == (
        2,
        64,
        1024,
    )
    assert "they fit 'hdl32e'" in caplog.text  # the nearest of all


def test_the_scale_of_reflectance_is_taken_from_the_sensor(r2flow, scans: Path, tmp_path: Path):
    out = tmp_path / "mine.yaml"
    r2flow("sensor", scans, "--out", out)
    raw = np.fromfile(scans / "000000.bin", np.float32).reshape(-1, 4)[:, 3]
    assert raw.max() > 250
    npy, image = ("--format", "npy", "-o", tmp_path / "image"), tmp_path / "image" / "000000.npy"
    assert r2flow("show", scans / "000000.bin", "--sensor", out, *npy)[0] == 0
    assert set(np.unique(np.load(image)[1])) <= {0, *np.unique(raw / np.float32(255))}
    assert np.load(image)[1].max() > 0.95
    assert r2flow(
        "prepare", scans, "--sensor", out, "--out", tmp_path / "prepared", "--workers", 1
    ).quiet
    assert manifest_of(tmp_path / "prepared")["recipe"]["reading"]["reflectance_scale"] == 255
    given = (
        scans,
        scans / "000000.bin",
        "--sensor",
        out,
        "--metrics",
        "frechet_handcrafted",
        "--workers",
        0,
    )
    assert "reflectance" not in r2flow("evaluate", *given).said
    shown = "show", scans / "000000.bin", "--sensor", out, *npy, "--reflectance-scale"
    r2flow(*shown, 510)
    # what is given comes first
    assert np.load(image)[1].max() == pytest.approx(raw.max() / 510, abs=0.01)
    assert "below a tenth" in r2flow(*shown, 5100).stderr


@pytest.mark.parametrize(("file", "name"), [
    ("s_KITTI-360.yaml", "s_KITTI_360"), ("2nd car.yaml", "my_2nd_car"), ("vlp16.yaml", "my_vlp16"),
    ("Größe.yaml", "Gr__e"), ("_.yml", "my__"),
])  # fmt: skip
def test_a_sensor_is_named_after_its_file(
    r2flow, scans: Path, tmp_path: Path, file: str, name: str
):
    assert r2flow("sensor", scans, "--out", tmp_path / file, "--num", 1).quiet
    assert read_sensor(tmp_path / file).name == name


def test_a_sensor_s_file_is_not_replaced(r2flow, scans: Path, tmp_path: Path):
    out = tmp_path / "mine.yaml"
    out.write_text("mine by hand")
    assert "exists" in r2flow("sensor", scans, "--out", out).refusal
    assert out.read_text() == "mine by hand"


@pytest.mark.parametrize(
    ("folder", "scale"),
    [
        ("nuscenes_hdl32e", 255.0),
        ("vlp16", None),  # without reflectance
        pytest.param("rellis_os1_64", 0.012, marks=pytest.mark.slow),
        pytest.param("rellis_vlp32c", 255.0, marks=pytest.mark.slow),
    ],
)
def test_the_three_commands_of_the_docs_run_as_they_are_written(
    r2flow, shared: Path, tmp_path: Path, folder, scale
):
    data, prepared = shared / "real" / "other_sensors" / folder, tmp_path / "my" / "prepared"
    mine = tmp_path / "my sensor.yaml"
    assert r2flow("sensor", data, "--out", mine).quiet
    assert read_sensor(mine).reflectance_scale == scale
    assert r2flow("prepare", data, "--sensor", mine, "--out", prepared, "--workers", 1).quiet
    small = [part for part in TINY if not part.startswith(("data", "sensor."))]
    for given in (["data=prepared", f"data.root={prepared}"], ["data=folder", f"data.root={data}"]):
        own = [*given, f"sensor='{mine}'", "data.batch_size=1"]
        done = in_process(
            tmp_path, [*own, *small, "trainer.max_steps=1", "trainer.fast_dev_run=true"]
        )
        assert "WARNING" not in done.stderr
