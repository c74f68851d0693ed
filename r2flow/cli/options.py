"""Options that several verbs share, and what becomes of them."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from r2flow.devices import choose_device as choose_device  # for every verb
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.lidar.sensors import Sensor

CheckpointOption = Annotated[
    Path, typer.Option("--checkpoint", "-c", help="A checkpoint file, a run folder or a model.", show_default=False)
]
DeviceOption = Annotated[str, typer.Option(help="Where to compute: auto, cpu, cuda, cuda:1, ...")]
PrecisionOption = Annotated[
    Literal["32-true", "bf16-mixed"],
    typer.Option(help="Precision of the network; bf16-mixed is faster where there is bfloat16."),
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)]
SensorOption = Annotated[str, typer.Option(help="Name of the sensor, or the YAML file of your own (r2flow sensor).")]
SizeOption = Annotated[str | None, typer.Option(help="Rows x columns, as 64x1024; the sensor's own if left out.")]
SETS = "a folder of scans, samples, a run, prepared shards, NAME:FOLDER, simulated:SEED"
SensorChoice = Annotated[
    str | None, typer.Option(help="Name of the sensor; that of the flow or the scans, or hdl64e, if left out.")
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
    from r2flow.data.opening import named_sensor

    return named_sensor(sensor, rows_and_columns(size))


def rows_and_columns(size: str | None) -> tuple[int, int] | None:
    """The numbers of an image size written as 64x1024."""
    if size is None:
        return None
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--size must be ROWSxCOLUMNS, as 64x1024; found {size!r}.")
    return int(parts[0]), int(parts[1])


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
