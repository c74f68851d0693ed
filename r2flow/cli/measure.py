"""Reports: `r2flow report NAME`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.options import ProjectionOption, ScaleOption, SensorOption, SizeOption, build_sized


@report.command(epilog="Example: r2flow report fidelity kitti360/test runs/real/samples --train raw --size 64x1024")
def fidelity(
    real: Annotated[Path, typer.Argument(help="Real scans: a folder.")],
    other: Annotated[Path, typer.Argument(help="Scans to judge: a folder of any known format, or range images.")],
    train: Annotated[Path | None, typer.Option(help="The scans that were learned from.")] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: ScaleOption = 1.0,
    most: Annotated[int, typer.Option(min=1, help="The most scans of a folder, evenly spread over it.")] = 1000,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for fidelity.md and .json.")] = None,
) -> None:
    """Set scans against real ones, beside controls that know nothing of scenes: noise, flat ground, mean, shuffle."""
    import json

    from r2flow.files import atomic_write
    from r2flow.reports.fidelity import fidelity as measure
    from r2flow.reports.fidelity import load_images, markdown

    chosen = build_sized(sensor, size)
    load = partial(load_images, sensor=chosen, projection=projection, reflectance_scale=reflectance_scale, most=most)  # type: ignore[arg-type]
    training = None if train is None else load(train)
    judged, truth = load(other), load(real)
    text = markdown(result := measure(truth, judged, chosen, training), "judged")
    print(text)
    if out is not None:
        for name, content in (("fidelity.md", text + "\n"), ("fidelity.json", json.dumps(result, indent=2))):
            with atomic_write(out / name, "w") as file:
                file.write(content)
