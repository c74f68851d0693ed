#!/usr/bin/env bash
# rosbags 0.11.9 reads an .mcap without message indexes as an empty recording, and says nothing.
#
# Message indexes are optional in MCAP: a chunk index may have an empty map of them ("An empty map
# indicates no message indexing is available"), and mcap's own writer has an option for it. mcap's
# reader finds the messages. rosbags lists the topic, says that it has 2 messages, and yields none:
# it chooses chunks by the message indexes alone. A loop over such a recording does nothing.
#
# Prints the versions and what each reader found; exits with 1 if that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check mcap==1.6.0 rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'END'
import sys
from importlib.metadata import version
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from rosbags.rosbag2 import Reader

for package in ("mcap", "rosbags"):
    print(package, version(package))


def read(index_types):
    """Numbers of messages: by mcap's reader, announced by rosbags, yielded by rosbags."""
    path = Path("two.mcap")
    with path.open("wb") as stream:
        writer = Writer(stream, index_types=index_types)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/text", "cdr", schema)
        for time in range(2):
            text = b"\0\1\0\0" + b"\3\0\0\0hi\0"  # CDR of the string "hi"
            writer.add_message(channel, time, text, time)
        writer.finish()
    with path.open("rb") as stream:
        by_mcap = sum(1 for _ in make_reader(stream).iter_messages())
    with Reader(path) as reader:
        announced = reader.message_count
        yielded = sum(1 for _ in reader.messages())
    return by_mcap, announced, yielded


whole = read(IndexType.ALL)
without = read(IndexType.CHUNK)
print("                         mcap  rosbags announces  rosbags yields")
print("with message indexes     {:>4}  {:>17}  {:>14}".format(*whole))
print("without message indexes  {:>4}  {:>17}  {:>14}".format(*without))
sys.exit(whole != (2, 2, 2) or without != (2, 2, 0))
END
