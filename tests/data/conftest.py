"""Scan folders in the layouts of KITTI, each scan a few points that carry its number."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.data.opening import find_drives
from r2flow.data.prepared import plan_files, prepare
from r2flow.data.reading import Reading
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import Sensor


def write_scan(path: Path, number: int, reflectance: float = 0.5) -> None:
    """A scan whose only return lies at 5 + number metres."""
    path.parent.mkdir(parents=True, exist_ok=True)
    r = 5.0 + number
    write_points(path, np.array([[r, 0.01, -0.05 * r]], np.float32), np.array([reflectance], np.float32))


@pytest.fixture
def kitti_360(tmp_path: Path) -> Path:
    for drive in (0, 2, 3, 4, 10):
        for frame in range(3):
            name = f"data_3d_raw/2013_05_28_drive_{drive:04d}_sync/velodyne_points/data/{frame:010d}.bin"
            write_scan(tmp_path / name, drive * 3 + frame)
    return tmp_path


@pytest.fixture
def numbered(tmp_path: Path) -> Path:
    """Twelve scans in a folder, at 5 to 16 m."""
    for number in range(12):
        write_scan(tmp_path / "scans" / f"{number:06d}.bin", number)
    return tmp_path / "scans"


def prepare_folder(root: Path, out: Path, sensor: Sensor, layout: str = "folder") -> Path:
    """The scans of a data set, prepared."""
    prepare(out, plan_files(layout, root, find_drives(layout, root), Reading(sensor)))
    return out
