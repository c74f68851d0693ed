"""Reports: `r2flow report NAME`."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.options import ProjectionOption, ScaleOption, SensorOption, SizeOption, build_sized


@report.command(epilog="Example: r2flow report fidelity kitti360/test runs/real/samples --train raw --out reports")
def fidelity(
    real: Annotated[Path, typer.Argument(help="Real scans: a folder.")],
    other: Annotated[Path, typer.Argument(help="Scans to judge: a folder of any known format, or range images.")],
    also: Annotated[list[Path] | None, typer.Option(help="More folders of real scans, one each time.")] = None,
    floor: Annotated[
        list[Path] | None, typer.Option(help="Real scans of other places, to see what real scans come to.")
    ] = None,
    train: Annotated[Path | None, typer.Option(help="The scans that were learned from.")] = None,
    name: Annotated[str, typer.Option(help="What the judged set is called on the page.")] = "judged",
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: ScaleOption = 1.0,
    most: Annotated[int, typer.Option(min=1, help="The most scans of a folder, evenly spread over it.")] = 1000,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the page and its figures.")] = None,
) -> None:
    """Set scans against real ones, beside real drives and beside controls: noise, flat ground, mean, shuffle."""
    from r2flow.cli.output import command, finish
    from r2flow.reports.fidelity import compare_sets, drives_of, joined, load_images, markdown
    from r2flow.reports.fidelity_page import fidelity_page
    from r2flow.reports.pages import prepare_folder

    chosen = build_sized(sensor, size)
    load = partial(load_images, sensor=chosen, projection=projection, reflectance_scale=reflectance_scale, most=most)  # type: ignore[arg-type]
    if out is not None:
        prepare_folder(out)
    training = None if train is None else load(train)
    apart = joined([load(path) for path in floor]) if floor else None
    judged, folders = load(other), [real, *(also or [])]
    truth = joined([load(path) for path in folders])
    drives = [drive for path in folders for drive in drives_of(path, most)]
    result, statistics = compare_sets(truth, judged, chosen, training, floor=apart, drives=drives)
    text = markdown(result, name)
    if out is None:
        print(text)
    else:
        finish(fidelity_page(result, statistics, truth, judged, chosen, name, command()), out, [text])
