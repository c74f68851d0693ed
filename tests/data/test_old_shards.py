"""Shards that version 0.1.0 has written open, and are made again byte for byte."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.data.contents import RECORD
from r2flow.data.opening import open_prepared
from r2flow.data.options import PairOptions
from r2flow.data.pairs import PairSource, make_pairs
from r2flow.data.prepared import check_prepared, read_manifest
from r2flow.data.preparing import Plan, Preparation, plan_files
from r2flow.data.reading import read_scan
from r2flow.data.shards import PairStore
from r2flow.generators import Field
from r2flow.lidar.sensors import SENSORS
from r2flow.noise import standard_normal

OLD = Path(__file__).parents[1] / "fixtures" / "0.1.0-shards"
SENSOR = SENSORS["hdl64e"].resized(4, 16)
SHAPE = (2, 4, 8)
PAIRS = {"method": "euler", "steps": 2, "batch_size": 4, "shard_mib": 3 * 4 * 2 * 64 / 2**20, "parent": "abc",
         "seed": 3, "first": 8}  # fmt: skip


def plan() -> Plan:
    return plan_files("folder", OLD / "scans", SENSOR, shard_scans=2)


def store(folder: Path) -> PairStore:
    return PairStore(folder, PairOptions(**PAIRS).recipe(SHAPE))


def still(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """dx/dt = 0: every pair ends where it begins, on any machine."""
    return torch.zeros_like(x)


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_same(folder: Path, old: Path) -> None:
    """The same files but for the record of contents, new since; of the manifest all but the version that wrote it."""
    found, expected = files(folder), files(old)
    found.pop(RECORD, None)
    manifests = [json.loads(one.pop("manifest.json")) for one in (found, expected)]
    for manifest in manifests:
        for key in ("made by", "checksum"):
            manifest.pop(key, None)
    assert manifests[0] == manifests[1]
    assert found == expected


def test_prepared_scans_open(tmp_path: Path):
    assert check_prepared(OLD / "prepared") == {}
    source = open_prepared(OLD / "prepared", SENSOR)
    assert source.names == [f"drive{i // 3}/{i:06d}.bin" for i in (0, 1, 2, 4)]  # 3 could not be used
    for index, name in enumerate(source.names):
        image = read_scan(OLD / "scans" / name, SENSOR)
        assert np.abs(source[index][0] - image[0]).max() <= 1e-3
        assert np.array_equal(source[index][1], image[1])


@pytest.mark.parametrize("begun", [False, True], ids=["anew", "from where it stopped"])
def test_prepared_scans_are_made_again(tmp_path: Path, begun: bool):
    out = tmp_path / "out"
    if begun:
        shutil.copytree(OLD / "prepared-half", out)
    work = Preparation(out, plan())
    missing = work.begin()
    assert missing == ([1, 2] if begun else [0, 1, 2])
    work.make(missing, on_bad_scan="skip")
    assert_same(out, OLD / "prepared")


def test_a_damaged_prepared_shard_is_made_again(tmp_path: Path):
    shutil.copytree(OLD / "prepared", tmp_path / "out")
    path = tmp_path / "out" / "scans-000001.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    work = Preparation(tmp_path / "out", plan())
    assert work.begin() == [1]
    work.make([1], on_bad_scan="skip")
    assert files(tmp_path / "out") == files(OLD / "prepared")
    assert read_manifest(tmp_path / "out") == read_manifest(OLD / "prepared")


def test_pairs_open():
    source = PairSource(store(OLD / "pairs"), 20)
    assert len(source) == 20
    x_0, x_1 = source[17]
    assert torch.equal(x_0, standard_normal(SHAPE, 3, "pairs", 8 + 17))
    assert torch.equal(x_1, x_0.half().float())


@pytest.mark.parametrize("begun", [False, True], ids=["anew", "from where it stopped"])
def test_pairs_are_made_again(tmp_path: Path, begun: bool):
    out = tmp_path / "out"
    if begun:
        shutil.copytree(OLD / "pairs-half", out)
    made = make_pairs(store(out), Field(still, store(out).recipe.shape), 20)
    assert made.pairs == (8 if begun else 20)  # two batches were sealed, one lay loose
    assert_same(out, OLD / "pairs")
