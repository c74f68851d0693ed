"""Completed recordings: a part for each cloud, which a stopped command keeps, then the whole."""

import hashlib
import json
import logging
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.base.errors import InputError, check
from r2flow.base.files import read_json, write_file
from r2flow.base.progress import Bar, track
from r2flow.lidar.bag_writers import check_ending, write_recording
from r2flow.lidar.bags import Message, Recording, choose_topic, open_recording
from r2flow.lidar.point_cloud2 import CLOUD
from r2flow.lidar.scan_files import Cloud
from r2flow.store import Store

_log = logging.getLogger(__name__)

_Completion = Callable[[Cloud, int], Cloud]  # of a cloud and its number in the topic

_SAMPLE = 1 << 20  # bytes at both ends of a file that identify it; an .mcap ends with its index


def complete_recording(
    path: Path,
    out: Path,
    topic: str | None,
    everything: bool,
    complete: _Completion,
    recipe: dict[str, Any],
) -> float:
    """Write a recording whose clouds of a topic are completed, with their headers; print counts and
    return the new points a cloud, NaN if it is there already.

    Clouds that cannot be completed, as empty ones, stay as they are, with a line. `out` appears
    when it is whole, beside it `OUT.json` with the settings; parts are in `OUT.parts` until then.

    Args:
        everything: Keep all other topics, attachments and metadata unchanged.
        recipe: All else that answers depend on.

    Raises:
        InputError: No cloud can be completed, or `out` is of other settings.
    """
    with open_recording(path) as recording:
        topic = choose_topic(recording, topic)
        of_topic = [channel for channel in recording.channels if channel.topic == topic]
        kept = recording
        if not everything:
            kept = replace(recording, channels=tuple(of_topic), attachments=tuple, metadata=tuple)
        check_ending(out, kept)
        recipe = {
            **recipe, "recording": _identity(path), "topic": topic, "everything": everything
        }  # fmt: skip
        store = Store(out.with_name(f"{out.name}.parts"), "completed clouds", recipe)
        notes = out.with_name(f"{out.name}.json")
        if out.exists():
            same = notes.is_file() and read_json(notes).get("recipe") == store.described
            check(same, f"{out} exists and is of other settings; give another --out.")
            print(f"{out} is there already")
            return math.nan
        count = sum(channel.count for channel in of_topic if channel.kind == CLOUD)
        store.begin()
        done, added = _make_parts(recording, topic, complete, store, count)
        write_file(notes, json.dumps({"recipe": store.described, "completed": done}, indent=1))
        total = count if not everything else sum(one.count for one in recording.channels)
        messages = _replaced(recording, None if everything else topic, topic, store)
        write_recording(out, kept, track(messages, "writing", "messages", total))
        shutil.rmtree(store.folder)
    new = added / done
    print(f"{out}: {done} of {count} clouds of {topic} completed, {new:,.0f} new points a cloud")
    return new


def _make_parts(
    recording: Recording, topic: str, complete: _Completion, store: Store, count: int
) -> tuple[int, int]:
    """Complete the clouds that no part holds; the numbers of completed clouds and of new points."""
    done = added = 0
    wrong: tuple[int, InputError] | None = None  # of the first cloud that stays as it is
    first: tuple[Cloud, int] | None = None  # of a part
    decided = False  # whether the sensor is, which the first cloud decides for all
    with Bar("completing", count, "clouds") as advance:
        for number, (message, scan) in enumerate(recording.scans(topic)):
            digest = hashlib.sha256(message.data).hexdigest()
            if store.has(number) and store.head(number)["input"] == digest:
                new = store.head(number)["added"]
                if not isinstance(scan, InputError):
                    first = first or (scan.cloud, number)
            else:
                try:
                    if isinstance(scan, InputError):
                        raise scan
                    if first and not decided:
                        complete(*first)
                    decided = True
                    cloud = complete(scan.cloud, number)
                    data = scan.replaced(cloud)
                except InputError as error:
                    wrong = wrong or (message.recorded, error)
                    advance()
                    continue
                new = len(cloud) - len(cloud.measured())
                part = {"message": np.frombuffer(data, np.uint8)}
                store.write(number, part, {"input": digest, "added": new})
            done += 1
            added += new
            advance()
    if not done:
        shutil.rmtree(store.folder)
        raise wrong[1] if wrong else InputError(f"{recording.path} has no cloud in {topic}.")
    if wrong:
        _log.warning("clouds left as they are: %d; the first, at %d: %s", count - done, *wrong)
    return done, added


def _replaced(
    recording: Recording, read: str | None, topic: str, store: Store
) -> Iterator[Message]:
    """The messages of a recording, with the parts in the place of the clouds they complete."""
    number = 0
    for message in recording.messages(read):
        if message.channel.topic == topic and message.channel.kind == CLOUD:
            if store.has(number):
                data = store.read(number)[0]["message"].tobytes()
                message = message._replace(data=data)
            number += 1
        yield message


def _identity(path: Path) -> dict[str, str]:
    """Of each file of a recording, its size and the digest of both ends."""
    found = {}
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            begin = stream.read(_SAMPLE)
            size = stream.seek(0, 2)
            stream.seek(max(0, size - _SAMPLE))
            end = stream.read()
        found[file.name] = f"{size} {hashlib.sha256(begin + end).hexdigest()[:16]}"
    return found
