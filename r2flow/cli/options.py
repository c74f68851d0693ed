"""Options that several verbs share, and what becomes of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.lidar.sensors import Sensor

CheckpointOption = Annotated[
    Path, typer.Option("--checkpoint", "-c", help="A checkpoint file or a run folder.", show_default=False)
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)]
SensorOption = Annotated[str, typer.Option(help="Name of the sensor, or the YAML file of your own (r2flow sensor).")]
SizeOption = Annotated[str | None, typer.Option(help="Rows x columns, as 64x1024; the sensor's own if left out.")]
ProjectionOption = Annotated[str, typer.Option(help="spherical or unfolding.")]
ConventionOption = Annotated[str, typer.Option(help="centre, or reference for the published models'.")]
ScaleOption = Annotated[float, typer.Option(min=1e-6, help="Value in the file that means full reflectance, often 255.")]


def build_sized(sensor: str, size: str | None) -> "Sensor":
    """The sensor of a name or a YAML file, at an image size written as 64x1024."""
    from r2flow.lidar.sensor_files import ENDINGS, read_sensor
    from r2flow.lidar.sensors import build_sensor

    rows, columns = _rows_and_columns(size)
    if sensor.lower().endswith(ENDINGS):
        return read_sensor(sensor, rows, columns)
    return build_sensor(sensor, rows, columns)


def _rows_and_columns(size: str | None) -> tuple[int | None, int | None]:
    if size is None:
        return None, None
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--size must be ROWSxCOLUMNS, as 64x1024; found {size!r}.")
    return int(parts[0]), int(parts[1])


def choose_device(name: str) -> str:
    """`auto` takes a GPU where there is one."""
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.device(name)
    except RuntimeError:
        raise InputError(f"--device must be auto, cpu, cuda, cuda:1, ...; found {name!r}.") from None
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"--device {name}, but torch sees no GPU here; use --device cpu.")
    return name
