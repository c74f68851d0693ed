"""r2flow prepare as a user types it."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from r2flow.data.opening import SOURCES, open_prepared
from r2flow.data.reading import Reading, read_scan
from r2flow.lidar.sensors import SENSORS
from r2flow.store import read_manifest
from tests.conftest import write_scan
from tests.training.conftest import TINY, in_process

SMALL = SENSORS["hdl64e"].resized(4, 16)


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_data_set_is_prepared(r2flow, kitti_360, tmp_path):
    out = tmp_path / "out"
    typed = ("prepare", f"kitti_360:{kitti_360}", "--out", out, "--split", "test", "--size", "4x16", "--shard-scans", 4)
    code, said, _ = r2flow(*typed, "--workers", 1)
    assert code == 0
    assert f"{out}: 6 scans in 2 shards, 0.0 MiB; range within" in said
    assert "reflectance as n/256, exactly" in said
    source = open_prepared(out, Reading(SMALL, reflectance=True))
    assert len(source) == 6
    raw = read_scan(kitti_360 / source.names[5], SMALL)
    assert np.abs(source[5] - raw).max() <= 1e-3


def test_the_same_command_makes_a_damaged_shard_again(r2flow, kitti_360, tmp_path):
    out = tmp_path / "out"
    typed = ("prepare", f"kitti_360:{kitti_360}", "--out", out, "--size", "4x16", "--shard-scans", 4, "--workers", 1)
    r2flow(*typed)
    whole = files(out)
    path = out / "scans-000002.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert r2flow(*typed)[0] == 0
    assert files(out) == whole


def test_nuscenes_has_its_own_sensor_and_scale(r2flow, tmp_path):
    root = Path(__file__).parents[1]
    config = yaml.safe_load((root / "conf" / "data" / "nuscenes.yaml").read_text())
    r, e = np.full(3, 10.0), np.deg2rad([10.0, 0.0, -30.0])  # the first and the last out of an HDL-64E's view
    points = np.stack([r * np.cos(e), np.zeros(3), r * np.sin(e), [0, 100, 255], [31, 23, 0]], 1)
    path = tmp_path / "scans" / "n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin"
    path.parent.mkdir()
    path.write_bytes(points.astype("<f4").tobytes())
    code, _, error = r2flow("prepare", f"nuscenes:{path.parent}", "--out", tmp_path / "out", "--workers", 1)
    assert (code, error.split("error")[1:]) == (0, [])
    recipe = read_manifest(tmp_path / "out")["recipe"]["reading"]
    assert {"override /sensor@_global_.sensor": recipe["sensor"]["name"]} in config["defaults"]
    assert recipe["reflectance_scale"] == SOURCES["nuscenes"].reflectance_scale
    image = open_prepared(tmp_path / "out", Reading(SENSORS["hdl32e"], reflectance=True))[0]
    assert np.count_nonzero(image[0]) == 3
    assert np.array_equal(np.unique(image[1]), np.array([0, 100 / 255, 1], np.float32))


@pytest.mark.slow
def test_the_command_killed_and_started_twice_ends_with_the_same_bytes(tmp_path: Path):
    for number in range(60):
        write_scan(tmp_path / "scans" / f"{number}.bin", number)

    def start(out: str) -> subprocess.Popen:
        typed = [sys.executable, "-m", "r2flow.cli", "prepare", tmp_path / "scans", "--out", tmp_path / out,
                 "--size", "64x1024", "--shard-scans", "2", "--workers", "2"]  # fmt: skip
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen([str(one) for one in typed], env={**os.environ, "OMP_NUM_THREADS": "1"}, **silent)

    assert start("one").wait() == 0
    one, draw, killed = files(tmp_path / "one"), random.Random(0), 0
    for _ in range(6):
        process = start("killed")
        folder, before = tmp_path / "killed", len(list((tmp_path / "killed").glob("scans-*")))
        while process.poll() is None and len(list(folder.glob("scans-*"))) == before:
            time.sleep(0.002)
        time.sleep(draw.uniform(0, 0.05))
        process.send_signal(signal.SIGKILL)
        killed += process.wait() == -signal.SIGKILL
    assert killed >= 3
    processes = [start("killed"), start("killed")]
    assert [process.wait() for process in processes] == [0, 0]
    assert files(folder) == one


def test_columns_are_named_where_files_do_not(r2flow, numbered, tmp_path):
    """Rows of time, z, y, x, reflectance and ring: every verb and run that reads them is told by one option."""
    wide = tmp_path / "wide"
    wide.mkdir()
    for path in sorted(numbered.iterdir()):
        x, y, z, reflectance = np.fromfile(path, np.float32).reshape(-1, 4).T
        np.column_stack([x * 0 + 7, z, y, x, reflectance, x * 0]).astype(np.float32).tofile(wide / path.name)
    columns, small = ("--columns", "time,z,y,x,intensity,_"), ("--size", "4x16", "--workers", 1)
    for out, given in (("one", (numbered,)), ("two", (wide, *columns))):
        code, _, error = r2flow("prepare", *given, *small, "--out", tmp_path / out)
        assert (code, error) == (0, "")
    for one, two in zip(
        open_prepared(tmp_path / "one", Reading(SMALL, reflectance=True)),
        open_prepared(tmp_path / "two", Reading(SMALL, reflectance=True)),
        strict=False,
    ):
        assert np.array_equal(one, two)
    assert read_manifest(tmp_path / "one")["recipe"]["reading"]["columns"] is None
    code, _, error = r2flow("prepare", wide, "--columns", "z,_,y,x,intensity,_", *small, "--out", tmp_path / "two")
    assert code == 2
    assert "reading.columns=" in error
    scan = wide / "000000.bin"
    assert r2flow("show", scan, *columns, "--size", "4x16", "--format", "npy", "-o", tmp_path / "image")[0] == 0
    np.testing.assert_array_equal(np.load(tmp_path / "image" / "000000.npy"), read_scan(numbered / "000000.bin", SMALL))
    for verb in (
        ("show", scan, "--out", tmp_path / "v"),
        ("evaluate", wide, scan, "--size", "4x16", "--metrics", "jsd"),
    ):
        assert r2flow(*verb, *columns)[0] == 0
    for wrong in ("x,y", "x,y,z,x", "x,y,z,intensity,i"):
        code, _, error = r2flow("show", scan, "--columns", wrong, "--out", tmp_path / "v")
        assert (code, error.count("\n")) == (2, 1)
        assert "columns must name x, y and z" in error


def test_a_run_is_told_the_columns_too(numbered, tmp_path):
    wide = tmp_path / "wide"
    wide.mkdir()
    for path in sorted(numbered.iterdir()):
        x, y, z, reflectance = np.fromfile(path, np.float32).reshape(-1, 4).T
        np.save(wide / f"{path.stem}.npy", np.column_stack([z, y, x, reflectance, x * 0]))
    given = [*TINY, f"data.root={wide}", "trainer.max_steps=1", "trainer.fast_dev_run=true"]
    in_process(tmp_path, [*given, "data.reading.columns=[z,y,x,intensity,_]"])
    done = in_process(tmp_path, given, check=False)
    assert done.returncode == 2
    assert "5 columns without names" in done.stderr.splitlines()[-1]
