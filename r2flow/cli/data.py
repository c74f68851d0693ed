"""`r2flow simulate`, `prepare`, `sensor` and `unpack`: sources of scans."""

import logging
import re
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.options import (
    ColumnsOption,
    OutOption,
    ReadingOptions,
    SensorOption,
    SizeOption,
    cores,
    grouped,
    named_columns,
    rows_and_columns,
)
from r2flow.errors import InputError, check

log = logging.getLogger(__name__)


@app.command(epilog="Example: r2flow simulate --num 1000 --sensor os1_64 --seed 1 --out scans --labels")
def simulate(
    out: OutOption,
    num: Annotated[int, typer.Option(min=1, help="Number of scans.")] = 100,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    seed: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Scan i depends only on the seed and i.")] = 0,
    format: Annotated[str, typer.Option(help="Formats, of bin,ply,pcd,npy (range images).")] = "bin",
    labels: Annotated[bool, typer.Option("--labels", help="Write SemanticKITTI .label files.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one per core.")] = None,
) -> None:
    """Simulate scans of street scenes. The same command resumes an interrupted run."""
    from r2flow.lidar.sensors import named_sensor
    from r2flow.progress import Bar
    from r2flow.simulator.folder import SimulatedFolder

    formats = tuple(dict.fromkeys(format.split(",")))
    folder = SimulatedFolder(out, named_sensor(sensor, rows_and_columns(size)), seed, formats, labels)
    folder.begin()
    missing = folder.missing(range(num))
    with Bar("simulating", len(missing), "scans") as advance:
        folder.make(missing, folder.simulate, workers or cores(), lambda scan: advance())
    made, there = len(missing), num - len(missing)
    kept = f", {there} there already" if there else ""
    print(f"{made} scan{'s' * (made != 1)} ({', '.join(formats)}{', labels' * labels}) in {out}{kept}")


@app.command(epilog="Example: r2flow prepare kitti_360:/data/KITTI-360 --out prepared/kitti_360")
@grouped
def prepare(
    reading: ReadingOptions,
    scans: Annotated[str, typer.Argument(help="A folder of scans, or LAYOUT:FOLDER: kitti_360:/data/KITTI-360.")],
    out: OutOption,
    split: Annotated[str | None, typer.Option(help="Part of the standard split. Default: all.")] = None,
    drives: Annotated[str | None, typer.Option(help="Names or numbers, separated by commas. Default: all.")] = None,
    on_bad_scan: Annotated[
        Literal["error", "skip"], typer.Option(help="skip: leave out unusable scans and list their names.")
    ] = "error",
    shard_scans: Annotated[int, typer.Option(min=1, help="Scans per shard.")] = 64,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes. Default: one per core.")] = None,
) -> None:
    """Project a data set into shards for training: range in 2 bytes, reflectance in 1.

    The same command resumes an interrupted run, shares the work with others at the same time and replaces damaged
    shards. Train on them with python train.py data=prepared data.root=FOLDER.
    """
    from r2flow.data import prepared
    from r2flow.data.opening import SOURCES, parse

    options, file = parse(scans)
    check(file is None, f"{scans} is one scan; give the folder of a data set.")
    options = replace(options, split=split, drives=[*drives.split(",")] if drives else None)
    drives_found = SOURCES[options.name].find_drives(options)
    check(out.resolve() != options.folder.resolve(), f"{out} holds the scans: give another folder by --out.")
    store = prepared.plan_files(out, options.name, options.folder, drives_found, reading.reading([scans]), shard_scans)
    left_out, made = prepared.prepare(store, on_bad_scan, workers or cores())
    shards, levels = len(store.shards), store.described["levels"]
    size = sum(store.files(shard)[0].stat().st_size for shard in store.shards)
    usable, there = len(store.names) - left_out, shards - len(made)
    content = f"{usable} scan{'s' * (usable != 1)} in {shards} shard{'s' * (shards != 1)}"
    kept = f" ({there} there already)" if there else ""
    reflectance = "no reflectance in the scans" if levels is None else f"reflectance as n/{levels}"
    skipped = f"; {left_out} scan{'s' * (left_out != 1)} left out" if left_out else ""
    print(f"{out}: {content}{kept}, {size / 2**20:.1f} MiB; {reflectance}{skipped}")


@app.command(epilog="Example: r2flow sensor my/scans --out conf/sensor/mine.yaml")
def sensor(
    scans: Annotated[list[Path], typer.Argument(help="Scan files or folders, all of one sensor.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="YAML file to write. Default: print only.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    columns: ColumnsOption = None,
    most: Annotated[int, typer.Option("--num", min=1, help="Maximum number of scans to read per folder.")] = 8,
) -> None:
    """Estimate a sensor from scans (beams, resolution, range limits, height, reflectance) and write it as YAML.

    Pass the file to other verbs (--sensor mine.yaml), or place it in conf/sensor/ for train.py (sensor=mine).
    """
    from r2flow.data.sources import warn_of_frame
    from r2flow.lidar.estimation import estimate_sensor, nearest_sensor
    from r2flow.lidar.scan_files import points_beside, read_points
    from r2flow.lidar.sensors import ENDINGS, SENSORS, write_sensor
    from r2flow.progress import track
    from r2flow.reports.tables import print_table
    from r2flow.reports.view.panels import scans_of

    if out is not None and (out.suffix.lower() not in ENDINGS or out.is_dir()):
        raise InputError(f"--out must be a .yaml file, as for --sensor; found {out}.")
    check(overwrite or not (out and out.exists()), f"{out} exists; give another --out, or --overwrite to replace it.")
    name = re.sub(r"\W", "_", out.stem, flags=re.ASCII) if out is not None else "mine"
    name = f"my_{name}" if name in SENSORS or not name[:1].isalpha() else name
    paths = [points_beside(path) for scan in scans for path in scans_of(scan, most)[0]]
    points = [read_points(path, named_columns(columns)) for path in track(paths, "reading", "scans", least=16)]
    mine, beams, steps, off, ground = estimate_sensor(points, name)
    e, middle = mine.elevations, len(mine.elevations) // 2
    shown = " ... ".join(f"{a:+.2f} {b:+.2f}" for a, b in (e[:2], e[middle - 1 : middle + 1], e[-2:]))
    nearest, distance = nearest_sensor(beams.elevations)
    scale = mine.reflectance_scale
    rows = [
        ("beams", f"{len(e)}: {beams.order}"),
        ("elevations", f"{shown} degrees; points lie {off:.2f} from their beams"),
        ("nearest sensor", f"{nearest}, its beams {distance:.2f} degrees off" if nearest else "no built-in sensor"),
        ("resolution", f"{steps:,.0f} steps a turn; images of {mine.columns} columns"),
        ("range seen", f"{mine.min_range:g} to {mine.max_range:g} m; raise min_range if the vehicle is visible"),
        ("height", f"{mine.height:.2f} m above the ground" if ground else f"not found, {mine.height:g} m assumed"),
        ("reflectance", "none: encoding.reflectance=false" if scale is None else f"reflectance_scale={scale:g}"),
    ]
    print_table(rows, ("", ""))
    warn_of_frame(paths[0], points)
    if out is not None:
        write_sensor(mine, out, f"Estimated from {len(points)} scan(s), stored {beams.order}.")
        print(out)


@app.command(epilog="Example: r2flow unpack drive.mcap --topic /ouster/points --out scans")
def unpack(
    recording: Annotated[Path, typer.Argument(help="A .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.")],
    out: OutOption,
    topic: Annotated[str | None, typer.Option(help="Topic of the point clouds, required if several.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every Nth message.")] = 1,
    most: Annotated[int | None, typer.Option("--num", min=1, help="Maximum number of scans to write.")] = None,
) -> None:
    """Write the PointCloud2 messages of a recording as scan files, named by time in ns.

    The time is header.stamp, if 0 that of recording. The files contain x, y, z and, if present, intensity and ring.
    """
    from r2flow.lidar.bags import read_bag
    from r2flow.lidar.scan_files import read_points, write_points
    from r2flow.progress import track

    stamps = Counter[int]()
    read = track(read_bag(recording, topic), "unpacking", "scans", most or 0)
    for stamp, points in islice(read, 0, None, every):
        if isinstance(points, InputError):
            log.warning("left out: %s", points)
            continue
        stamps[stamp] += 1
        again = f"-{stamps[stamp]}" if stamps[stamp] > 1 else ""  # distinct names for clouds of the same time
        points = points.with_lost_rays()
        file = out / f"{stamp:019d}{again}.ply"
        same = not file.exists() or read_points(file).xyz.tobytes() == points.xyz.tobytes()  # as after a stop
        check(same, f"{file} holds other points: give another folder by --out.")
        write_points(file, points.xyz, points.reflectance, points.ring)
        if stamps.total() == most:
            break
    check(stamps, f"{recording} contains no usable scan.")
    print(f"{stamps.total()} scan{'s' * (stamps.total() > 1)} in {out}")
