"""Recordings of ROS, written by rosbags' own writers, hold the points that were written."""

from pathlib import Path

import numpy as np
import pytest

from r2flow.errors import InputError
from r2flow.lidar.bags import read_bag
from r2flow.lidar.scan_files import read_points
from tests.lidar.conftest import assert_points

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

DRAW = np.random.default_rng(1)
CLOUDS = [
    np.round(DRAW.standard_normal((40 * (n + 1), 3)) * [20, 20, 2], 2).astype(np.float32)
    for n in range(3)
]
POINT = np.dtype({"names": ["x", "y", "z", "intensity", "ring"], "formats": ["f4", "f4", "f4", "f4", "u2"],
                  "offsets": [0, 4, 8, 16, 20], "itemsize": 24})  # fmt: skip
CODES = {"f4": 7, "u2": 4}


def fields(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(count) % 256, np.arange(count) % 32


def message(
    store, xyz: np.ndarray, order: str = "<", extra: int = 0, time: tuple[int, int] = (0, 0)
):
    """A cloud with padding within its points and, in two rows, behind each row."""
    kind, types = POINT.newbyteorder(order), store.types
    table = np.zeros(len(xyz), kind)
    for axis, values in zip("xyz", xyz.T, strict=True):
        table[axis] = values
    table["intensity"], table["ring"] = fields(len(xyz))
    rows = table.view(np.uint8).reshape(2, -1) if len(xyz) else np.zeros((2, 0), np.uint8)
    data = np.concatenate([rows, np.zeros((2, extra), np.uint8)], 1)
    header = {"stamp": types["builtin_interfaces/msg/Time"](*time), "frame_id": "lidar"}
    if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__:
        header["seq"] = 0
    described = [
        types["sensor_msgs/msg/PointField"](
            name, POINT.fields[name][1], CODES[POINT[name].str[1:]], 1
        )
        for name in POINT.names
    ]
    return types["sensor_msgs/msg/PointCloud2"](
        types["std_msgs/msg/Header"](**header),
        2,
        len(xyz) // 2,
        described,
        order == ">",
        24,
        data.shape[1],
        data.ravel(),
        True,
    )


def record(
    path: Path,
    storage: str,
    topics: tuple[str, ...] = ("/points",),
    kind: str = "cloud",
    stamps: tuple[int, ...] = (1, 2, 3),
) -> Path:
    """A recording of the three clouds in each topic, the last without header.stamp; the file that a
    user would name.
    """
    one = storage == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    writer = (
        Writer1(path) if one else Writer(path, version=8, storage_plugin=StoragePlugin[storage])
    )
    name = "sensor_msgs/msg/PointCloud2" if kind == "cloud" else "std_msgs/msg/String"
    with writer:
        for topic in topics:
            connection = writer.add_connection(topic, name, typestore=store)
            for number, (xyz, stamp) in enumerate(zip(CLOUDS, stamps, strict=True)):
                how = "<>"[number % 2], 8 * number, (stamp, 5) if number < 2 else (0, 0)
                content = (
                    message(store, xyz, *how) if kind == "cloud" else store.types[name]("text")
                )
                data = (
                    store.serialize_ros1(content, name)
                    if one
                    else store.serialize_cdr(content, name)
                )
                writer.write(connection, 10**9 * stamp, data)
    return path if one else next(file for file in path.iterdir() if file.suffix != ".yaml")


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3", "bag"])
def test_each_cloud_is_read_as_it_was_recorded(tmp_path: Path, storage: str):
    file = record(tmp_path / "drive.bag" if storage == "bag" else tmp_path / "drive", storage)
    for path in {file, tmp_path / "drive"} if storage != "bag" else {file}:
        found = list(read_bag(path))
        assert [stamp for stamp, _ in found] == [10**9 + 5, 2 * 10**9 + 5, 3 * 10**9]
        for (_, points), xyz in zip(found, CLOUDS, strict=True):
            assert_points(points, xyz, *fields(len(xyz)))


def test_unpack_writes_files_that_every_verb_reads(r2flow, tmp_path: Path):
    file = record(tmp_path / "drive", "MCAP", ("/front", "/rear"), stamps=(1, 1, 2))
    out = tmp_path / "scans"
    line = r2flow("unpack", file, "--out", out).refusal
    assert "give one of its topics of point clouds by --topic: /front, /rear" in line
    assert r2flow("unpack", file, "--topic", "/rear", "--out", out) == (
        0,
        f"3 scans in {out}\n",
        "",
    )
    names = [
        f"{10**9 + 5:019d}.ply",
        f"{10**9 + 5:019d}-2.ply",
        f"{2 * 10**9:019d}.ply",
    ]  # two of one time
    assert {path.name for path in out.iterdir()} == set(names)
    for name, xyz in zip(names, CLOUDS, strict=True):
        assert_points(read_points(out / name), xyz, *fields(len(xyz)))
    other = record(
        tmp_path / "other.bag", "bag", stamps=(0, 1, 2)
    )  # its second cloud has the time of names[0]
    assert f"{names[0]} holds other points" in r2flow("unpack", other, "--out", out)[2]
    for option, value, kept in (("--every", 2, [names[0], names[2]]), ("--num", 1, names[:1])):
        some = tmp_path / option
        assert r2flow("unpack", file, "--topic", "/rear", option, value, "--out", some)[0] == 0
        assert {path.name for path in some.iterdir()} == set(kept)


def test_recordings_without_clouds_or_damaged_are_one_line(r2flow, tmp_path: Path):
    whole = record(tmp_path / "text", "MCAP", kind="text")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(record(tmp_path / "drive", "MCAP").read_bytes()[:300])
    lone = tmp_path / "lone" / "part.db3"
    lone.parent.mkdir()
    lone.write_bytes(record(tmp_path / "bag", "SQLITE3").read_bytes())
    other = tmp_path / "other.bag"
    other.write_bytes(b"#ROSBAG V2.0\n" + bytes(400))
    for path, words in (
        (whole, "by --topic: it has none"),
        (cut, "not a readable .mcap file"),
        (other, "not a readable .bag file"),
        (tmp_path / "missing.mcap", "does not exist"),
        (lone.parent, "metadata file"),
    ):
        assert words in r2flow("unpack", path, "--out", tmp_path / "out").refusal
    assert not (tmp_path / "out").exists()
    assert len(list(read_bag(lone))) == 3  # a part of a recording is read by itself
    with pytest.raises(InputError, match="by --topic: /points"):
        list(read_bag(tmp_path / "drive", "/rear"))
