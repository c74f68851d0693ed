"""Shared by all tests: where reference tensors and real scans lie, and small sensors."""

import os
from pathlib import Path

import pytest
import torch

from r2flow.lidar.sensors import SENSORS, Sensor

ROOT = Path(__file__).resolve().parent.parent

if "PYTEST_XDIST_WORKER" in os.environ:  # a worker for each core: more threads would wait for each other
    torch.set_num_threads(1)
    os.environ.setdefault("OMP_NUM_THREADS", "1")


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
def _fixed_seed() -> None:
    torch.manual_seed(0)
