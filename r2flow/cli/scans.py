"""Verbs for scans."""

from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import (
    SETS,
    ColumnsOption,
    OutOption,
    ProjectionOption,
    SensorChoice,
    SizeOption,
    build_sized,
    check_words,
    named_columns,
)
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.reports.views import View

PictureScale = Annotated[
    float | None,
    typer.Option(min=1e-6, max=1e9, help="Value in the file that means full reflectance; guessed if left out."),
]


@app.command(epilog="Example: r2flow show scans/000000.ply velodyne/0000000100.bin --out views")
def show(
    scans: Annotated[list[str], typer.Argument(help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: PictureScale = None,
    columns: ColumnsOption = None,
    most: Annotated[int, typer.Option("--num", min=1, help="The most scans to draw of a folder.")] = 16,
    labels: Annotated[bool, typer.Option("--labels", help="Draw the classes of .label files, too.")] = False,
    format: Annotated[str, typer.Option(help="png, or npy for range images, (2, H, W).")] = "png",
) -> None:
    """Draw scans: range, reflectance, bird's-eye view and perspective, a PNG each; or write range images."""
    import numpy as np

    from r2flow.files import atomic_write
    from r2flow.reports.pictures import save_figure, scan_figure
    from r2flow.reports.views import label_view

    check_words(projection=projection)
    if format not in ("png", "npy"):
        raise InputError(f"--format must be png or npy, found {format!r}.")

    views = views_to_draw(scans, sensor, size, projection, reflectance_scale, columns, most)
    for view, name in zip(views, unique_stems([view.path for view in views]), strict=True):
        if format == "npy":
            image = view.image
            with atomic_write(out / f"{name}.npy") as file:
                np.save(file, image)
            print(f"{out / name}.npy: {' x '.join(map(str, image.shape))}, {(image[0] > 0).mean():.1%} returns")
            continue
        classes = label_view(view) if labels else None
        figure = scan_figure(view.image, view.rays, view.path.name, classes)
        print(save_figure(figure, out / f"{name}.png"))


def views_to_draw(
    scans: Sequence[str],
    sensor: str | None,
    size: str | None,
    projection: str,
    reflectance_scale: float | None,
    columns: str | None,
    most: int,
) -> "list[View]":
    """The scans that are named, of each folder at most so many: `views_of`."""
    from r2flow.reports.views import views_of

    if projection == "unfolding" and sensor in (None, "hdl64e"):
        sensor = "hdl64e_rings"  # rows are rings then, and these are not evenly spaced
    chosen = None if sensor is None and size is None else build_sized(sensor or "hdl64e", size)
    named = named_columns(columns)
    return [view for spec in scans for view in views_of(spec, chosen, projection, reflectance_scale, most, named)]


def unique_stems(paths: Sequence[Path]) -> list[str]:
    """The files' stems, with their folder's name where two share one, and with a number where they share that too."""
    stems = [path.stem for path in paths]
    found: list[str] = []
    for path in paths:
        shared = stems.count(path.stem) > 1
        name = f"{path.parent.name}_{path.name.replace('.', '_')}" if shared else path.stem
        names = chain([name], (f"{name}_{number}" for number in count(2)))
        found.append(next(one for one in names if one not in found))
    return found
