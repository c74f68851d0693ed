"""Ten thousand damaged files over every reader: one line, or what was written; no crash, no hang,
no memory.
"""

import importlib.util
import io
import json
import os
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairStore
from r2flow.data.reading import Reading
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS, write_sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.saving import save_checkpoint
from r2flow.store import Store
from tests.conftest import CONFIG, ROOT, SENSOR, prepare_folder
from tests.data.test_pandaset import table
from tests.fuzzing_readers import READERS
from tests.lidar.test_scan_files_damage import (
    FORMATS,
    REFLECTANCE,
    TABLE,
    XYZ,
    in_every_format,
)

SEED = 20261120
DRAW = np.random.default_rng(0)


def write_scans(folder: Path) -> None:
    folder.mkdir(parents=True)
    contents = in_every_format(folder.parent)
    for name in FORMATS:
        ending, _, kind = name.partition(" ")
        (folder / f"{kind or 'a'}.{ending}").write_bytes(contents[name])
    np.savetxt(
        folder / "a.csv", TABLE, delimiter=",", header="x,y,z,intensity", comments="", fmt="%.2f"
    )
    np.savetxt(folder / "a.xyz", TABLE, fmt="%.2f")
    sample = {"depth": (1, 4, 16), "xyz": (3, 4, 16), "reflectance": (1, 4, 16)}
    drawn = {name: torch.from_numpy(DRAW.random(shape) + 1) for name, shape in sample.items()}
    torch.save(drawn, folder / "a.pth")
    if importlib.util.find_spec("pyarrow"):
        import pyarrow
        from pyarrow import feather, parquet

        table = pyarrow.table(
            {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "intensity": REFLECTANCE}
        )
        feather.write_feather(table, folder / "a.feather")
        parquet.write_table(table, folder / "a.parquet")
    if importlib.util.find_spec("laspy"):
        import laspy

        cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
        cloud.x, cloud.y, cloud.z, cloud.intensity = *XYZ.T.astype(np.float64), np.arange(len(XYZ))
        cloud.write(folder / "a.las")


def keep(folder: Path, kind: str, *files: Path) -> None:
    for file in files:
        target = folder / kind / file.name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(file.read_bytes())


def write_stores(folder: Path, beside: Path) -> None:
    scans = beside / "scans"
    scans.mkdir(parents=True)
    for number in range(3):
        write_points(scans / f"{number}.bin", XYZ * [1, 1, 0.1], REFLECTANCE)
    prepare_folder(scans, beside / "prepared", SENSOR)
    keep(folder, "prepared", *(beside / "prepared").iterdir())
    options = PairOptions(num=4, sampler={"name": "euler", "steps": 1}, batch_size=2)
    store = PairStore(beside / "pairs", options, (2, 8, 64))
    store.begin()
    x_1 = DRAW.standard_normal((4, 2, 8, 64)).astype(np.float16)
    store.write(0, {"x_1": x_1, "evaluations": np.ones(4, np.int32)}, {"usable": [1] * 4})
    keep(folder, "pairs", *(file for file in (beside / "pairs").iterdir() if file.is_file()))
    write_points(beside / "scan.bin", XYZ, REFLECTANCE)
    (folder / "labels").mkdir()
    DRAW.choice([0, 10, 40, 50, 70, 252], len(XYZ)).astype("<u4").tofile(
        folder / "labels" / "scan.label"
    )
    (folder / "image").mkdir()
    np.save(folder / "image" / "image.npy", DRAW.uniform(2, 70, (2, 8, 64)).astype(np.float32))
    Store(beside / "samples", "samples", {"reading": Reading(SENSOR).described()}).begin()
    keep(folder, "samples", beside / "samples" / "manifest.json")
    (beside / "run").mkdir()
    (beside / "run" / "config.yaml").write_text(yaml.safe_dump(CONFIG))
    keep(folder, "config", beside / "run" / "config.yaml")
    write_sensor(replace(SENSORS["vlp16"], name="mine"), beside / "mine.yaml", "of a test")
    keep(folder, "sensor", beside / "mine.yaml")
    columns = {"x": np.arange(4.0), "d": np.arange(4)}
    (beside / "0.pkl").write_bytes(table(columns))
    keep(folder, "table", beside / "0.pkl")


def write_weights(folder: Path, beside: Path, run: Path) -> None:
    loaded = load_checkpoint(run)
    model = beside / "model.safetensors"
    save_checkpoint(loaded, model)
    keep(folder, "checkpoint", run, model)
    weights = beside / "weights.pth"
    torch.save({"fc.weight": torch.randn(16, 16), "fc.bias": torch.randn(16)}, weights)
    torch.save(
        {"fc.weight": torch.randn(16, 16)},
        beside / "legacy.pth",
        _use_new_zipfile_serialization=False,
    )
    with tarfile.open(beside / "release.tar.gz", "w:gz") as tar:
        for name, data in (("model.ckpt", weights.read_bytes()), ("arch_cfg.yaml", b"name: net\n")):
            info = tarfile.TarInfo(f"net/{name}")
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    keep(folder, "weights", weights, beside / "legacy.pth", beside / "release.tar.gz")


@pytest.mark.parametrize("each", [4, pytest.param(350, marks=pytest.mark.slow)])  # of each original
def test_damaged_files_are_one_line_or_what_was_written(tmp_path: Path, saved, each: int):
    folder = tmp_path / "fuzz"
    write_scans(folder / "points")
    write_stores(folder, folder / "beside")
    write_weights(folder, folder / "beside", saved[0])
    command = [sys.executable, "-m", "tests.fuzz", str(folder), str(SEED), str(each)]
    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **threads},
        timeout=3000,
    )
    said = [json.loads(line) for line in done.stdout.splitlines()]
    found = [line for line in said if line[0] != "done"]
    assert not found, "\n".join(map(str, found[:20]))
    assert done.returncode == 0, f"{said[-1:]} {done.stderr[-2000:]}"  # a crash ends the process
    assert len(said) == sum(len(list((folder / kind).glob("*"))) for kind in READERS) >= 20
    assert each == 4 or all(read < each for *_, read in said)  # some of each kind are found out
