"""Options shared by verbs, and their parsing; a verb takes a dataclass of options as one parameter."""

import inspect
import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.data.reading import Reading
    from r2flow.model.checkpoint import Checkpoint

DeviceOption = Annotated[str, typer.Option(help="Device: auto, cpu, cuda, cuda:1, ...")]
PrecisionOption = Annotated[
    Literal["32-true", "bf16-mixed"],
    typer.Option(help="Precision of the network; bf16-mixed is faster on hardware with bfloat16."),
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")]
SensorOption = Annotated[str, typer.Option(help="Sensor name or YAML file (see r2flow sensor).")]
SizeOption = Annotated[
    str | None, typer.Option(help="Image size, rows x columns, such as 64x1024. Default: the sensor's.")
]
SETS = "a folder of scans, samples, a run, prepared shards, NAME:FOLDER, simulated:SEED"
SensorChoice = Annotated[
    str | None, typer.Option(help="Sensor name or YAML file. Default: the sensor of the flow or the scans, or hdl64e.")
]
ScaleChoice = Annotated[
    float | None,
    typer.Option(min=1e-6, max=1e9, help="Full reflectance in scan files. Default: the format's."),
]

ColumnsOption = Annotated[
    str | None,
    typer.Option(help="Columns of scan files without column names, such as x,y,z,intensity,_. Default: the format's."),
]


def named_columns(text: str | None) -> tuple[str, ...] | None:
    from r2flow.lidar.scan_files import check_columns

    columns = None if text is None else tuple(name.strip() for name in text.split(","))
    check_columns(columns)
    return columns


def parsed(
    option: str, text: str, form: str, split: str, kind: type[int | float], count: int = 0, least: float = -math.inf
) -> tuple[Any, ...]:
    """Parse `count` numbers (0: any number of them) of at least `least`; `form` is the form in messages."""
    with suppress(ValueError):
        values = tuple(kind(part) for part in text.split(split))
        if count in (0, len(values)) and min(values) >= least:
            return values
    raise InputError(f"{option} must be {form}; found {text!r}.")


def rows_and_columns(size: str | None) -> tuple[int, int] | None:
    """Parse an image size such as 64x1024."""
    form = "ROWSxCOLUMNS, such as 64x1024"
    return None if size is None else parsed("--size", size.lower(), form, "x", int, count=2, least=1)


def numbers(option: str, text: str) -> Sequence[int]:
    """Parse positive whole numbers separated by commas."""
    return parsed(f"--{option}", text, "positive numbers separated by commas", ",", int, least=1)


def cores() -> int:
    """Number of CPU cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def grouped(verb: Callable[..., None]) -> Callable[..., None]:
    """Expose each field of a verb's dataclass parameters to typer as an option.

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
        for field in fields(groups[name]):
            default = parameter.empty if field.default is MISSING else field.default
            parameters.append(parameter.replace(name=field.name, default=default, annotation=types[field.name]))

    @wraps(verb)
    def call(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        verb(**given)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


@dataclass(frozen=True)
class ReadingOptions:
    """Projection of scans to images; defaults come from the flow or the prepared scans."""

    sensor: SensorChoice = None
    size: SizeOption = None
    projection: Annotated[
        Literal["spherical", "unfolding"] | None, typer.Option(help="Projection. Default: spherical.")
    ] = None
    convention: Annotated[
        Literal["centre", "reference", "lidargen", "lidm"] | None,
        typer.Option(help="Default: centre; others: as in published models."),
    ] = None
    reflectance_scale: ScaleChoice = None
    columns: ColumnsOption = None

    def reading(
        self, specs: Sequence[str | None], model: "Checkpoint | None" = None, estimate_scale: bool = False
    ) -> "Reading":
        from r2flow.data.opening import reading_for

        given = asdict(self) | {"size": rows_and_columns(self.size), "columns": named_columns(self.columns)}
        return reading_for(specs, model, estimate_scale=estimate_scale, **given)


@dataclass(frozen=True)
class SamplerOptions:
    """Sampler of a generator; defaults come from the generator's sampler."""

    sampler: Annotated[
        str | None,
        typer.Option(
            help="NAME or NAME:FIELD=VALUE:...: adams3, euler, midpoint, heun2, rk4; adaptive: dopri5, torchdiffeq; "
            "stochastic: sde; flow maps: jump, renoise, refine; completion: transport, mmps, replace, repaint. "
            "For other systems see docs/systems.md."
        ),
    ] = None
    steps: Annotated[int | None, typer.Option(min=1, help="Steps from noise to data, for fixed-step samplers.")] = None
    tolerance: Annotated[float | None, typer.Option(help="Error tolerance per step, for adaptive samplers.")] = None
    grid: Annotated[str | None, typer.Option(help="Time grid of fixed steps: uniform or power:P.")] = None

    @property
    def given(self) -> dict[str, Any]:
        """Given name and fields, as arguments of `Generator.choose`."""
        from r2flow.samplers import parse_sampler

        given = {key: value for key, value in asdict(self).items() if key != "sampler" and value is not None}
        return {**({} if self.sampler is None else parse_sampler(self.sampler)), **given}


@dataclass(frozen=True)
class DrawOptions:
    num: Annotated[int, typer.Option(min=1, help="Number of scans.")] = 4
    seed: Annotated[int, typer.Option(min=0, help="Scan i depends only on the seed and i.")] = 0
    batch_size: Annotated[int, typer.Option(min=1, help="Scans per batch.")] = 1
    device: DeviceOption = "auto"
