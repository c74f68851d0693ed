"""Options that several verbs share, and what becomes of them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.devices import choose_device as choose_device  # for every verb
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.lidar.sensors import Sensor

CheckpointOption = Annotated[
    Path, typer.Option("--checkpoint", "-c", help="A checkpoint file, a run folder or a model.", show_default=False)
]
DeviceOption = Annotated[str, typer.Option(help="Where to compute: auto, cpu, cuda, cuda:1, ...")]
PrecisionOption = Annotated[
    str | None, typer.Option(help="Of the network: 32-true or, faster where there is bfloat16, bf16-mixed.")
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)]
SensorOption = Annotated[str, typer.Option(help="Name of the sensor, or the YAML file of your own (r2flow sensor).")]
SizeOption = Annotated[str | None, typer.Option(help="Rows x columns, as 64x1024; the sensor's own if left out.")]
ProjectionOption = Annotated[str, typer.Option(help="spherical or unfolding.")]
SurfacesOption = Annotated[
    bool,
    typer.Option("--surfaces/--no-surfaces", help="Move answers to the surfaces that measured returns lie on."),
]
SETS = "a folder of scans, samples, a run, prepared shards, NAME:FOLDER, simulated:SEED"
SensorChoice = Annotated[
    str | None, typer.Option(help="Name of the sensor; that of the flow or the scans, or hdl64e, if left out.")
]
ProjectionChoice = Annotated[
    str | None, typer.Option(help="spherical or unfolding; that of the flow or the scans, or spherical, if left out.")
]
ConventionChoice = Annotated[
    str | None,
    typer.Option(
        help="centre, or reference for the published models'; that of the flow or the scans, or centre, if left out."
    ),
]
ScaleChoice = Annotated[
    float | None,
    typer.Option(
        min=1e-6, max=1e9, help="Value in scan files that means full reflectance; the sensor's, else their usual one."
    ),
]

ColumnsOption = Annotated[
    str | None,
    typer.Option(
        help="What the columns of files without names hold, as x,y,z,intensity,_; the usual ones if left out."
    ),
]


def named_columns(text: str | None) -> tuple[str, ...] | None:
    """The columns that are named by `--columns`, checked."""
    from r2flow.lidar.scan_files import check_columns

    columns = None if text is None else tuple(name.strip() for name in text.split(","))
    check_columns(columns)
    return columns


def build_sized(sensor: str, size: str | None) -> "Sensor":
    """The sensor of a name or a YAML file, at an image size written as 64x1024."""
    from r2flow.lidar.sensor_files import ENDINGS, read_sensor
    from r2flow.lidar.sensors import build_sensor

    rows, columns = rows_and_columns(size)
    if sensor.lower().endswith(ENDINGS):
        return read_sensor(sensor, rows, columns)
    return build_sensor(sensor, rows, columns)


def choose_reading(
    specs: Sequence[str | Path | None],
    sensor: str | None = None,
    size: str | None = None,
    projection: str | None = None,
    convention: str | None = None,
    reflectance_scale: float | None = None,
    columns: str | None = None,
    flow: "Reading | None" = None,
) -> "Reading":
    """How named scans become images of one sensor: as asked for; else as a flow's or one of theirs were; else usual.

    Args:
        specs: Names of scans, as for `open_scans`; None is passed over.
        flow: That of the flow that the scans are compared with.

    Raises:
        InputError: an unknown name, or another sensor or size than the flow's.
    """
    from r2flow.data.opening import own_reading, parse, refuse_other_samples, usual_reading, usual_scale
    from r2flow.data.options import FOLDER

    named = [spec for spec in specs if spec is not None]
    own = [reading for spec in named if (reading := own_reading(spec)) is not None]
    usual = usual_reading(named[0])
    found = flow or next(iter(own), None) or usual
    if flow is not None and (sensor is not None or size is not None):
        chosen = build_sized(sensor or flow.sensor.name, size)
        if chosen.shape != flow.sensor.shape:
            asked, there = ("x".join(map(str, one.shape)) for one in (chosen, flow.sensor))
            raise InputError(f"the flow's images are {there}, not {asked}; leave --sensor and --size out.")
        if chosen.elevations != flow.sensor.elevations:
            raise InputError(f"the flow looks through {flow.sensor.name}, not {chosen.name}; leave --sensor out.")
    elif sensor is not None:
        found = replace(found, sensor=build_sized(sensor, size))
    elif size is not None:
        found = replace(found, sensor=found.sensor.resized(*rows_and_columns(size)))
    check_words(projection=projection, convention=convention)
    for spec in named:  # before anything is read
        options, _ = parse(str(spec))
        if options.name == FOLDER:
            refuse_other_samples(Path(options.folder), found.sensor)
    scale = usual_scale(named[0], found.sensor) if reflectance_scale is None else reflectance_scale
    found = replace(found, reflectance_scale=scale, columns=named_columns(columns))
    asked_for = {"projection": projection, "convention": convention}
    return replace(found, **{key: value for key, value in asked_for.items() if value is not None})  # type: ignore[arg-type]


def check_words(**options: str | None) -> None:
    """Check options that are one of a few words each, where they are given.

    Raises:
        InputError: another word.
    """
    from r2flow.lidar.projection import CONVENTIONS, PROJECTIONS

    known = {"projection": PROJECTIONS, "convention": CONVENTIONS, "on_bad_scan": ("error", "skip")}
    for option, value in options.items():
        if value is not None and value not in known[option]:
            words = ", ".join(known[option])
            raise InputError(f"--{option.replace('_', '-')} must be one of {words}; found {value!r}.")


def rows_and_columns(size: str | None) -> tuple[int | None, int | None]:
    """The numbers of an image size written as 64x1024; of no size, None for both."""
    if size is None:
        return None, None
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--size must be ROWSxCOLUMNS, as 64x1024; found {size!r}.")
    return int(parts[0]), int(parts[1])


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
