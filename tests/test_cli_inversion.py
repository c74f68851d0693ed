"""r2flow invert, interpolate, sample of a part: as a user types them."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.inversion import invert
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.samplers import build_sampler
from tests.conftest import write_run
from tests.test_sampling import network, scans

SENSOR = SENSORS["hdl64e"].resized(8, 64)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", network(), {"name": "rectify"}, 0.3)


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    """Two scans, as .bin and .ply."""
    paths = [tmp_path / "scans" / "one.bin", tmp_path / "scans" / "two.ply"]
    for path, image in zip(paths, scans(2).numpy(), strict=True):
        write_points(path, *image_to_points(image, SENSOR.rays()))
    return paths


def test_interpolate_writes_every_frame(r2flow, run, files, tmp_path):
    out = tmp_path / "between"
    code, said, _ = r2flow("interpolate", *files, "-c", run, "-o", out, "--frames", 4, "--sampler", "rk4", "--steps", 8)
    assert code == 0
    assert [path.name for path in sorted((out / "frames").glob("*.ply"))] == [f"{i:03d}.ply" for i in range(4)]
    for index in range(4):
        image = np.load(out / "frames" / f"{index:03d}.npy")
        assert len(read_points(out / "frames" / f"{index:03d}.ply").xyz) == (image[0] > 0).sum()
    rows = json.loads((out / "interpolation.json").read_text())["rows"]
    assert [row["weight"] for row in rows] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [row["evaluations"] for row in rows] == [64, 32, 32, 64]  # the ends go there and back
    assert "4 scans" in said


def test_a_sector_and_rows_are_all_that_is_written(r2flow, run, tmp_path):
    part = tmp_path / "part"
    code, said, _ = r2flow("sample", run, "--num", 1, "--steps", 2, "--sector", "-45,45", "--rows", "0-2", "-o", part)
    assert code == 0
    # 11.25 degrees are 2 columns, and the network's unit is 8.
    assert "generating rows 0-3, columns 16-47, for rows 0-2, columns 24-39: 25% of the image" in said
    image = np.load(part / "000000.npy")
    assert image.shape == (2, 8, 64)
    for judged in (("evaluate", part, "simulated:0"), ("evaluate", "simulated:0", part)):
        code, _, complaint = r2flow(*judged)
        assert code == 2
        assert f"{part} holds a part of each scan alone" in complaint
    inside = np.zeros((8, 64), bool)
    inside[:3, 24:40] = True
    assert (image[0][inside] > 0).any()
    assert (image[:, ~inside] == 0).all()
    xyz = read_points(part / "000000.ply").xyz
    assert (np.abs(np.arctan2(xyz[:, 1], xyz[:, 0])) < np.pi / 4).all()


def test_one_channel_is_written_alone(r2flow, run, tmp_path):
    for channels in ("both", "range", "reflectance"):
        out = tmp_path / channels
        assert r2flow("sample", run, "--num", 1, "--steps", 2, "--channels", channels, "-o", out)[0] == 0
    both = np.load(tmp_path / "both" / "000000.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "range" / "000000.npy"), both[:1])
    np.testing.assert_array_equal(np.load(tmp_path / "reflectance" / "000000.reflectance.npy"), both[1:])
    assert read_points(tmp_path / "range" / "000000.ply").reflectance is None
    assert not list((tmp_path / "range").glob("*.bin"))
    assert {path.suffix for path in (tmp_path / "reflectance").iterdir()} == {".npy", ".png", ".json"}


def test_named_grids_are_sampled_on(r2flow, run, tmp_path):
    images = {}
    for grid in ("uniform", "power:2", "power-start:1.5"):
        out = tmp_path / grid.replace(":", "-")
        assert r2flow("sample", run, "--num", 1, "--steps", 3, "--grid", grid, "-o", out)[0] == 0
        images[grid] = np.load(out / "000000.npy").tobytes()
    assert len(set(images.values())) == 3


def test_what_is_not_asked_for_is_not_imported():
    shown = "print([m for m in ({}) if m in sys.modules]); "
    code = "import r2flow.flow.solvers, r2flow.flow.problems, r2flow.lidar.region, r2flow.backbones, sys; "
    code += shown.format("'lightning', 'matplotlib', 'torchdiffeq'")
    code += "import r2flow.model.sampling, r2flow.reports.interpolation; "
    code += shown.format("'tensorboard', 'torchdiffeq', 'plotly'")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n") == ["[]", "[]", ""]


def test_a_model_of_range_alone_has_no_reflectance_to_compute(r2flow, tmp_path):
    alone = write_run(tmp_path / "range", network(reflectance=False), {"name": "rectify"}, 0.3)
    assert r2flow("sample", alone, "--num", 1, "--steps", 2, "-o", tmp_path / "o")[0] == 0
    assert np.load(tmp_path / "o" / "000000.npy").shape == (1, 8, 64)
    assert read_points(tmp_path / "o" / "000000.ply").reflectance is None


@pytest.mark.parametrize("method", ["jump", "chord"])
def test_a_map_is_not_inverted_by_its_jumps(method):
    street = load_checkpoint("street")
    with pytest.raises(InputError, match="does not follow the flow's paths"):
        invert(street, torch.zeros(1, 2, 32, 256), build_sampler(method, steps=2))
