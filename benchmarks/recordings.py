"""Odometry with deskewing on a recording, every 4th ring of it, and that one completed.

It needs the packages kiss-icp and rosbags, and the folder `real` of R2FLOW_SHARED. Recordings are
packed from 20 frames of PandaSet, whose points have their own times, and from two clips of KITTI
raw, whose times follow from the azimuth, one turn in 0.1 s. KISS-ICP reads them by rosbags: its
reader of .mcap fails on the messages of mcap-ros2-support 0.3 to 0.6.

Columns: points a scan; length of the way and distance from the first to the last position, in
metres, with deskewing and without.

python -m pip install kiss-icp==1.3.0
python benchmarks/recordings.py
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from kiss_icp.config.parser import load_config
from kiss_icp.datasets import dataset_factory
from kiss_icp.kiss_icp import KissICP
from numpy import ndarray
from real import shared

from r2flow.lidar.packing import pack
from r2flow.lidar.scan_files import Cloud, pandaset, write_cloud
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.tables import print_table

KNOWN = 4  # every KNOWNth ring
START = 1_317_000_000 * 10**9  # nanoseconds; of KITTI's clips, which have no stamps here
COMMON = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2")]


def pandaset_scans() -> Iterator[tuple[int, ndarray]]:
    """Time in nanoseconds and points of each frame, in the laser's frame at their own times."""
    folder = shared() / "pandaset" / "002" / "lidar"
    stamps = json.loads((folder / "timestamps.json").read_text())
    beams = np.sort(SENSORS["pandar64"].elevations)[::-1]
    for file in sorted((shared() / "pandaset" / "frames").glob("*.npz")):
        frame = np.load(file)
        times = frame["t"].astype(float) + stamps[int(file.stem)]
        xyz = pandaset.in_laser(frame["xyz"] + frame["origin"], times, folder)
        rows = np.zeros(len(xyz), [*COMMON, ("timestamp", "f8")])
        rows["x"], rows["y"], rows["z"] = xyz.T
        elevations = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
        rows["ring"] = abs(elevations[:, None] - beams).argmin(axis=1)
        rows["intensity"] = frame["intensity"]
        rows["timestamp"] = times
        yield round(times.min() * 1e9), rows


def kitti_scans(drive: str, step: int) -> Iterator[tuple[int, ndarray]]:
    """The same of a clip of KITTI raw, of every `step`th frame; rings lie one after another."""
    folder = shared() / "raw" / "2011_09_26" / f"2011_09_26_drive_{drive}_sync"
    for number, file in enumerate(sorted(folder.glob("velodyne_points/data/*.bin"))):
        points = np.fromfile(file, "<f4").reshape(-1, 4)
        yaw = np.arctan2(points[:, 1], points[:, 0])
        rows = np.zeros(len(points), [*COMMON, ("t", "u4")])
        rows["x"], rows["y"], rows["z"], rows["intensity"] = points.T
        wraps = np.diff(yaw % (2 * np.pi)) < -np.pi
        rows["ring"] = np.clip(np.cumsum([False, *wraps]), 0, 63)
        rows["t"] = np.round(5e7 * (1 - yaw / np.pi))
        yield START + number * step * 10**8, rows


def recording(scans: list[tuple[int, ndarray]], out: Path, every: int) -> Path:
    """A recording of every `every`th ring."""
    paths = [out.with_suffix("") / f"{stamp:019d}.ply" for stamp, _ in scans]
    for path, (_, rows) in zip(paths, scans, strict=True):
        write_cloud(path, Cloud.of(rows[rows["ring"] % every == 0]))
    pack(paths, out)
    return out


def odometry(path: Path, deskew: bool) -> tuple[int, float, float]:
    """Median number of points, length of the way and distance to the end."""
    config = load_config(None)
    config.data.deskew = deskew
    config.mapping.voxel_size = 1.0
    scans = dataset_factory(dataloader="rosbag", data_dir=path, topic="/points")
    kiss = KissICP(config)
    counts, positions = [], []
    for number in range(len(scans)):
        points, times = scans[number]
        kiss.register_frame(points, times)
        counts.append(len(points))
        positions.append(kiss.last_pose[:3, 3].copy())
    way = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    return int(np.median(counts)), float(way), float(np.linalg.norm(positions[-1] - positions[0]))


def main(clips: list[str]) -> None:
    folder = Path(tempfile.mkdtemp())
    known = {
        "pandaset": pandaset_scans,
        "kitti48": lambda: kitti_scans("0048", 2),
        "kitti5": lambda: kitti_scans("0005", 8),
    }
    rows = []
    for name in clips or [*known]:
        scans = list(known[name]())
        whole = recording(scans, folder / f"{name}.mcap", 1)
        thin = recording(scans, folder / f"{name}_thin.mcap", KNOWN)
        dense = folder / f"{name}_dense.mcap"
        subprocess.run(["r2flow", "complete", thin, "--out", dense], check=True)
        for what, path in (("all rings", whole), ("every 4th", thin), ("completed", dense)):
            count, *with_deskewing = odometry(path, True)
            _, *without = odometry(path, False)
            figures = [f"{figure:.2f}" for figure in (*with_deskewing, *without)]
            rows.append((name, what, str(count), *figures))
    print_table(
        rows, ("clip", "rings", "points", "way", "to the end", "way, not deskewed", "to the end")
    )


if __name__ == "__main__":
    main(sys.argv[1:])
