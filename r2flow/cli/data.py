"""`r2flow simulate`, `prepare`, `sensor` and `unpack`: sources of scans."""

import re
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from r2flow.base.errors import InputError
from r2flow.cli.app import app
from r2flow.cli.options import (
    ColumnsOption,
    MostOption,
    OutOption,
    ReadingOptions,
    SeedOption,
    SensorOption,
    SizeOption,
    SplitOption,
    TopicOption,
    WorkersOption,
    cores,
    grouped,
    several,
)


@app.command(
    rich_help_panel="Data",
    epilog="Example: r2flow simulate --num 1000 --sensor os1_64 --seed 1 --out scans --labels",
)
def simulate(
    out: OutOption,
    num: Annotated[int, Option(min=1, help="Number of scans.")] = 100,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    seed: SeedOption = 0,
    format: Annotated[str, Option(help="Formats, of bin,ply,pcd,npy (range images).")] = "bin",
    labels: Annotated[bool, Option("--labels", help="Write SemanticKITTI .label files.")] = False,
    workers: WorkersOption = None,
) -> None:
    """Simulate scans of street scenes. The same command resumes an interrupted run."""
    from r2flow.base.progress import Bar
    from r2flow.lidar.sensors import named_sensor
    from r2flow.simulator.folder import SimulatedFolder

    formats = tuple(dict.fromkeys(format.split(",")))
    folder = SimulatedFolder(out, named_sensor(sensor, size), seed, formats, labels)
    folder.begin()
    missing = folder.missing(range(num))
    with Bar("simulating", len(missing), "scans") as advance:
        folder.make(missing, folder.simulate, workers or cores(), lambda scan: advance())
    kept = f", {num - len(missing)} there already" if len(missing) < num else ""
    print(f"{several(len(missing))} ({', '.join(formats)}) in {out}{kept}")


@app.command(
    rich_help_panel="Data",
    epilog="Example: r2flow prepare kitti_360:/data/KITTI-360 --out prepared/kitti_360",
)
@grouped
def prepare(
    reading: ReadingOptions,
    scans: Annotated[
        str,
        Argument(help="A folder of scans, or LAYOUT:FOLDER: kitti_360:/data/KITTI-360."),
    ],
    out: OutOption,
    split: SplitOption = None,
    drives: Annotated[
        str | None, Option(help="Names or numbers, separated by commas. Default: all.")
    ] = None,
    on_bad_scan: Annotated[
        Literal["error", "skip"],
        Option(help="skip: leave out unusable scans and list their names."),
    ] = "error",
    shard_scans: Annotated[int, Option(min=1, help="Scans per shard.")] = 64,
    workers: WorkersOption = None,
) -> None:
    """Project a data set into shards for training: range in 2 bytes, reflectance and labels in 1.

    The same command resumes an interrupted run, shares the work with others at the same time and
    replaces damaged shards. Train on them with python train.py data=prepared data.root=FOLDER.
    """
    from r2flow.data import preparing
    from r2flow.data.described import describe

    described = describe(scans, split=split, drives=[*drives.split(",")] if drives else None)
    if described.file is not None:
        raise InputError(f"{scans} is one scan; give the folder of a data set.")
    store = preparing.plan(out, described, reading.reading([described]), shard_scans)
    left_out, made = preparing.prepare(store, on_bad_scan, workers or cores())
    size = sum(store.file(shard).stat().st_size for shard in store.shards)
    there = len(store.shards) - len(made)
    levels = store.described["levels"]
    notes = [
        f"{size / 2**20:.1f} MiB",
        f"reflectance as n/{levels}" if levels else "no reflectance",
    ]
    if store.reading.labels:
        notes.append("labels")
    if there:
        notes.append(f"{there} there already")
    if left_out:
        notes.append(f"{several(left_out)} left out")
    usable = several(len(store.names) - left_out)
    print(f"{out}: {usable} in {several(len(store.shards), 'shard')}, {', '.join(notes)}")


@app.command(
    rich_help_panel="Data", epilog="Example: r2flow sensor my/scans --out conf/sensor/mine.yaml"
)
def sensor(
    scans: Annotated[
        list[Path], Argument(help="Scan files, folders or NAME:FOLDER, all of one sensor.")
    ],
    out: Annotated[
        Path | None, Option("--out", "-o", help="YAML file to write. Default: print only.")
    ] = None,
    columns: ColumnsOption = None,
    most: MostOption = 8,
) -> None:
    """Estimate a sensor from scans (beams, resolution, range limits, height, reflectance) and write
    it as YAML.

    Pass the file to other verbs (--sensor mine.yaml), or place it in conf/sensor/ for train.py
    (sensor=mine).
    """
    from r2flow.data.estimating import estimated_sensor
    from r2flow.lidar.sensors import ENDINGS, SENSORS
    from r2flow.reports.tables import print_table

    name = "mine"
    if out is not None:
        if out.suffix.lower() not in ENDINGS:
            raise InputError(f"--out must be a .yaml file, as for --sensor; found {out}.")
        name = re.sub(r"\W", "_", out.stem, flags=re.ASCII)
        if name in SENSORS or not name[0].isalpha():
            name = f"my_{name}"
    found = estimated_sensor(scans, name, columns, most)
    print_table(list(found.findings.items()), ("", ""))
    if out is not None:
        found.write(out)
        print(out)


@app.command(
    rich_help_panel="Data",
    epilog="Example: r2flow unpack drive.mcap --topic /ouster/points --out scans",
)
def unpack(
    recording: Annotated[
        Path, Argument(help="A .mcap, .db3 or .bag file, or the folder of a ROS 2 bag.")
    ],
    out: OutOption,
    topic: TopicOption = None,
    every: Annotated[int, Option(min=1, help="Take every Nth message.")] = 1,
    most: Annotated[
        int | None, Option("--num", min=1, help="Maximum number of scans to write.")
    ] = None,
) -> None:
    """Write the PointCloud2 messages of a recording as .ply files with all their fields, named by
    time in ns.

    The time is header.stamp, if 0 that of recording. r2flow pack makes a recording of the files.
    """
    from r2flow.lidar.packing import unpack as write

    print(f"{several(write(recording, out, topic, every, most))} in {out}")


@app.command(
    rich_help_panel="Data",
    epilog="Example: r2flow pack dense --topic /points --out dense.mcap",
)
def pack(
    scans: Annotated[
        list[Path], Argument(help="Scan files, folders or NAME:FOLDER, in the order of time.")
    ],
    out: Annotated[
        Path, Option("--out", "-o", help="A .mcap or .db3 of ROS 2, or a .bag of ROS 1.")
    ],
    topic: Annotated[str, Option(help="Topic of the messages.")] = "/points",
    frame: Annotated[
        str | None,
        Option(help="frame_id of the messages. Default: as unpacked, else lidar."),
    ] = None,
    rate: Annotated[
        float | None,
        Option(min=0.001, help="Scans a second. Default: times are names, as of r2flow unpack."),
    ] = None,
    columns: ColumnsOption = None,
) -> None:
    """Write scan files as the PointCloud2 messages of a recording, with all their fields."""
    from r2flow.data.described import describe
    from r2flow.lidar.packing import pack as write

    paths = [Path(path) for one in scans for path in describe(one).paths]
    write(paths, out, topic, frame, rate, columns)
    print(f"{several(len(paths))} in {out}")
