"""Point clouds in ROS recordings: .mcap is read with mcap, .db3 and .bag with rosbags.

Type definitions of the recording are not used, since rosbags would turn them into code: messages
are read by the standard definition of PointCloud2.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from r2flow.base.errors import InputError, require
from r2flow.base.files import reading_errors
from r2flow.lidar.scan_files.points import Points, column_points, renamed, warn_of_unused

_CLOUD = "sensor_msgs/PointCloud2"
_ENCODINGS = ("cdr", "ros1")  # of messages that rosbags reads
_TYPES = ("", "i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")  # by the datatype of a PointField
# Python packages that read messages of other types, by their encoding; `mcap` those of any.
_PACKAGES = {
    "protobuf": "mcap-protobuf-support",
    "cdr": "mcap-ros2-support",
    "ros1": "mcap-ros1-support",
}
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins messages that rosbag2 compressed one by one


class Channel(NamedTuple):
    """A topic, and how its messages are stored."""

    topic: str
    kind: str  # such as sensor_msgs/PointCloud2
    encoding: str  # such as cdr


class Recording(NamedTuple):
    """A file of a recording that is open."""

    channels: set[Channel]
    #: Channel, time in nanoseconds and data of each message of a topic, in the order of recording.
    messages: Callable[[str], Iterator[tuple[Channel, int, bytes]]]


def read_bag(
    path: Path, topic: str | None = None, columns: Sequence[str] | None = None
) -> Iterator[tuple[int, Points | InputError]]:
    """Time in nanoseconds and points of each PointCloud2 of a topic, in the order of recording.

    The time is header.stamp, as poses and labels have it; if 0, that of recording. A message that
    is not a valid scan is yielded as an `InputError`. Of a folder, all .mcap, else all .db3 are
    read, whatever its metadata.yaml says.

    Args:
        topic: None takes the only one.
        columns: Fields to rename, as in `r2flow.lidar.scan_files.read_points`.

    Raises:
        InputError: There is no such topic, its clouds have another encoding, or the recording is
            damaged.
    """
    require(str(path), "formats", "rosbags")
    from rosbags.typesys import Stores, get_typestore

    deserialize: dict[str, Callable[[bytes, str], Any]] = {
        "cdr": get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr,
        "ros1": get_typestore(Stores.ROS1_NOETIC).deserialize_ros1,
    }
    # rosbags, mcap and the stores below them raise many kinds on damaged files
    with reading_errors(path), ExitStack() as stack:
        files = [stack.enter_context(_open(file)) for file in _files(path)]
        chosen = _choose([channel for file in files for channel in file.channels], topic)
        for file in files:
            for channel, recorded, stored in file.messages(chosen):
                if channel.kind != _CLOUD:
                    continue
                if stored[:4] == _ZSTD:
                    import zstandard  # of mcap

                    stored = zstandard.decompress(stored)
                message = deserialize[channel.encoding](stored, "sensor_msgs/msg/PointCloud2")
                points: Points | InputError
                try:
                    points = cloud_points(path, message, columns)
                except (TypeError, ValueError) as error:
                    points = InputError(f"{path} at {recorded}: {error}")
                stamp = message.header.stamp
                yield 10**9 * stamp.sec + stamp.nanosec or recorded, points


def _files(path: Path) -> list[Path]:
    """The files of a recording that is a folder, in order; else the path itself."""
    for ending in (".mcap", ".db3"):
        if found := list(path.glob(f"*{ending}")):
            return sorted(found, key=lambda file: (len(file.name), file.name))  # 2 before 10
    return [path]


def _open(path: Path) -> AbstractContextManager[Recording]:
    if path.suffix.lower() == ".mcap":
        return _open_mcap(path)
    if path.is_file() and path.suffix.lower() not in (".db3", ".bag"):
        raise InputError("it is no .mcap, .db3 or .bag; unpack a compressed file first.")
    return _open_ros(path)


@contextmanager
def _open_ros(path: Path) -> Iterator[Recording]:
    from rosbags import rosbag1, rosbag2

    ros1 = path.suffix.lower() == ".bag"
    reader: Any = rosbag1.Reader(path) if ros1 else rosbag2.Reader(path)

    def channel(connection: Any) -> Channel:
        encoding = "ros1" if ros1 else connection.ext.serialization_format
        return Channel(connection.topic, _short(connection.msgtype), encoding)

    def messages(topic: str) -> Iterator[tuple[Channel, int, bytes]]:
        wanted = [connection for connection in reader.connections if connection.topic == topic]
        if wanted:  # rosbags takes none for all
            for connection, recorded, data in reader.messages(connections=wanted):
                yield channel(connection), recorded, data

    with reader:
        yield Recording(set(map(channel, reader.connections)), messages)


@contextmanager
def _open_mcap(path: Path) -> Iterator[Recording]:
    require(str(path), "formats", "mcap")
    from mcap.reader import NonSeekingReader, make_reader

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        with _recoverable(path):
            summary = reader.get_summary()
        indexed = summary is not None and summary.channels and summary.schemas

        def messages(topic: str | None) -> Iterator[tuple[Channel, int, bytes]]:
            stream.seek(0)
            source = reader if indexed else NonSeekingReader(stream, validate_crcs=True)
            with _recoverable(path):
                for schema, channel, message in source.iter_messages(topic, log_time_order=False):
                    yield _channel(channel, schema), message.log_time, message.data

        if summary is not None and indexed:
            schemas = summary.schemas
            channels = [
                _channel(channel, schemas.get(channel.schema_id))
                for channel in summary.channels.values()
            ]
        else:
            channels = [channel for channel, *_ in messages(None)]
        yield Recording(set(channels), messages)


@contextmanager
def _recoverable(path: Path) -> Iterator[None]:
    """Turn every error of reading an .mcap into one that names the tool which rescues the rest."""
    try:
        yield
    except Exception as error:
        raise InputError(
            f"{path} was cut off, as by a crash, or is damaged ({type(error).__name__}): "
            f"mcap recover {path} -o whole.mcap, a tool of mcap.dev, saves its whole messages."
        ) from error


def _channel(channel: Any, schema: Any) -> Channel:
    kind = _short(schema.name) if schema else "unknown"
    return Channel(channel.topic, kind, channel.message_encoding)


def _short(kind: str) -> str:
    """ROS 1's name of a type, which ROS 2 calls sensor_msgs/msg/PointCloud2."""
    return kind.replace("/msg/", "/")


def _choose(channels: Iterable[Channel], topic: str | None) -> str:
    """A topic of point clouds, or the only one."""
    channels = sorted(set(channels))
    readable = sorted(
        {name for name, kind, encoding in channels if kind == _CLOUD and encoding in _ENCODINGS}
    )
    chosen = readable if topic is None else [name for name in readable if name == topic]
    if len(chosen) == 1:
        return chosen[0]
    if readable:
        raise InputError(f"give one of its topics of point clouds by --topic: {_join(readable)}.")
    clouds = [channel for channel in channels if "cloud" in channel.kind.lower()]
    found = clouds or channels
    listed = _join([f"{name} ({kind}, encoding {encoding})" for name, kind, encoding in found])
    advice = ""
    if any("Compressed" in channel.kind for channel in clouds):
        advice = " Decompress them: ros2 run point_cloud_transport republish."
    elif clouds:
        package = _PACKAGES.get(clouds[0].encoding, "mcap")
        advice = (
            f" Read them by the Python package {package}, and write x, y, z, intensity of each "
            "scan by numpy.save."
        )
    raise InputError(
        f"it holds no {_CLOUD} in the encodings {_join(_ENCODINGS)}, but {listed}.{advice}"
    )


def _join(names: Sequence[str]) -> str:
    return ", ".join(names)[:400] or "nothing"


def cloud_points(path: Path, message: Any, columns: Sequence[str] | None = None) -> Points:
    """The points of a PointCloud2 message, checked like points of a scan file."""
    order = ">" if message.is_bigendian else "<"
    point = np.dtype(
        {
            "names": [str(number) for number in range(len(message.fields))],
            "formats": [
                (order + _TYPES[field.datatype], (field.count,) if field.count > 1 else ())
                for field in message.fields
            ],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    packed = message.width * message.point_step
    # Rows may be padded. Drivers that do not pad fill in 0, the width, or the whole size.
    row_step = packed if len(message.data) == message.height * packed else message.row_step
    if row_step < packed:
        raise InputError(f"its row_step {row_step} is below width x point_step, {packed}.")
    shape = message.height, message.width
    table = np.ndarray(shape, point, message.data, 0, (row_step, message.point_step)).ravel()
    arrays = [table[name] for name in table.dtype.names or ()]
    names = renamed([field.name for field in message.fields], columns)
    points = column_points(names, arrays)
    warn_of_unused(path, names, arrays, points)
    return points
