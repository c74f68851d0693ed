"""What is written to a recording is read by the libraries of others, and what is not changed stays
as bytes.
"""

import re
import struct
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.bag_writers import write_recording
from r2flow.lidar.bags import open_recording, read_bag
from r2flow.lidar.point_cloud2 import cloud_of, written
from r2flow.lidar.scan_files import Cloud, read_cloud
from r2flow.reports.recordings import complete_recording

pytest.importorskip("rosbags", reason="rosbags is not installed")
pytest.importorskip("mcap", reason="mcap is not installed")

from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # in the order of datatypes 1 to 8
TEXT = b"\0\1\0\0\3\0\0\0hi\0"  # CDR of the string "hi"


def rows(count: int, seed: int = 0) -> np.ndarray:
    """Points with a field of every type, one of three numbers and NaN rows."""
    draw = np.random.default_rng(seed)
    kinds = [*((axis, "f4") for axis in "xyz"), *((f"{kind}_field", kind) for kind in KINDS)]
    table = np.zeros(count, [*kinds, ("normal", "f4", 3)])
    for name in table.dtype.names:
        table[name] = draw.integers(0, 100, table[name].shape)
    table["x"][::7] = np.nan
    return table


def decoded(data: bytes, encoding: str = "cdr"):
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    read = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return read(data, "sensor_msgs/msg/PointCloud2")


def structured(message) -> np.ndarray:
    """The points of a message, by its description alone."""
    kind = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [(KINDS[f.datatype - 1], (f.count,) if f.count > 1 else ()) for f in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )  # fmt: skip
    return np.frombuffer(message.data.tobytes(), kind)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_every_type_of_field_is_written_and_read(encoding: str):
    given = rows(50)
    message = decoded(written(Cloud.of(given), 123 * 10**9 + 5, "läser", encoding), encoding)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (123, 5)
    assert message.header.frame_id == "läser"
    assert [field.datatype for field in message.fields[3:11]] == [1, 2, 3, 4, 5, 6, 7, 8]
    offsets = [field.offset for field in message.fields]
    assert offsets == sorted(offsets)
    assert (message.height, message.width, message.row_step) == (1, 50, 50 * message.point_step)
    assert not message.is_dense  # NaN
    assert not message.is_bigendian
    for found in (structured(message), cloud_of(Path("a"), message).array()):
        assert found.dtype.names == given.dtype.names
        for name in given.dtype.names:
            assert found[name].tobytes() == given[name].tobytes()


@pytest.mark.parametrize(
    ("encoding", "seconds", "words"),
    [
        ("ros1", 2**32 - 1, None),
        ("ros1", 2**31, None),
        ("ros1", -1, "not one of ROS 1"),
        ("ros1", 2**32, "not one of ROS 1"),
        ("cdr", 2**31 - 1, None),
        ("cdr", -(2**31), None),
        ("cdr", 2**31, "not one of ROS 2"),
    ],
)
def test_times_are_those_that_ros_counts(encoding, seconds, words):
    """ROS 1's seconds are unsigned, ROS 2's are signed, both of 32 bits."""
    with nullcontext() if words is None else pytest.raises(InputError, match=words):
        message = written(Cloud.of(rows(9)), 10**9 * seconds, "", encoding)
        # after ROS 1's sequence, and after the head of CDR
        (stored,) = struct.unpack_from("<I" if encoding == "ros1" else "<i", message, 4)
        assert stored == seconds


def test_a_grid_becomes_rows_of_which_none_is_nan():
    grid = rows(60).reshape(4, 15)
    grid["x"] = 1
    message = decoded(written(Cloud.of(grid), 0, "", "cdr"))
    assert (message.height, message.width, message.is_dense) == (1, 60, True)
    assert structured(message)["y"].tobytes() == grid["y"].tobytes()


@pytest.mark.parametrize("kind", ["u8", "f2", "U3"])
def test_types_that_a_message_cannot_hold_are_refused(kind: str):
    table = np.zeros(3, [("x", "f4"), ("t", kind)])
    with pytest.raises(InputError, match="cannot hold the field t of"):
        written(Cloud.of(table), 0, "", "cdr")


def test_fields_of_one_name_are_refused_and_overlapping_ones_kept():
    message = decoded(written(Cloud.of(rows(9)), 0, "", "cdr"))
    rgb = replace(message.fields[5], name="u2_first", datatype=2)
    overlapping = replace(message, fields=[*message.fields, rgb])
    cloud = cloud_of(Path("a"), overlapping)
    assert (cloud.array()["u2_first"] == rows(9)["i2_field"]).all()  # below 100
    twice = replace(message, fields=[*message.fields, message.fields[0]])
    with pytest.raises(InputError, match="two fields of the name x"):
        cloud_of(Path("a"), twice).array()


@pytest.mark.parametrize(
    ("name", "datatype", "offset"),
    [("spare", 0, 0), ("spare", 9, 0), ("spare", 7, 10**6), ("", 7, 0)],
)
def test_fields_outside_a_point_are_left_out_with_a_line(tmp_path, caplog, name, datatype, offset):
    message = decoded(written(Cloud.of(rows(9)), 0, "", "cdr"))
    spare = replace(message.fields[0], name=name, datatype=datatype, offset=offset)
    cloud = cloud_of(tmp_path / "a", replace(message, fields=[*message.fields, spare]))
    assert cloud.array()["y"].tobytes() == rows(9)["y"].tobytes()
    assert name not in cloud.names
    assert f"{name!r} (datatype {datatype})" in caplog.text


def test_half_of_the_data_is_one_line():
    message = decoded(written(Cloud.of(rows(10)), 0, "", "cdr"))
    step = message.point_step
    half = replace(message, data=message.data[: 5 * step])
    with pytest.raises(InputError, match=f"its data have {5 * step:,} bytes, not {10 * step:,}"):
        cloud_of(Path("a"), half)


def test_new_fields_follow_those_at_their_places():
    """In a gap, or last in the list but first in the point, they are misread by others."""
    given = np.zeros(6, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2")])
    given["ring"] = range(6)
    padded = np.dtype({"names": given.dtype.names, "formats": ["f4", "f4", "f4", "u2"],
                       "offsets": [0, 4, 8, 20], "itemsize": 32})  # fmt: skip
    message = decoded(written(Cloud.of(given), 0, "", "cdr"))
    fields = [replace(f, offset=padded.fields[f.name][1]) for f in message.fields]
    data = np.frombuffer(given.astype(padded).tobytes(), np.uint8)
    message = replace(message, fields=fields, point_step=32, data=data)
    from r2flow.lidar.point_cloud2 import Scan

    cloud = cloud_of(Path("a"), message)
    more = cloud.with_fields({"measured": np.ones(6, np.uint8), "error": np.ones(6, np.float32)})
    found = decoded(Scan(0, "", cloud, message, "cdr").replaced(more))
    assert [(f.name, f.offset) for f in found.fields] == [
        ("x", 0), ("y", 4), ("z", 8), ("ring", 20), ("measured", 32), ("error", 36),
    ]  # fmt: skip
    assert found.point_step == 40
    assert (structured(found)["ring"] == range(6)).all()


def rich_mcap(path: Path) -> Path:
    """Two channels of a topic, an unknown type, a channel without messages, times of publication,
    an attachment, a metadata record, ties.
    """
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start("ros2", "test")
        cloud = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"as it is")
        odd = writer.register_schema("my_msgs/msg/Odd", "ros2msg", b"float32 a\n")
        points = writer.register_channel("/points", "cdr", cloud, {"offered_qos_profiles": "q"})
        first = writer.register_channel("/odd", "cdr", odd, {"node": "1"})
        second = writer.register_channel("/odd", "cdr", odd, {"node": "2"})
        writer.register_channel("/never", "cdr", odd)
        for number in (1, 0, 2):  # not in the order of time
            stamp = 10**9 * (number + 1)
            data = written(Cloud.of(sweep()), stamp, "lidar", "cdr")
            writer.add_message(points, stamp, data, stamp - 7, number + 40)
            writer.add_message(second, stamp, b"\0\1\0\0two", stamp - 9, 3)
            writer.add_message(first, stamp, b"\0\1\0\0one", stamp - 8, 2)
        writer.add_attachment(5, 6, "map.txt", "text/plain", b"content")
        writer.add_metadata("robot", {"name": "r"})
        writer.finish()
    return path


def sweep(count: int = 40) -> np.ndarray:
    table = np.zeros(count, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("time", "f4")])
    table["x"] = 5
    return table


def facts(path: Path) -> dict:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        messages = [
            (channel.topic, schema.data, channel.metadata, one.log_time, one.publish_time,
             one.sequence, one.data)
            for schema, channel, one in reader.iter_messages()
        ]  # fmt: skip
        return {
            "messages": messages,
            "channels": sorted((c.topic, str(c.metadata)) for c in summary.channels.values()),
            "schemas": sorted((s.name, s.encoding, s.data) for s in summary.schemas.values()),
            "attachments": list(reader.iter_attachments()),
            "metadata": [(one.name, one.metadata) for one in reader.iter_metadata()],
            "profile": reader.get_header().profile,
            "crcs": all(chunk.message_index_length for chunk in summary.chunk_indexes),
        }


def test_an_mcap_is_copied_with_all_that_it_holds(tmp_path: Path):
    file = rich_mcap(tmp_path / "a.mcap")
    with open_recording(file) as recording:
        write_recording(tmp_path / "b.mcap", recording, recording.messages(None))
        with pytest.raises(InputError, match=rf"written as a file: give --out {tmp_path}/b.mcap"):
            write_recording(tmp_path / "b.bag", recording, recording.messages(None))
    assert facts(tmp_path / "b.mcap") == facts(file)
    assert {path.name for path in tmp_path.iterdir()} == {"a.mcap", "b.mcap"}


def ros_recording(path: Path) -> Path:
    """Clouds, and a topic of a type that rosbags does not know, as .bag or .db3."""
    one = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    qos = Qos(QosHistory.KEEP_LAST, 3, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL,
              QosTime(1, 2), QosTime(3, 4), QosLiveliness.AUTOMATIC, QosTime(5, 6), False)  # fmt: skip
    writer = Writer1(path) if one else Writer(path.with_suffix(""), version=8, storage_plugin=StoragePlugin.SQLITE3)  # fmt: skip
    store.register(get_types_from_msg("float32 a\n", "my_msgs/msg/Odd"))
    kept = {"callerid": "/node", "latching": 1} if one else {"offered_qos_profiles": [qos]}
    with writer:
        points = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
        other = writer.add_connection("/odd", "my_msgs/msg/Odd", typestore=store, **kept)
        for number in range(3):
            stamp = 10**9 * (number + 1)
            cloud = written(Cloud.of(sweep()), stamp, "lidar", "ros1" if one else "cdr")
            writer.write(points, stamp, cloud)
            writer.write(other, stamp + 1, b"\0\1\0\0odd")
    return path if one else path.with_suffix("") / path.name


@pytest.mark.parametrize(
    ("given", "ending"), [("a.bag", ".bag"), ("a.db3", ".db3"), ("a.db3", ".mcap")]
)
def test_bytes_definitions_and_qualities_of_service_are_copied(tmp_path: Path, given, ending):
    file = ros_recording(tmp_path / given)
    out = tmp_path / f"out{ending}"
    with open_recording(file) as recording:
        write_recording(out, recording, recording.messages(None))

    def described(path: Path):
        with AnyReader([path]) as reader:
            found = [
                (c.topic, c.msgtype, c.msgdef, c.digest, getattr(c.ext, "callerid", None), getattr(c.ext, "latching", None),
                 getattr(c.ext, "offered_qos_profiles", None))
                for c in reader.connections
            ]  # fmt: skip
            return sorted(found, key=str), [
                (c.topic, time, data) for c, time, data in reader.messages()
            ]

    found, stored = described(out), described(file)
    if ending == ".mcap":  # it has no place for the hash of a type
        stored = ([(*one[:3], "", *one[4:]) for one in stored[0]], stored[1])
    assert found == stored


def test_recordings_before_iron_have_no_definitions(tmp_path: Path):
    with Writer(tmp_path / "a", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for topic, kind in (("/points", "sensor_msgs/msg/PointCloud2"), ("/odd", "my/msg/Odd")):
            one = writer.add_connection(topic, kind, msgdef="", rihs01=" ")
            writer.write(one, 5, TEXT)
    with open_recording(tmp_path / "a") as recording:
        bare = tuple(
            replace(one, original=one.original._replace(digest="")) for one in recording.channels
        )
        messages = [one._replace(channel=bare[one.channel.topic == "/odd"]) for one in recording.messages(None)]  # fmt: skip
        bare = tuple(sorted(bare, reverse=True))
        write_recording(tmp_path / "b.db3", replace(recording, channels=bare), messages)
    with open_recording(tmp_path / "b.db3") as recording:
        assert {one.channel.topic: one.data for one in recording.messages(None)} == {"/points": TEXT, "/odd": TEXT}  # fmt: skip
        texts = {one.topic: one.original.msgdef.data for one in recording.channels}
    assert "uint8[] data" in texts["/points"]
    assert texts["/odd"] == ""


def doubled(cloud: Cloud, number: int) -> Cloud:
    """Each point, and another one behind it."""
    table = cloud.array()
    if number == 1:
        raise InputError("it holds no points")
    far = table.copy()
    far["x"] *= 2
    measured = np.repeat(np.array([1, 0], np.uint8), len(table))
    return Cloud.of(np.concatenate([table, far])).with_fields({"measured": measured})


@pytest.mark.parametrize("everything", [True, False])
@pytest.mark.parametrize("name", ["a.mcap", "a.bag", "a.db3"])
def test_clouds_are_completed_in_their_places(tmp_path, caplog, capsys, name, everything):
    make = rich_mcap if name == "a.mcap" else ros_recording
    file = make(tmp_path / name)
    out = tmp_path / "dense" / name
    how = {"topic": None, "everything": everything, "recipe": {"seed": 0}}
    complete_recording(file, out, complete=doubled, **how)
    assert "2 of 3 clouds of /points completed, 40 new points" in capsys.readouterr().out
    assert re.search(r"left as they are: 1; the first, at \d+: it holds no points", caplog.text)
    assert {path.name for path in out.parent.iterdir()} == {name, f"{name}.json"}
    with open_recording(file) as before, open_recording(out) as after:
        topics = {one.topic for one in after.channels}
        assert ("/odd" in topics) == everything
        old = [one for one in before.messages(None) if everything or one.channel.topic == "/points"]
        new = [*after.messages(None)]
    assert [one.recorded for one in new] == [one.recorded for one in old]
    number = 0
    for was, now in zip(old, new, strict=True):
        assert (was.published, was.sequence) == (now.published, now.sequence)
        if was.channel.topic == "/points" and number != 1:
            was_read, now_read = (decoded(one.data, was.channel.encoding) for one in (was, now))
            assert was_read.header == now_read.header
            table = structured(now_read)
            assert table[:40]["x"].tobytes() == structured(was_read)["x"].tobytes()
            assert (table["x"][40:] == 10).all()
            assert table["measured"].tolist() == [1] * 40 + [0] * 40
        else:
            assert now.data == was.data
        number += was.channel.topic == "/points"
    content = out.read_bytes()
    complete_recording(file, out, complete=doubled, **how)
    assert f"{out} is there already" in capsys.readouterr().out
    with pytest.raises(InputError, match="other settings"):
        complete_recording(file, out, complete=doubled, **{**how, "recipe": {"seed": 1}})
    assert out.read_bytes() == content


def test_a_stopped_command_keeps_its_clouds_and_its_sensor(tmp_path: Path):
    file = ros_recording(tmp_path / "a.db3")
    seen = []

    def stopping(cloud: Cloud, number: int) -> Cloud:
        seen.append(number)
        if len(seen) == 3:
            raise KeyboardInterrupt
        return doubled(cloud, 0)

    how = {"topic": None, "everything": True, "recipe": {}}
    out, whole = tmp_path / "out.db3", tmp_path / "whole.db3"
    with pytest.raises(KeyboardInterrupt):
        complete_recording(file, out, complete=stopping, **how)
    assert not out.exists()
    complete_recording(file, out, complete=stopping, **how)
    assert seen == [0, 1, 2, 0, 2]  # the first again: it decides the sensor
    complete_recording(file, whole, complete=lambda cloud, _: doubled(cloud, 0), **how)
    with open_recording(out) as one, open_recording(whole) as other:
        assert [*one.messages(None)] == [*other.messages(None)]
    assert not list(tmp_path.glob("*.part*"))


def test_nothing_is_left_where_no_cloud_is_completed(tmp_path: Path):
    file = ros_recording(tmp_path / "a.bag")
    with pytest.raises(InputError, match="it holds no points"):
        complete_recording(file, tmp_path / "out.bag", None, True, lambda cloud, _: doubled(cloud, 1), {})  # fmt: skip
    with pytest.raises(InputError, match="by --topic: /points"):
        complete_recording(file, tmp_path / "out.bag", "/none", True, doubled, {})
    assert {path.name for path in tmp_path.iterdir()} == {"a.bag"}


@pytest.mark.parametrize("ending", [".mcap", ".db3", ".bag"])
def test_unpacked_files_are_packed_again(r2flow, tmp_path: Path, ending: str):
    """All fields, times and frames come back, and AnyReader reads them by the stored definitions."""
    first, scans, second = tmp_path / f"a{ending}", tmp_path / "scans", tmp_path / f"b{ending}"
    given = rows(50)[[name for name in rows(1).dtype.names if name != "normal"]]
    given = np.array(given.tolist(), [(name, given.dtype[name]) for name in given.dtype.names])
    from r2flow.lidar.bag_writers import new_recording
    from r2flow.lidar.bags import Message

    recording = new_recording(first, "/points", "sensor_msgs/PointCloud2")
    (channel,) = recording.channels
    stamps = [10**18 + 5, 10**18 + 5, 2 * 10**18]
    data = [written(Cloud.of(given), stamp, "läser", channel.encoding) for stamp in stamps]
    write_recording(
        first, recording, [Message(channel, t, d) for t, d in zip(stamps, data, strict=True)]
    )
    assert r2flow("unpack", first, "--out", scans)[0] == 0
    found = read_cloud(sorted(scans.iterdir())[0]).array()
    assert found.tobytes() == given.tobytes()
    assert r2flow("pack", scans, "--out", second)[0] == 0
    for path in (first, second):
        with AnyReader([path]) as reader:
            read = [(time, raw) for _, time, raw in reader.messages()]
            assert [time for time, _ in read] == stamps
            assert [bytes(raw) for _, raw in read] == data
    assert "exists; give another --out" in r2flow("pack", scans, "--out", second).refusal


def test_names_sort_as_the_recording(r2flow, tmp_path: Path):
    """Clouds of one time, times before 1970 and, of ROS 1, after 2038."""
    from r2flow.lidar.bag_writers import new_recording
    from r2flow.lidar.bags import Message

    def recording(name: str, stamps: list[int]) -> Path:
        file = tmp_path / name
        made = new_recording(file, "/points", "sensor_msgs/PointCloud2")
        (channel,) = made.channels
        messages = []
        for number, stamp in enumerate(stamps):
            table = sweep()
            table["x"] = number + 1
            seconds = stamp // 10**9
            if channel.encoding == "ros1" and seconds >= 2**31:
                data = bytearray(written(Cloud.of(table), 0, "", "ros1"))
                data[4:8] = seconds.to_bytes(4, "little")  # after the sequence
            else:
                data = written(Cloud.of(table), stamp, "", channel.encoding)
            messages.append(Message(channel, number + 1, bytes(data)))
        write_recording(file, made, messages)
        return file

    before = [-3 * 10**9, -2 * 10**9 + 5, -1, *[7] * 12, 10**9]
    later = [10**18, 2**31 * 10**9, (2**32 - 1) * 10**9]
    for name, stamps in (("a.mcap", before), ("a.db3", before), ("a.bag", later)):
        out = tmp_path / name.replace(".", "-")
        assert r2flow("unpack", recording(name, stamps), "--out", out)[0] == 0
        read = [read_cloud(path).array()["x"][0] for path in sorted(out.iterdir())]
        assert read == [*range(1, len(stamps) + 1)]
        again = tmp_path / f"again-{name}"
        assert r2flow("pack", out, "--out", again).returncode == 0
        # of rosbags, which reads the seconds of ROS 1 signed
        read = [stamp % (2**32 * 10**9) for stamp, _ in read_bag(again)]
        assert read == [stamp % (2**32 * 10**9) for stamp in stamps]


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_every_storage_is_read_in_the_order_of_time(tmp_path: Path, storage):
    with Writer(tmp_path / "a", version=8, storage_plugin=storage) as writer:
        store = get_typestore(Stores.ROS2_HUMBLE)
        one = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
        for time in (3, 1, 2):
            writer.write(one, time, written(Cloud.of(sweep()), time, "", "cdr"))
    assert [stamp for stamp, _ in read_bag(tmp_path / "a")] == [1, 2, 3]


def test_a_message_of_any_declared_size_is_not_decompressed(tmp_path: Path):
    """A frame's header alone says 2^40 bytes."""
    bomb = b"\x28\xb5\x2f\xfd\xe0" + (2**40).to_bytes(8, "little") + b"\1\0\0"
    with Writer(tmp_path / "a", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        store = get_typestore(Stores.ROS2_HUMBLE)
        one = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=store)
        writer.write(one, 1, bomb)
    with pytest.raises(InputError, match="a message of 1,099,511,627,776 bytes, more than 256 MiB"):
        list(read_bag(tmp_path / "a"))
