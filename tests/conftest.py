"""Shared by all tests: where reference tensors and real scans lie, and small sensors."""

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from r2flow import errors
from r2flow.lidar.sensors import SENSORS, Sensor

ROOT = Path(__file__).resolve().parent.parent

if "PYTEST_XDIST_WORKER" in os.environ:  # a worker for each core: more threads would wait for each other
    torch.set_num_threads(1)
    os.environ.setdefault("OMP_NUM_THREADS", "1")


TINY: dict[str, dict[str, Any]] = {
    "hdit": {"base_channels": 16, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
    "adm_unet": {"base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": 1, "num_heads": 2},
    "local": {"channels": 8, "dilations": [1, 2]},
}
TINY["efficient_unet"] = TINY["adm_unet"]
TINY["pyramid"] = {
    "inner": {"name": "hdit", **TINY["hdit"]}, "factor": [1, 2], "coarse": [1, 8], "detail": [1, 8],
    "time_channels": 16,
}  # fmt: skip


def tiny_options(name: str) -> dict[str, Any]:
    """Options of a backbone that builds in milliseconds and takes images of 16 x 64."""
    return {"name": name, **TINY.get(name, {})}


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference tensors and real scans, which is never part of the repository."""
    folder = Path(os.environ.get("R2FLOW_SHARED", ROOT.parent / "shared"))
    if not folder.is_dir():
        pytest.skip("needs the reference tensors and real scans in ../shared or R2FLOW_SHARED")
    return folder


@pytest.fixture(params=list(SENSORS))
def sensor(request: pytest.FixtureRequest) -> Sensor:
    """Every sensor of the table."""
    return SENSORS[request.param]


@pytest.fixture(autouse=True)
def _from_the_start() -> None:
    torch.manual_seed(0)
    errors._odd.clear()
