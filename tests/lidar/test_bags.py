"""Recordings of ROS, written by rosbags' and mcap's own writers, hold the points that were written."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.bags import read_bag
from r2flow.lidar.point_cloud2 import cloud_of
from r2flow.lidar.scan_files import read_points
from tests.lidar.conftest import assert_points

pytest.importorskip("rosbags", reason="rosbags is not installed")
pytest.importorskip("mcap", reason="mcap is not installed")

from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

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
    compress: bool = False,
) -> Path:
    """A recording of the three clouds in each topic, the last without header.stamp; the file that a
    user would name. `compress`: each message by itself.
    """
    one = storage == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    writer = (
        Writer1(path) if one else Writer(path, version=8, storage_plugin=StoragePlugin[storage])
    )
    if compress:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
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
        for (_, scan), xyz in zip(found, CLOUDS, strict=True):
            assert scan.frame == "lidar"
            assert_points(scan.cloud.points(), xyz, *fields(len(xyz)))


def test_unpack_writes_files_that_every_verb_reads(r2flow, tmp_path: Path):
    file = record(tmp_path / "drive", "MCAP", ("/front", "/rear"), stamps=(1, 1, 2))
    out = tmp_path / "scans"
    line = r2flow("unpack", file, "--out", out).refusal
    assert line.count(str(file)) == 1
    assert "give one of its topics of point clouds by --topic: /front, /rear" in line
    assert r2flow("unpack", file, "--topic", "/rear", "--out", out) == (
        0,
        f"3 scans in {out}\n",
        "",
    )
    names = [
        f"{10**9 + 5:019d}.ply",
        f"{10**9 + 5:019d}_000002.ply",
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
    (tmp_path / "empty").mkdir()
    (tmp_path / "drive.mcap.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    for path, words in (
        (whole, "/points (std_msgs/String, encoding cdr)"),
        (cut, "cut off, as by a crash, and holds no whole message"),
        (other, "not a readable .bag file"),
        (tmp_path / "missing.mcap", "No such file"),
        (tmp_path / "empty", "metadata file"),
        (tmp_path / "drive.mcap.zstd", "unpack a compressed file first"),
    ):
        assert words in r2flow("unpack", path, "--out", tmp_path / "out").refusal
    assert not (tmp_path / "out").exists()
    for part in (lone, lone.parent):  # a part of a recording is read by itself
        assert len(list(read_bag(part))) == 3
    with pytest.raises(InputError, match="by --topic: /points"):
        list(read_bag(tmp_path / "drive", "/rear"))


def write_mcap(
    path: Path,
    kind: str = "sensor_msgs/msg/PointCloud2",
    encoding: str = "cdr",
    profile: str = "ros2",
    **options: Any,
) -> Path:
    """The three clouds as messages of a kind and encoding, which may be wrong."""
    ros1 = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile)
        schema = writer.register_schema(kind, "", b"")
        channel = writer.register_channel("/points", encoding, schema)
        for number, xyz in enumerate(CLOUDS):
            cloud = message(store, xyz, time=(number + 1, 5))
            data = serialize(cloud, "sensor_msgs/msg/PointCloud2")
            writer.add_message(channel, number, bytes(data), number)
        writer.finish()
    return path


def assert_clouds(path: Path) -> None:
    found = list(read_bag(path))
    for (_, scan), xyz in zip(found, CLOUDS, strict=True):
        assert_points(scan.cloud.points(), xyz, *fields(len(xyz)))


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.NONE},
        {"use_chunking": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
        {"chunk_size": 1, "compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "profile": ""},
        {"kind": "sensor_msgs/PointCloud2", "encoding": "ros1", "profile": "ros1"},
    ],
    ids=lambda options: ",".join(map(str, options)),
)
def test_every_intact_mcap_is_read(tmp_path: Path, options: dict):
    """Profile, summary, indexes and chunks are optional in the format."""
    assert_clouds(write_mcap(tmp_path / "a.mcap", **options))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "foxglove.PointCloud", "encoding": "protobuf"}, "package mcap-protobuf-support"),
        ({"kind": "foxglove.PointCloud", "encoding": "json"}, "encoding json.*or mcap,"),
        ({"kind": "foxglove_msgs/msg/PointCloud"}, "encoding cdr.*mcap-ros2-support"),
        (
            {"kind": "point_cloud_interfaces/msg/CompressedPointCloud2"},
            "point_cloud_transport republish",
        ),
        ({"kind": "velodyne_msgs/msg/VelodyneScan"}, "VelodyneScan, encoding cdr"),
    ],
)
def test_other_clouds_are_one_line_with_their_encoding_and_a_tool(tmp_path, options, words):
    path = write_mcap(tmp_path / "a.mcap", **options)
    with pytest.raises(InputError, match=f"holds no sensor_msgs/PointCloud2.*{words}") as caught:
        list(read_bag(path))
    assert "damaged" not in str(caught.value)


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.9, 1.0])
def test_of_a_recording_that_was_cut_off_the_whole_clouds_are_read(
    tmp_path, caplog, share, chunked
):
    """mcap's reader takes the half of a message at the end for a message."""
    how = {"chunk_size": 1, "compression": CompressionType.NONE, "use_chunking": chunked}
    file = write_mcap(tmp_path / "whole.mcap", **how)
    whole = file.read_bytes()
    with file.open("rb") as stream:
        data = [one.data for *_, one in make_reader(stream).iter_messages()]
    end = int(share * len(whole)) - 1
    expected = sum(whole.index(one) + len(one) <= end for one in data)
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:end])
    found = list(read_bag(path))
    assert len(found) == expected > 0
    for (_, scan), xyz in zip(found, CLOUDS[:expected], strict=True):
        assert_points(scan.cloud.points(), xyz, *fields(len(xyz)))
    assert f"cut off, as by a crash: its {expected} whole messages are used" in caplog.text


def test_a_damaged_recording_names_mcap_recover(tmp_path: Path):
    file = write_mcap(tmp_path / "whole.mcap", compression=CompressionType.NONE)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 255
    file.write_bytes(content)
    with pytest.raises(InputError, match=f"damaged.*mcap recover {file}"):
        list(read_bag(file))


@pytest.mark.parametrize("storage", ["MCAP", "SQLITE3"])
def test_a_folder_is_read_by_the_ending_of_its_files(tmp_path: Path, storage: str):
    """`ros2 bag reindex` may leave the storage identifier empty; a crash leaves no metadata."""
    file = record(tmp_path / "drive", storage)
    metadata = tmp_path / "drive" / "metadata.yaml"
    text = metadata.read_text()
    assert f"storage_identifier: {storage.lower()}" in text
    metadata.write_text(text.replace(f"identifier: {storage.lower()}", 'identifier: ""'))
    assert_clouds(tmp_path / "drive")
    metadata.unlink()
    for number in range(9):  # the parts of a long recording
        file.with_stem(f"drive_{number + 2}").write_bytes(file.read_bytes())
    assert len(list(read_bag(tmp_path / "drive"))) == 30


def test_messages_that_were_compressed_one_by_one(tmp_path: Path):
    assert_clouds(record(tmp_path / "drive", "SQLITE3", compress=True))


@pytest.mark.parametrize("row_step", [0, 20, 20 * 24, 40 * 24])
def test_a_cloud_without_padding_needs_no_row_step(row_step: int):
    """Drivers fill in 0, the width, what is right, or the size of all rows."""
    cloud = message(get_typestore(Stores.ROS2_HUMBLE), CLOUDS[0])
    assert (cloud.width, cloud.row_step) == (20, 20 * 24)
    cloud.row_step = row_step
    assert_points(cloud_of(Path("a.db3"), cloud).points(), CLOUDS[0], *fields(40))


def test_rows_that_overlap_are_refused():
    cloud = message(get_typestore(Stores.ROS2_HUMBLE), CLOUDS[0], extra=8)
    cloud.row_step = 20
    with pytest.raises(InputError, match="row_step 20 is below width x point_step, 480"):
        cloud_of(Path("a.db3"), cloud)


def test_other_names_of_fields_are_known():
    """Autoware's channel is the ring; a field of another name is renamed by the user."""
    names = {"intensity": "signal", "ring": "channel"}
    message_ = message(get_typestore(Stores.ROS2_HUMBLE), CLOUDS[0])
    for field in message_.fields:
        field.name = names.get(field.name, field.name)
    cloud = cloud_of(Path("a.db3"), message_)
    assert_points(cloud.points(), CLOUDS[0], None, fields(40)[1])
    assert_points(cloud.renamed(["signal=reflectance"]).points(), CLOUDS[0], *fields(40))
