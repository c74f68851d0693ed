"""Reading .mcap recordings, whole or cut off, with or without an index."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from r2flow.base.errors import InputError, check, require
from r2flow.lidar.bags import Channel, Message, Recording, short_kind

_log = logging.getLogger(__name__)

_LARGEST_CHUNK = 1 << 30  # bytes unpacked; writers close them after a few MB


@contextmanager
def open_mcap(path: Path) -> Iterator[Recording]:
    """Open an .mcap; of one that was cut off, as by a crash, the whole messages are read.

    Raises:
        InputError: It is damaged, or was cut off before the first whole message.
    """
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
            max(sizes, default=0) <= _LARGEST_CHUNK,
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
            _log.warning(
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
    kind = short_kind(schema.name) if schema else "unknown"
    return Channel(channel.topic, kind, channel.message_encoding, (schema, channel), count)
