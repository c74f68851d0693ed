"""Recordings of ROS: .mcap is read with mcap, .db3 and .bag with rosbags.

Type definitions of the recording are not used, since rosbags would turn them into code: clouds
are read by the standard definition of PointCloud2, and all other messages stay bytes.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from r2flow.base.errors import InputError, check, require
from r2flow.base.files import reading_errors, refuse_pointer
from r2flow.lidar.point_cloud2 import CLOUD, ENCODINGS, Scan, read_message

_ENDINGS = (".mcap", ".db3", ".bag")
_LARGEST_MESSAGE = 1 << 28  # bytes unpacked; a cloud of 128 x 4096 points has 25 MB
_OTHER_CLOUDS = (  # how they become scans
    "Compressed clouds: ros2 run point_cloud_transport republish. Others: read them by the Python "
    "package mcap-protobuf-support, mcap-ros2-support, mcap-ros1-support or mcap, and write x, y, "
    "z, intensity of each scan by numpy.save."
)
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins messages that rosbag2 compressed one by one


@dataclass(frozen=True, order=True)
class Channel:
    """A topic, and how its messages are stored."""

    topic: str
    kind: str  # such as sensor_msgs/PointCloud2
    encoding: str  # such as cdr
    #: For a writer: (schema, channel) of mcap, or rosbags' connection.
    original: Any = field(default=None, compare=False, repr=False)
    count: int = field(default=0, compare=False)  # of its messages


class Message(NamedTuple):
    """A message as bytes, and its times in nanoseconds."""

    channel: Channel
    recorded: int
    data: bytes
    published: int = 0  # stored in .mcap alone, as is the sequence
    sequence: int = 0


@dataclass(frozen=True)
class Recording:
    """A recording that is open: all parts of a folder."""

    path: Path
    storage: str  # .mcap, .db3 or .bag
    channels: tuple[Channel, ...]  # those without messages, too
    #: The messages of a topic, or of all; in the order of their times, equal ones as stored.
    messages: Callable[[str | None], Iterator[Message]] = lambda topic: iter(())
    #: Of .mcap: profile, attachments and metadata records.
    profile: str = ""
    attachments: Callable[[], Iterable[Any]] = tuple
    metadata: Callable[[], Iterable[Any]] = tuple

    def scans(self, topic: str) -> Iterator[tuple[Message, Scan | InputError]]:
        """Each cloud of a topic, or why it cannot be read."""
        with reading_errors(self.path):
            for message in self.messages(topic):
                if message.channel.kind == CLOUD:
                    yield message, read_message(self.path, message)


def is_recording(path: str | Path) -> bool:
    """Whether a path names a recording: a file, or the folder of a ROS 2 bag."""
    path = Path(path)
    return path.suffix.lower() in _ENDINGS or _files(path) != [path]


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Open a .mcap, .db3 or .bag, or all .mcap, else all .db3 of a folder, whatever its
    metadata.yaml says.

    Raises:
        InputError: It is missing, damaged or of another format.
    """
    check(path.exists(), f"{path} does not exist, or is a broken link. Is the path right?")
    with reading_errors(path):
        paths = _files(path)
        for file in filter(Path.is_file, paths):
            refuse_pointer(file)
    require(str(path), "formats", "rosbags")
    # rosbags, mcap and the stores below them raise many kinds on damaged files
    with ExitStack() as stack:
        with reading_errors(path):
            files = [stack.enter_context(_open(file)) for file in paths]

        def messages(topic: str | None) -> Iterator[Message]:
            with reading_errors(path):
                for file in files:
                    yield from map(_unpacked, file.messages(topic))

        yield Recording(
            path,
            files[0].storage,
            tuple(channel for file in files for channel in file.channels),
            messages,
            files[0].profile,
            lambda: (one for file in files for one in file.attachments()),
            lambda: (one for file in files for one in file.metadata()),
        )


def read_bag(path: Path, topic: str | None = None) -> Iterator[tuple[int, Scan | InputError]]:
    """Time in nanoseconds and cloud of each PointCloud2 of a topic, in the order of time.

    The time is header.stamp, as poses and labels have it; if 0, that of recording. A message that
    is no cloud is yielded as an `InputError`.

    Args:
        topic: None takes the only one.

    Raises:
        InputError: There is no such topic, its clouds have another encoding, or the recording is
            damaged.
    """
    with open_recording(path) as recording:
        for message, scan in recording.scans(choose_topic(recording, topic)):
            stamp = 0 if isinstance(scan, InputError) else scan.stamp
            yield stamp or message.recorded, scan


def _unpacked(message: Message) -> Message:
    if message.channel.encoding != "cdr" or message.data[:4] != _ZSTD:
        return message
    import zstandard  # of mcap

    size = zstandard.frame_content_size(message.data)
    check(
        size <= _LARGEST_MESSAGE,
        f"it has a message of {size:,} bytes, more than {_LARGEST_MESSAGE >> 20} MiB.",
    )
    decompressor = zstandard.ZstdDecompressor()
    return message._replace(data=decompressor.decompress(message.data, _LARGEST_MESSAGE))


def _files(path: Path) -> list[Path]:
    """The files of a recording that is a folder, in order; else the path itself."""
    names = os.listdir(path) if path.is_dir() else []
    for ending in (".mcap", ".db3"):
        if found := [path / name for name in names if name.endswith(ending)]:
            return sorted(found, key=lambda file: (len(file.name), file.name))  # 2 before 10
    return [path]


def _open(path: Path) -> AbstractContextManager[Recording]:
    if path.suffix.lower() == ".mcap":
        from r2flow.lidar.mcap_files import open_mcap  # needs this module

        return open_mcap(path)
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
        kind = short_kind(connection.msgtype)
        return Channel(connection.topic, kind, encoding, connection, connection.msgcount)

    def messages(topic: str | None) -> Iterator[Message]:
        wanted = [one for one in reader.connections if topic in (None, one.topic)]
        if wanted:  # rosbags takes none for all
            for connection, recorded, data in reader.messages(connections=wanted):
                yield Message(channel(connection), recorded, data)

    with reader:
        storage = ".bag" if ros1 else ".db3"
        yield Recording(path, storage, tuple(map(channel, reader.connections)), messages)


def short_kind(kind: str) -> str:
    """ROS 1's name of a type, which ROS 2 calls sensor_msgs/msg/PointCloud2."""
    return kind.replace("/msg/", "/")


def choose_topic(recording: Recording, topic: str | None) -> str:
    """A topic of point clouds, or the only one."""
    channels = sorted(set(recording.channels))
    readable = sorted(
        {one.topic for one in channels if one.kind == CLOUD and one.encoding in ENCODINGS}
    )
    found = [name for name in readable if topic in (None, name)]
    if len(found) == 1:
        return found[0]
    if readable:
        raise InputError(
            f"{recording.path}: give one of its topics of point clouds by --topic: "
            f"{_join(readable)}."
        )
    clouds = [channel for channel in channels if "cloud" in channel.kind.lower()]
    listed = [f"{one.topic} ({one.kind}, encoding {one.encoding})" for one in clouds or channels]
    raise InputError(
        f"{recording.path} holds no {CLOUD} in the encodings {_join(ENCODINGS)}, but "
        f"{_join(listed)}. {_OTHER_CLOUDS}"
    )


def _join(names: Sequence[str]) -> str:
    return ", ".join(names)[:400] or "nothing"
