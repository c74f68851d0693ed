"""Options that several verbs share, and what becomes of them; a dataclass of options is one parameter of a verb."""

import inspect
import math
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from r2flow.devices import choose_device as choose_device  # for every verb
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.lidar.sensors import Sensor
    from r2flow.model.checkpoint import Checkpoint

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
    typer.Option(min=1e-6, max=1e9, help="Value in scan files that means full reflectance; the usual one if left out."),
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


def grouped(verb: Callable[..., None]) -> Callable[..., None]:
    """Let typer see every field of a verb's dataclass parameters as an option of its own.

    @app.command()
    @grouped
    def evaluate(real: str, reading: ReadingOptions) -> None: ...   # r2flow evaluate REAL --sensor vlp16 --size 16x512
    """
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for name, positional in inspect.signature(verb).parameters.items():
        parameter = positional.replace(kind=positional.KEYWORD_ONLY, annotation=hints[name])
        if not is_dataclass(hints[name]):
            parameters.append(parameter)
            continue
        groups[name] = hints[name]
        types = get_type_hints(hints[name], include_extras=True)
        for one in fields(groups[name]):
            default = parameter.empty if one.default is MISSING else one.default
            parameters.append(parameter.replace(name=one.name, default=default, annotation=types[one.name]))

    @wraps(verb)
    def call(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{one.name: given.pop(one.name) for one in fields(group)})
        verb(**given)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


@dataclass(frozen=True)
class ReadingOptions:
    """How scans become images: as the flow or the prepared scans say where an option is left out."""

    sensor: SensorChoice = None
    size: SizeOption = None
    projection: Annotated[Literal["spherical", "unfolding"] | None, typer.Option(help="Usual: spherical.")] = None
    convention: Annotated[
        Literal["centre", "reference"] | None,
        typer.Option(help="Usual: centre; reference is that of the published models."),
    ] = None
    reflectance_scale: ScaleChoice = None
    columns: ColumnsOption = None

    def reading(self, specs: Sequence[str | None], model: "Checkpoint | None" = None) -> "Reading":
        """`reading_for` these scans and this model with the options that are given."""
        from r2flow.data.opening import reading_for

        return reading_for(
            specs, model, self.sensor, rows_and_columns(self.size), self.projection, self.convention,
            self.reflectance_scale, named_columns(self.columns),
        )  # fmt: skip


@dataclass(frozen=True)
class WorkOptions:
    """How the work is done; the figures do not depend on it."""

    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 8
    workers: Annotated[int, typer.Option(min=0, help="Further processes that read scans.")] = 2
    device: DeviceOption = "auto"


@dataclass(frozen=True)
class SamplerOptions:
    """How a generator is run: by its own sampler where an option is left out."""

    sampler: Annotated[
        str | None,
        typer.Option(
            help="NAME or NAME:FIELD=VALUE:...: adams2-4, euler, midpoint, heun2-3, rk4, ab2; adaptive: dopri5, "
            "auto, torchdiffeq; with fresh noise: sde; of flow maps: jump, chord, renoise; to complete: mmps, replace, "
            "repaint. Other systems have their own (docs/systems.md)."
        ),
    ] = None
    steps: Annotated[int | None, typer.Option(min=1, help="Steps from noise to data, of fixed steps.")] = None
    tolerance: Annotated[float | None, typer.Option(help="Largest error of a step, of an adaptive sampler.")] = None
    grid: Annotated[
        str | None, typer.Option(help="Where fixed steps fall: uniform, power:P or power-start:P, as power:1.75.")
    ] = None

    @property
    def given(self) -> dict[str, Any]:
        """Name and fields that were given, as `Generator.choose` takes them."""
        from r2flow.samplers import parse_sampler

        fields = {"steps": self.steps, "tolerance": self.tolerance, "grid": self.grid}
        given = {**(parse_sampler(self.sampler) if self.sampler else {}), **fields}
        return {key: value for key, value in given.items() if value is not None}


@dataclass(frozen=True)
class DrawOptions:
    """Which scans are drawn, and on what device."""

    num: Annotated[int, typer.Option(min=1, help="How many scans.")] = 4
    seed: Annotated[int, typer.Option(min=0, help="Scan i depends on the seed and on i alone.")] = 0
    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 1
    device: DeviceOption = "auto"


def numbers(option: str, text: str, kind: type = float) -> list[Any]:
    """'4,8' as [4, 8]."""
    try:
        values = [kind(part) for part in text.split(",")]
    except ValueError:
        values = [0]
    if not all(0 < value < math.inf for value in values):
        raise InputError(f"--{option} must be positive numbers separated by commas, found {text!r}.")
    return values


def command() -> str:
    """The command as it was typed, for a shell."""
    return shlex.join(["r2flow", *sys.argv[1:]])
