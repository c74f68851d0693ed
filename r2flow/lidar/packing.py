"""Recordings as folders of scan files, and back."""

import logging
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from r2flow.base.errors import InputError, check
from r2flow.base.progress import track
from r2flow.lidar.bag_writers import new_recording, write_recording
from r2flow.lidar.bags import Message, read_bag
from r2flow.lidar.point_cloud2 import CLOUD, written
from r2flow.lidar.scan_files import Cloud, read_cloud, scan_ending, write_cloud

_log = logging.getLogger(__name__)

_FRAME = "frame_id "  # before it in a comment of a .ply
_SECOND = 10**9
_BEFORE = 10**19  # is added to times before 1970, so that names sort by time


def unpack(
    recording: Path,
    out: Path,
    topic: str | None = None,
    every: int = 1,
    most: int | None = None,
) -> int:
    """Write the clouds of a topic as `TIME.ply` with all their fields; their number.

    TIME is that of `read_bag`, `-` and TIME + 10^19 before 1970; a second cloud of the same time is
    `TIME_000002.ply`, so that names sort as the recording does. `frame_id` is a comment of the
    file. Fields of several numbers, which a .ply cannot hold, make it a .pcd.
    """
    stamps = Counter[int]()
    scans = track(read_bag(recording, topic), "unpacking", "scans", most or 0)
    for stamp, scan in islice(scans, 0, None, every):
        try:
            if isinstance(scan, InputError):
                raise scan
            scan.cloud.points()  # other verbs read it
        except InputError as error:
            _log.warning("left out: at %d: %s", stamp, error)
            continue
        stamps[stamp] += 1
        cloud = scan.cloud
        ending = ".pcd"
        if all(column.ndim == 1 for column in cloud.columns):
            ending = ".ply"
            cloud = replace(cloud, header=(f"{_FRAME}{scan.frame}",))
        file = out / f"{_name(stamp, stamps[stamp])}{ending}"
        if file.exists() and read_cloud(file).array().tobytes() != cloud.array().tobytes():
            raise InputError(f"{file} holds other points: give another folder by --out.")
        write_cloud(file, cloud)
        if stamps.total() == most:
            break
    check(stamps, f"{recording} contains no usable scan.")
    return stamps.total()


def pack(
    paths: Sequence[Path],
    out: Path,
    topic: str = "/points",
    frame: str | None = None,
    rate: float | None = None,
    columns: Sequence[str] | None = None,
) -> None:
    """Write scan files, with all their fields, as the PointCloud2 messages of a new .mcap or .db3
    of ROS 2 or .bag of ROS 1.

    Args:
        paths: Files in the order of time.
        frame: `header.frame_id`; None: that of each file, else "lidar".
        rate: Scans a second, from second 1; None: the times are the names, as `unpack` writes them.

    Raises:
        InputError: A name is no time, a field has a type that a PointCloud2 cannot hold, or `out`
            exists.
    """
    check(not out.exists(), f"{out} exists; give another --out.")
    recording = new_recording(out, topic, CLOUD)
    (channel,) = recording.channels

    def messages() -> Iterator[Message]:
        for number, path in enumerate(track(paths, "packing", "scans")):
            stamp = _SECOND + round(_SECOND * number / rate) if rate else _time(path)
            cloud = read_cloud(path, columns)
            data = written(cloud, stamp, frame or _frame(cloud), channel.encoding)
            yield Message(channel, max(stamp, 0), data)

    write_recording(out, recording, messages())


def _name(stamp: int, number: int) -> str:
    time = f"-{_BEFORE + stamp:019d}" if stamp < 0 else f"{stamp:019d}"
    return f"{time}_{number:06d}" if number > 1 else time


def _time(path: Path) -> int:
    name = path.name.removesuffix(scan_ending(path.name))
    found = re.fullmatch(r"(-?)(\d{19})(_\d+)?", name)
    if found is None:
        raise InputError(
            f"{path.name} is no time in nanoseconds; give the scans a second by --rate 10."
        )
    return int(found[2]) - _BEFORE * (found[1] == "-")


def _frame(cloud: Cloud) -> str:
    comments = cloud.header if isinstance(cloud.header, tuple) else ()
    frames = [one.removeprefix(_FRAME) for one in comments if one.startswith(_FRAME)]
    return frames[0] if frames else "lidar"
