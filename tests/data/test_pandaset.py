"""PandaSet: pickled tables become scans in the laser's own frame."""

import gzip
import io
import json
import pickle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from r2flow.base.errors import InputError
from r2flow.data.described import describe
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading, read_labelled_scan
from r2flow.lidar.labels import labels_beside
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.scan_files.pickled import MOST_STEPS, read_table
from r2flow.lidar.sensors import SENSORS
from tests.conftest import find_drives, refused

STAMPS = 1_557_539_956.5 + np.arange(4) / 10
TURN = Rotation.from_euler("zyx", [-45.0, 1.5, 1.2], degrees=True)
ORIGIN = np.array([0.0, 0.781, 1.860])  # of the laser in the vehicle
RATE, SPEED = np.array([0.05, -0.04, 0.2]), np.array([8.0, -6.0, 0.1])  # rad/s, m/s


class Named(NamedTuple):
    """A class or function by its name alone."""

    name: str

    def __call__(self): ...


class Call(NamedTuple):
    name: str
    args: tuple = ()
    state: object = None


class Writer(pickle._Pickler):
    """Pickles names and calls of packages that are not installed."""

    def save(self, obj, save_persistent_id=True):
        if isinstance(obj, Named):
            self.write(b"c%b\n%b\n" % tuple(obj.name.encode().split()))
        elif isinstance(obj, Call):
            self.save_reduce(Named(obj.name), obj.args, obj.state)
        else:
            super().save(obj, save_persistent_id)


def pickled(obj: object, protocol: int = 4) -> bytes:
    Writer(file := io.BytesIO(), protocol).dump(obj)
    return file.getvalue()


def table(columns: dict[str, np.ndarray]) -> bytes:
    """As pandas 1.0 pickles a table."""
    names = np.array([*columns], dtype=object)
    data = {"data": names, "name": None}
    base = "pandas.core.indexes.base"
    index = Call(f"{base} _new_Index", (Named(f"{base} Index"), data))
    kinds = sorted({values.dtype for values in columns.values()}, key=str)
    parts = []
    for kind in kinds:
        places = [place for place, name in enumerate(columns) if columns[name].dtype == kind]
        values = np.stack([columns[names[place]] for place in places])
        even = Call("builtins slice", (places[0], places[-1] + 1, 1))
        parts.append((values, even if len(places) > 1 else np.array(places)))
    blocks = [{"values": values, "mgr_locs": places} for values, places in parts]
    state = ([index], [], [], {"0.14.1": {"axes": [index], "blocks": blocks}})
    manager = Call("pandas.core.internals.managers BlockManager", (), state)
    held = {"_data": manager, "_typ": "dataframe"}
    return pickled(Call("pandas.core.frame DataFrame", (), held), 3)


def scanned(rocking: float, ahead: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a turn of the laser, (N, 3), their times, and the same points in the world.

    The vehicle drives a curve at a constant rate, and rocks by some degrees between its poses; the
    laser is mounted some metres further ahead.
    """
    azimuth, elevation = np.meshgrid(
        np.linspace(3, -3.2, 120), np.deg2rad(SENSORS["pandar64"].elevations)
    )
    a, e = azimuth.ravel(), elevation.ravel()
    walls = 12 / (np.cos(e) * np.maximum(abs(np.cos(a)) / 3, abs(np.sin(a))))
    r = np.minimum(walls, 2 / np.sin(np.maximum(-e, 1e-3)))  # a street, 2 m below the laser
    r[(e < -0.15) & (a > 1)] = 0.8  # the vehicle
    laser = r * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right_ahead_up = np.stack([-laser[1], laser[0], laser[2]], axis=1)
    tilted = Rotation.from_euler("xyz", [0.0157, -0.0006, 0]).apply(right_ahead_up)
    time = (3 - a) / 6.2 * 0.1 + 0.1  # between the second and the third pose
    rock = np.deg2rad(rocking) * np.sin(np.pi * (time - 0.1) / 0.1)[:, None] * [1, 0.5, 0]
    vehicle = Rotation.from_rotvec(rock).apply(tilted + ORIGIN + [0, ahead, 0])
    pose = TURN * Rotation.from_rotvec(time[:, None] * RATE)
    return laser.T, STAMPS[0] + time, pose.apply(vehicle) + time[:, None] * SPEED + [40, -7, 3]


def write_drive(folder: Path, rocking: float = 0.0, ahead: float = 0.0) -> np.ndarray:
    """One frame, 01.pkl.gz, with labels; returns its points in the laser's frame."""
    laser, times, world = scanned(rocking, ahead)
    forward = np.arange(len(world)) % 5 == 4  # every 5th point is of the other sensor
    columns = dict(zip("xyz", world.T, strict=True), i=np.arange(len(world)) % 256.0, t=times)
    (folder / "lidar").mkdir(parents=True)
    (folder / "annotations/semseg").mkdir(parents=True)
    frame = gzip.compress(table({**columns, "d": forward.astype(int)}), 1)
    (folder / "lidar/01.pkl.gz").write_bytes(frame)
    classes = np.where(world[:, 2] > 3, 13, 7)
    labels = gzip.compress(table({"class": classes}), 1)
    (folder / "annotations/semseg/01.pkl.gz").write_bytes(labels)
    poses = []
    for time in STAMPS - STAMPS[0]:
        turn = (TURN * Rotation.from_rotvec(time * RATE)).as_quat()
        position = time * SPEED + [40, -7, 3]
        heading = dict(zip("xyzw", turn.tolist(), strict=True))
        poses.append({"position": dict(zip("xyz", position, strict=True)), "heading": heading})
    (folder / "lidar/poses.json").write_text(json.dumps(poses))
    (folder / "lidar/timestamps.json").write_text(json.dumps(STAMPS.tolist()))
    return laser[~forward]


def test_points_are_those_that_the_laser_measured(tmp_path: Path):
    laser = write_drive(tmp_path / "002")
    points = read_points(tmp_path / "002/lidar/01.pkl.gz")
    np.testing.assert_allclose(points.xyz, laser, atol=0.005)
    assert points.reflectance.max() == 255


@pytest.mark.parametrize(("rocking", "ahead"), [(0.2, 0.0), (0.0, 0.15)])
def test_a_rocking_vehicle_or_another_mount_is_corrected_by_the_beams(
    tmp_path: Path, rocking: float, ahead: float
):
    laser = write_drive(tmp_path / "002", rocking, ahead)
    xyz = read_points(tmp_path / "002/lidar/01.pkl.gz").xyz
    off = [np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1]))) for p in (xyz, laser)]
    assert np.quantile(abs(off[0] - off[1]), 0.95) < 0.01


def test_drives_splits_and_labels(tmp_path: Path):
    laser = write_drive(tmp_path / "002")
    write_drive(tmp_path / "115")
    assert [drive.name for drive in find_drives("pandaset", tmp_path)] == ["002", "115"]
    assert [drive.name for drive in find_drives("pandaset", tmp_path, "train")] == ["002"]
    assert [drive.name for drive in find_drives("pandaset", tmp_path, "test")] == ["115"]
    assert [drive.name for drive in find_drives("pandaset", tmp_path / "002")] == ["002"]
    paths = [tmp_path / name / "lidar/01.pkl.gz" for name in ("002", "115")]
    assert describe(f"pandaset:{tmp_path}").some(8) == list(map(str, paths))
    scans = open_scans(f"pandaset:{tmp_path}")
    image = scans.source[0]
    assert image.shape == (2, 64, 1024)
    assert image[1].max() == 1
    frame = tmp_path / "002/lidar/01.pkl.gz"
    reading = Reading(SENSORS["pandar64"], reflectance_scale=255.0, reflectance=True)
    _, labels = read_labelled_scan(frame, labels_beside(frame), reading)
    assert set(np.unique(labels)) == {0, 10, 40}  # none, cars, road
    assert np.count_nonzero(labels) == pytest.approx(len(laser), rel=0.01)


def test_what_is_no_table_of_numbers_is_refused_and_never_run(tmp_path: Path):
    path = tmp_path / "01.pkl"
    ran = tmp_path / "ran"
    path.write_bytes(pickled(Call("pandas.core.frame DataFrame", (Call("os mkdir", (str(ran),)),))))
    with refused(path, "names os.mkdir"):
        read_points(path)
    path.write_bytes(pickled(Call("numpy save", (str(ran), [1]))))
    with refused(path, "holds a save, not a table"):
        read_points(path)
    assert not ran.exists()
    path.write_bytes(b"\x80\x03Nr\xff\xff\xff\x0f.")  # the unpickler would allocate 4 GiB
    with refused(path, "too many steps"):
        read_points(path)
    path.write_bytes(b"N0" * MOST_STEPS + b"N.")
    with refused(path, "too many steps"):
        read_points(path)
    columns = {name: np.zeros(3) for name in "xyzi"}
    path.write_bytes(table(columns))
    with refused(path, "no column d"):
        read_points(path)
    assert [*read_table(path)] == [*"xyzi"]


def test_a_frame_needs_its_poses(tmp_path: Path):
    write_drive(tmp_path / "002")
    frame = tmp_path / "002/lidar/01.pkl.gz"
    stamps = frame.with_name("timestamps.json")
    stamps.write_text(json.dumps((STAMPS - 60).tolist()))
    with refused(frame, "not of the time"):
        read_points(frame)
    stamps.write_text(json.dumps(STAMPS[:2].tolist()))
    with refused(frame, "differ in number"):
        read_points(frame)
    stamps.unlink()
    with refused(frame, "timestamps.json"):
        read_points(frame)
    with pytest.raises(InputError, match="data=pandaset"):
        find_drives("folder", tmp_path)
