"""`r2flow unpack`: the scans of a recording as files."""

import logging
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import OutOption
from r2flow.errors import InputError

log = logging.getLogger(__name__)


@app.command(epilog="Example: r2flow unpack drive.mcap --topic /ouster/points --out scans")
def unpack(
    recording: Annotated[Path, typer.Argument(help="A .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.")],
    out: OutOption,
    topic: Annotated[str | None, typer.Option(help="Topic of the point clouds, where there are several.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take one message of so many.")] = 1,
    most: Annotated[
        int | None, typer.Option("--num", min=1, help="The most scans to write.", show_default=False)
    ] = None,
) -> None:
    """Write the PointCloud2 messages of a recording as scan files, named by their time in ns.

    They hold x, y, z and, where the messages do, intensity and ring.
    """
    from r2flow.lidar.bags import read_bag
    from r2flow.lidar.scan_files import write_points
    from r2flow.progress import track

    written, stamps = 0, Counter[int]()
    for number, (stamp, points) in enumerate(track(read_bag(recording, topic), "unpacking", "scans", most or 0)):
        if number % every:
            continue
        if isinstance(points, InputError):
            log.warning("left out: %s", points)
            continue
        stamps[stamp] += 1
        again = f"-{stamps[stamp]}" if stamps[stamp] > 1 else ""  # clouds of one time keep apart
        points = points.with_lost_rays()
        write_points(out / f"{stamp:019d}{again}.ply", points.xyz, points.reflectance, points.ring)
        written += 1
        if written == most:
            break
    if not written:
        raise InputError(f"{recording} holds no scan that could be written.")
    print(f"{written} scans in {out}")
