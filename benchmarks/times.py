"""How far are times of added points from the true ones, and are their rows the true ones? Parts of
real scans are hidden.

It needs the folder `real` of R2FLOW_SHARED. A Pandar64's file has times. The others' are made from
the order of firing: a VLP-16 fires its 16 lasers within 2.304 us each every 55.296 us, an HDL-64E
by azimuth, an Ouster one column of its organised file after another, ten turns a second.

The row of an added point is compared with that of the hidden point next to it, within half a column
of 1,024: its ring, counted from the top. `densify_small` completes, in the rows of all beams.

python benchmarks/times.py
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.spatial import cKDTree

import r2flow
from r2flow.lidar.added_times import times_of
from r2flow.lidar.estimation import estimate_sensor
from r2flow.lidar.other_sensors import rows_of
from r2flow.lidar.scan_files import Cloud, read_cloud, read_points
from r2flow.lidar.sensors import SENSORS
from r2flow.lidar.unfolding import elevations_of

HALF = np.pi / 1024  # of a column, in radians
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


def ringed(real: Path) -> Iterator[tuple[str, Cloud]]:
    """Scans whose files have rings."""
    files = {"HDL-32E": "nuscenes_hdl32e/*.bin"} | {
        f"Ouster {name}": f"ouster_128/{name}.pcd" for name in ("os0_128", "os1_128", "os1_32")
    }
    for name, pattern in files.items():
        (path,) = (real / "other_sensors").glob(pattern)
        cloud = read_cloud(path)
        far = np.linalg.norm(cloud.columns[:3], axis=0) > 0.3  # not NaN
        yield name, cloud.take(np.flatnonzero(far))


def right_rows(cloud: Cloud, every: int) -> tuple[float, float]:
    """Share of added points next to a hidden one, and share of these whose row is its ring."""
    points = cloud.points()
    ring = np.unique(points.ring, return_inverse=True)[1]
    e = elevations_of(points.xyz)
    middle = [np.median(e[ring == number]) for number in range(ring.max() + 1)]
    row = np.argsort(np.argsort(middle)[::-1])[ring]
    sensor = estimate_sensor([points]).sensor
    known = replace(sensor, name="known", elevations=sensor.elevations[::every], firing=None)
    completer = r2flow.load("densify_small").through(sensor).completer(known)
    dense = completer(cloud.take(np.flatnonzero(row % every == 0)).array())
    added = dense[dense["measured"] == 0]
    hidden = row % every > 0
    place = np.stack([added[axis] for axis in "xyz"], 1).astype(float)
    away, nearest = cKDTree(_directions(points.xyz[hidden].astype(float))).query(_directions(place))
    beside = away < HALF
    return float(beside.mean()), float((added["image_row"] == row[hidden][nearest])[beside].mean())


def _directions(xyz: ndarray) -> ndarray:
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True)


def main() -> None:
    from real import shared

    print("| sensor | hidden | median (ms) | 90 % (ms) |\n|---|---|---|---|")
    for scan in scans(shared()):
        for name, error in errors(scan):
            print(
                f"| {scan[0]} | {name} | {np.median(error):.4f} | {np.quantile(error, 0.9):.4f} |"
            )
    print("\n| sensor | hidden | next to a hidden point | of the right row |\n|---|---|---|---|")
    for sensor, cloud in ringed(shared()):
        for every, name in ((2, "every 2nd row"), (4, "3 of 4 rows")):
            beside, right = right_rows(cloud, every)
            print(f"| {sensor} | {name} | {beside:.1%} | {right:.2%} |", flush=True)


if __name__ == "__main__":
    main()
