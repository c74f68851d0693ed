"""A run small enough for a test: 8 x 64 images of random walls, a flow of a few thousand weights."""

import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS

ROOT = Path(__file__).resolve().parents[2]

TINY = [
    "data=folder",
    "sensor.rows=8",
    "sensor.columns=64",
    "backbone.base_channels=8",
    "backbone.depths=[1,1]",
    "backbone.num_heads=[1,2]",
    "backbone.time_channels=16",
    "backbone.patch=[1,4]",
    "backbone.dropout=0.1",
    "data.batch_size=4",
    "data.validation.share=0.25",
    "stage.warmup_images=16",
    "trainer.accelerator=cpu",
    "trainer.max_steps=12",
    "trainer.val_check_interval=3",
    "trainer.log_every_n_steps=1",
    "callbacks.ema.every=2",
    "callbacks.checkpoint.every=2",
    "callbacks.pictures=null",
    "samples.num=1",
    "sampler.steps=2",
    "loggers=[csv]",
]


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 12 scans: ground with a wall at a random distance."""
    folder = tmp_path_factory.mktemp("scans")
    sensor = SENSORS["hdl64e"].resized(32, 256)
    rays = sensor.rays()
    e, a = rays.numpy()
    for index in range(12):
        draw = np.random.default_rng(index)
        ground = np.where(e < 0, -1.73 / np.sin(np.minimum(e, -1e-3)), np.inf)
        wall = draw.uniform(5, 40) / np.maximum(np.cos(a - draw.uniform(-3, 3)), 1e-3)
        r = np.minimum(ground, wall)
        hit = (r > 2) & (r < 75)
        image = np.stack([np.where(hit, r, 0), np.where(hit, 0.2 + 0.5 * (r == wall), 0)]).astype(np.float32)
        write_points(folder / f"{index:06d}.bin", *image_to_points(image, rays))
    return folder


Run = Callable[..., subprocess.CompletedProcess[str]]


def run_train(
    cwd: Path, scans: Path, *overrides: str, check: bool = True, flags: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """train.py on the tiny run, in its own process, from a folder of its own."""
    command = [sys.executable, str(ROOT / "train.py"), *flags, *TINY, f"data.root={scans}", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False)
    if check and done.returncode:
        raise AssertionError(f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return done


@pytest.fixture
def train(scans: Path, tmp_path: Path) -> Run:
    return functools.partial(run_train, tmp_path, scans)


@pytest.fixture(scope="session")
def alone(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """(folder, what it printed) of the tiny run that nobody disturbed."""
    cwd = tmp_path_factory.mktemp("alone")
    done = run_train(cwd, scans, "name=alone")
    return cwd / "runs" / "alone", done.stdout


@pytest.fixture
def copied(alone: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of that run, to be damaged."""
    return Path(shutil.copytree(alone[0], tmp_path / "runs" / "copied"))
