"""Recordings of ROS: .mcap is read with mcap, .db3 and .bag with rosbags.

Type definitions of the recording are not used, since rosbags would turn them into code: clouds
are read by the standard definition of PointCloud2, and all other messages stay bytes.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from r2flow.base.errors import InputError, check, require
from r2flow.base.files import reading_errors
from r2flow.lidar.point_cloud2 import CLOUD, ENCODINGS, Scan, read_message

log = logging.getLogger(__name__)

ENDINGS = (".mcap", ".db3", ".bag")
LARGEST_MESSAGE = 1 << 28  # bytes unpacked; a cloud of 128 x 4096 points has 25 MB
LARGEST_CHUNK = 1 << 30  # bytes unpacked; writers close them after a few MB
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
    return path.suffix.lower() in ENDINGS or _files(path) != [path]


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Open a .mcap, .db3 or .bag, or all .mcap, else all .db3 of a folder, whatever its
    metadata.yaml says.

    Raises:
        InputError: It is missing, damaged or of another format.
    """
    require(str(path), "formats", "rosbags")
    # rosbags, mcap and the stores below them raise many kinds on damaged files
    with ExitStack() as stack:
        with reading_errors(path):
            files = [stack.enter_context(_open(file)) for file in _files(path)]

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
        size <= LARGEST_MESSAGE,
        f"it has a message of {size:,} bytes, more than {LARGEST_MESSAGE >> 20} MiB.",
    )
    decompressor = zstandard.ZstdDecompressor()
    return message._replace(data=decompressor.decompress(message.data, LARGEST_MESSAGE))


def _files(path: Path) -> list[Path]:
    """The files of a recording that is a folder, in order; else the path itself."""
    names = os.listdir(path) if path.is_dir() else []
    for ending in (".mcap", ".db3"):
        if found := [path / name for name in names if name.endswith(ending)]:
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
        kind = _short(connection.msgtype)
        return Channel(connection.topic, kind, encoding, connection, connection.msgcount)

    def messages(topic: str | None) -> Iterator[Message]:
        wanted = [one for one in reader.connections if topic in (None, one.topic)]
        if wanted:  # rosbags takes none for all
            for connection, recorded, data in reader.messages(connections=wanted):
                yield Message(channel(connection), recorded, data)

    with reader:
        storage = ".bag" if ros1 else ".db3"
        yield Recording(path, storage, tuple(map(channel, reader.connections)), messages)


@contextmanager
def _open_mcap(path: Path) -> Iterator[Recording]:
    require(str(path), "formats", "mcap")
    from mcap.reader import NonSeekingReader, make_reader

    with path.open("rb") as file:
        stream: Any = _WholeReads(file)
        cut = _ends_early(file)
        with _recoverable(path):
            reader: Any = make_reader(stream, validate_crcs=True)
            profile = reader.get_header().profile
            summary = None if cut else reader.get_summary()
        sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes] if summary else []
        check(
            max(sizes, default=0) <= LARGEST_CHUNK,
            f"it has a chunk of {max(sizes, default=0):,} bytes, more than 1 GiB.",
        )
        indexed = summary is not None and summary.channels and summary.schemas

        def stored(topic: str | None, ordered: bool) -> Iterator[Message]:
            file.seek(0)
            source = reader if sizes and indexed else NonSeekingReader(stream, validate_crcs=True)
            with _recoverable(path), _up_to_the_cut(cut):
                for schema, channel, one in source.iter_messages(topic, log_time_order=ordered):
                    found = _channel(schema, channel)
                    yield Message(found, one.log_time, one.data, one.publish_time, one.sequence)

        def others(kind: str) -> Iterator[Any]:
            file.seek(0)
            with _recoverable(path), _up_to_the_cut(cut):
                yield from getattr(reader if summary else NonSeekingReader(stream), kind)()

        sort = True
        if summary is not None and indexed:
            counts = summary.statistics.channel_message_counts if summary.statistics else {}
            channels = [
                _channel(summary.schemas.get(one.schema_id), one, counts.get(number, 0))
                for number, one in summary.channels.items()
            ]
        else:
            channels, sort = _counted(stored(None, False))
        if cut:
            check(channels, "it was cut off, as by a crash, and holds no whole message.")
            log.warning(
                "%s was cut off, as by a crash: its %d whole messages are used.",
                path,
                sum(channel.count for channel in channels),
            )
        yield Recording(
            path,
            ".mcap",
            tuple(channels),
            lambda topic: stored(topic, sort),
            profile,
            lambda: others("iter_attachments"),
            lambda: others("iter_metadata"),
        )


def _counted(messages: Iterable[Message]) -> tuple[list[Channel], bool]:
    """The channels of messages, and whether these are not in the order of time: sorting those of an
    .mcap without an index would hold all in memory.
    """
    found: dict[int, Channel] = {}
    counts = Counter[int]()
    last = 0
    unsorted = False
    for message in messages:
        number = message.channel.original[1].id
        found[number] = message.channel
        counts[number] += 1
        unsorted |= message.recorded < last
        last = message.recorded
    return [replace(one, count=counts[number]) for number, one in found.items()], unsorted


@contextmanager
def _up_to_the_cut(cut: bool) -> Iterator[None]:
    try:
        yield
    except EOFError:
        if not cut:
            raise


class _WholeReads:
    """A file of which a read yields all that is asked for; mcap takes less for the whole."""

    def __init__(self, file: Any) -> None:
        self.seek = file.seek
        self.tell = file.tell
        self.seekable = file.seekable
        self._read = file.read

    def read(self, size: int) -> bytes:
        data: bytes = self._read(size)
        if len(data) < size:
            raise EOFError
        return data


def _ends_early(file: Any) -> bool:
    """Whether an .mcap lacks the bytes that end it."""
    begin = file.read(8)
    file.seek(-min(8, file.seek(0, 2)), 2)
    end = file.read(8)
    file.seek(0)
    return bool(begin != end)


@contextmanager
def _recoverable(path: Path) -> Iterator[None]:
    """Turn every error of reading an .mcap into one that names the tool which rescues the rest."""
    try:
        yield
    except (InputError, ImportError, MemoryError):
        raise
    except Exception as error:
        raise InputError(
            f"{path} was cut off, as by a crash, or is damaged ({type(error).__name__}): "
            f"mcap recover {path} -o whole.mcap, a tool of mcap.dev, saves its whole messages."
        ) from error


def _channel(schema: Any, channel: Any, count: int = 0) -> Channel:
    kind = _short(schema.name) if schema else "unknown"
    return Channel(channel.topic, kind, channel.message_encoding, (schema, channel), count)


def _short(kind: str) -> str:
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
    check(not readable, f"give one of its topics of point clouds by --topic: {_join(readable)}.")
    clouds = [channel for channel in channels if "cloud" in channel.kind.lower()]
    listed = [f"{one.topic} ({one.kind}, encoding {one.encoding})" for one in clouds or channels]
    raise InputError(
        f"it holds no {CLOUD} in the encodings {_join(ENCODINGS)}, but {_join(listed)}. "
        f"{_OTHER_CLOUDS}"
    )


def _join(names: Sequence[str]) -> str:
    return ", ".join(names)[:400] or "nothing"
