"""r2flow weights."""

import subprocess
import sys

import pytest
import torch

from r2flow.metrics.extractors.pointnet import PointNet
from r2flow.metrics.extractors.weights import SOURCES
from tests.metrics.conftest import untrained


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("R2FLOW_WEIGHTS", str(tmp_path / "kept"))
    return tmp_path / "kept"


def here(said: str) -> dict[str, bool]:
    """Which networks have their weights, by the table."""
    rows = [line.split() for line in said.splitlines() if line.split(" ")[0] in SOURCES]
    return {row[0]: row[2] != "no" for row in rows}


def test_the_table_says_which_weights_are_here(r2flow, tmp_path, folder):
    code, said, _ = r2flow("weights")
    assert code == 0
    for words in (
        "FRD",
        "FRID",
        "FPD",
        "FSVD",
        "FPVD",
        "darknet53-1024.tar.gz",
        f"Looked for in {folder}",
    ):
        assert words in said
    assert here(said) == dict.fromkeys(SOURCES, False)

    path = tmp_path / "mine.pth"
    torch.save(untrained(PointNet).state_dict(), path)
    code, said, _ = r2flow("weights", "--add", "pointnet", path)
    assert code == 0
    assert said.startswith(f"{folder / 'pointnet.safetensors'}: weights ")
    assert said.endswith("of mine.pth\n")
    weights = said.split(": weights ")[1].split()[0]
    code, said, _ = r2flow("weights")
    assert code == 0
    assert f"{weights} of mine.pth" in said
    assert here(said) == {**dict.fromkeys(SOURCES, False), "pointnet": True}


def test_the_table_of_networks_is_light():
    code = "import sys, r2flow.metrics.extractors; sys.exit(any(m in sys.modules for m in ('torch', 'torchmetrics')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
