"""Recordings of ROS are written by the libraries that read them: .mcap from .mcap by mcap's Writer,
others by rosbags.

Messages are bytes. mcap's Writer alone keeps times of publication, sequences, channels without
messages, attachments and metadata, and writes checksums.
"""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from r2flow.base.errors import check, require
from r2flow.lidar.bags import Channel, Message, Recording
from r2flow.lidar.point_cloud2 import type_store

_VERSION: Literal[8] = 8  # of rosbag2's metadata: Humble and later read it
_WRITTEN = {".mcap": (".mcap",), ".db3": (".db3", ".mcap"), ".bag": (".bag",)}  # by what is stored


def new_recording(out: Path, topic: str, kind: str) -> Recording:
    """A recording of one topic of a standard type that is to be written: ROS 1's as .bag, else of
    ROS 2.
    """
    require(str(out), "formats", "rosbags")
    ros1 = out.suffix.lower() == ".bag"
    channel = Channel(topic, kind, "ros1" if ros1 else "cdr")
    return Recording(out, ".bag" if ros1 else ".db3", (channel,))


def check_ending(out: Path, recording: Recording) -> None:
    """Refuse a name for what is stored in another way."""
    endings = _WRITTEN[recording.storage]
    check(
        out.suffix.lower() in endings,
        f"{out}: a recording that is stored as {recording.storage} is written as a file: give "
        f"--out {' or '.join(str(out.with_suffix(ending)) for ending in endings)}.",
    )


def write_recording(out: Path, like: Recording, messages: Iterable[Message]) -> None:
    """Write messages in their order, with all times, and the channels of a recording with their
    definitions and qualities of service; of an .mcap also attachments and metadata.

    The file appears when it is whole. Messages of one time keep their order, except in a .bag,
    whose readers sort them by topic.
    """
    check_ending(out, like)
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.parent / f".{out.name}.part"
    shutil.rmtree(part, ignore_errors=True)  # of a killed writer
    part.mkdir()
    write = _write_mcap if like.storage == ".mcap" else _write_ros
    try:
        file = write(part, out, like, messages)
        with file.open("rb") as written:
            os.fsync(written.fileno())
        os.replace(file, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_mcap(part: Path, out: Path, like: Recording, messages: Iterable[Message]) -> Path:
    from mcap.writer import Writer

    file = part / out.name
    with file.open("wb") as stream:
        writer = Writer(stream, enable_data_crcs=True)
        writer.start(like.profile, "r2flow")
        # Each registration gives a new number, also of equal arguments.
        schemas: dict[tuple[str, str, bytes], int] = {}
        numbers: dict[str, int] = {}

        def number(channel: Channel) -> int:
            schema, known = channel.original
            key = repr((known, schema))
            if key not in numbers:
                described = (schema.name, schema.encoding, schema.data) if schema else None
                if described and described not in schemas:
                    schemas[described] = writer.register_schema(*described)
                numbers[key] = writer.register_channel(
                    known.topic,
                    known.message_encoding,
                    schemas[described] if described else 0,
                    known.metadata,
                )
            return numbers[key]

        for channel in like.channels:
            number(channel)
        for message in messages:
            times = message.recorded, message.data, message.published, message.sequence
            writer.add_message(number(message.channel), *times)
        for one in like.attachments():
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for one in like.metadata():
            writer.add_metadata(one.name, one.metadata)
        writer.finish()
    return file


def _write_ros(part: Path, out: Path, like: Recording, messages: Iterable[Message]) -> Path:
    from rosbags import rosbag1, rosbag2

    ending = out.suffix.lower()
    writer: Any
    if ending == ".bag":
        writer = rosbag1.Writer(part / out.name)
    else:
        plugins = rosbag2.StoragePlugin
        plugin = plugins.MCAP if ending == ".mcap" else plugins.SQLITE3
        writer = rosbag2.Writer(part / "recording", version=_VERSION, storage_plugin=plugin)
        if plugin == plugins.MCAP:
            writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    connections: dict[Any, Any] = {}
    with writer:

        def connection(channel: Channel) -> Any:
            known = channel.original
            key = channel.topic, channel.kind, repr(known and (known.digest, known.ext))
            if key not in connections:
                kind = known.msgtype if known else channel.kind.replace("/", "/msg/")
                more = known.ext._asdict() if known else {}
                connections[key] = writer.add_connection(
                    channel.topic, kind, **_definition(channel), **more
                )
            return connections[key]

        for channel in like.channels:
            connection(channel)
        for message in messages:
            writer.write(connection(message.channel), message.recorded, message.data)
    if ending == ".bag":
        return part / out.name
    return part / "recording" / f"recording{ending}"


def _definition(channel: Channel) -> dict[str, Any]:
    """The definition of a type and its hash, which recordings before ROS 2 Iron do not store."""
    known = channel.original
    store = type_store(channel.encoding)
    if not known or (not known.digest and known.msgtype in store.types):
        return {"typestore": store}
    digest = "md5sum" if channel.encoding == "ros1" else "rihs01"
    return {"msgdef": known.msgdef.data, digest: known.digest or " "}  # rosbags takes no empty hash
