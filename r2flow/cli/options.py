"""Options shared by verbs, and their parsing; a verb takes a dataclass of them as one."""

import inspect
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

if TYPE_CHECKING:
    from r2flow.data.described import Spec
    from r2flow.data.reading import Reading
    from r2flow.model.checkpoint import Checkpoint


# typer makes a usage error of a ValueError.


def _parse_size(text: str) -> tuple[int, int]:
    """Rows and columns of an image size such as 64x1024."""
    found = re.fullmatch(r"([1-9]\d*)[x,]([1-9]\d*)", text.lower())
    if found is None:
        raise ValueError(f"{text[:40]!r} is not ROWSxCOLUMNS")
    return int(found[1]), int(found[2])


def _parse_columns(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(","))


def parse_counts(text: str) -> list[int]:
    """Positive whole numbers separated by commas."""
    counts = [int(part) if part.isdecimal() else 0 for part in text.split(",")]
    if min(counts) < 1:
        raise ValueError(f"{text[:40]!r} is not of whole numbers from 1 on")
    return counts


DeviceOption = Annotated[str, Option(help="Device: auto, cpu, cuda, cuda:1, ...")]
PrecisionOption = Annotated[
    Literal["32-true", "bf16-mixed"],
    Option(help="Precision of the network; bf16-mixed is faster on hardware with bfloat16."),
]
OutOption = Annotated[Path, Option("--out", "-o", help="Folder to write to.")]
SensorOption = Annotated[str, Option(help="Sensor name or YAML file (see r2flow sensor).")]
SizeOption = Annotated[
    Any,
    Option(
        parser=_parse_size,
        metavar="ROWSxCOLUMNS",
        help="Image size, such as 64x1024. Default: the sensor's.",
    ),
]
SETS = "a folder of scans, samples, a run, prepared shards, NAME:FOLDER, simulated:SEED"
SensorChoice = Annotated[
    str | None,
    Option(
        help="Sensor name or YAML file. Default: the sensor of the flow or the scans, or hdl64e."
    ),
]
ScaleChoice = Annotated[
    float | None,
    Option(min=1e-6, max=1e9, help="Full reflectance in scan files. Default: the format's."),
]
ColumnsOption = Annotated[
    Any,
    Option(
        parser=_parse_columns,
        metavar="NAMES",
        help="All columns of scan files without names, such as x,y,z,intensity,_; of files with "
        "names those to rename, such as intensities=reflectance. Default: the format's.",
    ),
]
TopicOption = Annotated[
    str | None, Option(help="Topic of the point clouds of a recording, required if several.")
]

LabelIdsOption = Annotated[
    str | None,
    Option(
        help="List of the ids of .label files: semantic_kitti (default), semantic_kitti_learning, "
        "nuscenes_lidarseg, semantic_poss, rellis_3d, pandaset, or a YAML file of lines `1: car`."
    ),
]


ModelArgument = Annotated[Path, Argument(help="A model, a run folder or a checkpoint file.")]
SeedOption = Annotated[
    int, Option(min=0, max=2**64 - 1, help="Scan i depends only on the seed and i.")
]
BatchOption = Annotated[int, Option(min=1, help="Scans per batch.")]
MostOption = Annotated[int, Option("--num", min=1, help="Maximum number of scans per folder.")]
WorkersOption = Annotated[int | None, Option(min=1, help="Processes. Default: one per core.")]
SplitOption = Annotated[str | None, Option(help="Part of the data set's standard split.")]
_StepsOption = Annotated[
    int | None, Option(min=1, help="Steps from noise to data, for fixed-step samplers.")
]
StepsList = Annotated[
    Any,
    Option(
        parser=parse_counts,
        metavar="N,N,...",
        help="Numbers of steps of models, such as 1,2,4: one set each, from the same noise.",
    ),
]
ToleranceOption = Annotated[
    float | None, Option(help="Error tolerance per step, for adaptive samplers.")
]


def cores() -> int:
    """Number of CPU cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def several(count: int, what: str = "scan") -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def print_model(name: str) -> None:
    from r2flow.model.shipped import MODELS

    print(f"the model {name}: {MODELS[name].about} (r2flow info {name})")


def grouped(verb: Callable[..., None]) -> Callable[..., None]:
    """Expose each field of a verb's dataclass parameters to typer as an option.

    @app.command()
    @grouped
    def evaluate(real: str, reading: ReadingOptions) -> None: ...   # r2flow evaluate REAL --sensor
    vlp16 --size 16x512
    """
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(verb).parameters.items():
        if is_dataclass(parameter.annotation):
            groups[name] = parameter.annotation
            parameters += inspect.signature(groups[name]).parameters.values()
        else:
            parameters.append(parameter)

    @wraps(verb)
    def call(**values: Any) -> None:
        for name, group in groups.items():
            options = {field: values.pop(field) for field in inspect.signature(group).parameters}
            values[name] = group(**options)
        verb(**values)

    keywords = [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in parameters]
    call.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return call


@dataclass(frozen=True)
class ReadingOptions:
    """Projection of scans to images; defaults come from the flow or the prepared scans."""

    sensor: SensorChoice = None
    size: SizeOption = None
    projection: Annotated[
        Literal["spherical", "unfolding"] | None,
        Option(help="Projection. Default: spherical."),
    ] = None
    convention: Annotated[
        Literal["centre", "reference", "lidargen", "lidm"] | None,
        Option(help="Default: centre; others: as in published models."),
    ] = None
    reflectance_scale: ScaleChoice = None
    columns: ColumnsOption = None
    label_ids: LabelIdsOption = None

    def reading(
        self,
        specs: "Sequence[Spec]",
        model: "Checkpoint | None" = None,
        estimate: bool = False,
    ) -> "Reading":
        """How the scans of some names become images, for a model if given.

        `estimate`: what the sensor's name does not tell, as for pictures.
        """
        from r2flow.data.detection import reading_for

        how = asdict(self)
        return reading_for(specs, model, estimate_scale=estimate, estimate_beams=estimate, **how)


@dataclass(frozen=True)
class SamplerOptions:
    """Sampler of a generator; defaults come from the generator's sampler."""

    sampler: Annotated[
        str | None,
        Option(
            help="NAME or NAME:FIELD=VALUE:...: adams3, euler, midpoint, heun2, rk4; adaptive: "
            "dopri5, torchdiffeq; stochastic: sde; flow maps: jump, renoise, refine; "
            "completion: transport, mmps, replace, repaint. For other systems see docs/systems.md."
        ),
    ] = None
    steps: _StepsOption = None
    tolerance: ToleranceOption = None
    grid: Annotated[str | None, Option(help="Time grid of fixed steps: uniform or power:P.")] = None

    @property
    def fields(self) -> dict[str, Any]:
        """Name and fields that were set, as arguments of `Generator.choose`."""
        from r2flow.samplers import parse_sampler

        named = {} if self.sampler is None else parse_sampler(self.sampler)
        fields = {"steps": self.steps, "tolerance": self.tolerance, "grid": self.grid}
        return named | {key: value for key, value in fields.items() if value is not None}


@dataclass(frozen=True)
class DrawOptions:
    """Which scans to draw, and how."""

    num: Annotated[int, Option(min=1, help="Number of scans.")] = 4
    seed: SeedOption = 0
    batch_size: BatchOption = 1
    device: DeviceOption = "auto"
