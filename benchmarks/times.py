"""How far are times of added points from the true ones? Parts of real scans are hidden.

It needs the folder `real` of R2FLOW_SHARED. A Pandar64's file has times. The others' are made from
the order of firing: a VLP-16 fires its 16 lasers within 2.304 us each every 55.296 us, an HDL-64E
by azimuth, an Ouster one column of its organised file after another, ten turns a second.

python benchmarks/times.py
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.lidar.added_times import times_of
from r2flow.lidar.other_sensors import rows_of
from r2flow.lidar.scan_files import read_cloud, read_points
from r2flow.lidar.sensors import SENSORS
from r2flow.lidar.unfolding import elevations_of

Scan = tuple[str, ndarray, ndarray, ndarray]  # its sensor; points, rows and times in seconds


def turned(xyz: ndarray) -> ndarray:
    """Azimuths in turns from behind, clockwise."""
    return (np.pi - np.arctan2(xyz[:, 1].astype(float), xyz[:, 0])) / (2 * np.pi) % 1


def scans(real: Path) -> Iterator[Scan]:
    xyz = read_points(real / "other_sensors/vlp16/000200.pcd").xyz
    vlp16 = SENSORS["vlp16"]
    row = rows_of(elevations_of(xyz), vlp16)
    laser = np.argsort(vlp16.firing)[row]
    yield "VLP-16", xyz, row, np.round(turned(xyz) * 1800) * 55.296e-6 + laser * 2.304e-6
    xyz = read_points(real / "object/training/velodyne/000000.bin").xyz
    row = rows_of(elevations_of(xyz), SENSORS["hdl64e"])
    yield "HDL-64E", xyz, row, turned(xyz) / 10
    for name in ("os0_128", "os1_128", "os1_32"):
        cloud = read_cloud(real / f"other_sensors/ouster_128/{name}.pcd")
        xyz = np.stack(cloud.columns[:3], 1)
        seen = np.isfinite(xyz).all(1) & xyz.any(1)
        ring = cloud.columns[4].astype(int)
        column = np.arange(len(cloud)) % 1024
        yield f"Ouster {name}", xyz[seen], ring[seen], column[seen] / 10240
    cloud = read_cloud(real / "pandaset/002/lidar/00.pkl.gz")
    xyz = np.stack(cloud.columns[:3], 1)
    time = cloud.columns[4]
    row = rows_of(elevations_of(xyz), SENSORS["pandar64"])
    yield "Pandar64, its own times", xyz, row, time - time.min()


def errors(scan: Scan) -> Iterator[tuple[str, ndarray]]:
    """What is hidden, and the errors in milliseconds."""
    _, xyz, row, time = scan
    seen = row >= 0
    azimuth = np.arctan2(xyz[:, 1].astype(float), xyz[:, 0])[seen]
    row, time = row[seen], time[seen]
    tenth = np.random.default_rng(0).random(len(row)) < 0.1
    parts = (
        ("every 2nd row", row % 2 == 1),
        ("3 of 4 rows", row % 4 > 0),
        ("9 of 10 points", ~tenth),
    )
    for name, hidden in parts:
        found = times_of(
            time[~hidden], row[~hidden], azimuth[~hidden], row[hidden], azimuth[hidden]
        )
        yield name, 1e3 * abs(found - time[hidden])


def main() -> None:
    from real import shared

    print("| sensor | hidden | median (ms) | 90 % (ms) |\n|---|---|---|---|")
    for scan in scans(shared()):
        for name, error in errors(scan):
            print(
                f"| {scan[0]} | {name} | {np.median(error):.4f} | {np.quantile(error, 0.9):.4f} |"
            )


if __name__ == "__main__":
    main()
