"""`r2flow view`: scans in 3-D, in a browser."""

import os
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import grouped
from r2flow.cli.options import (
    SETS,
    ColumnsOption,
    DeviceOption,
    ProjectionOption,
    SensorChoice,
    SizeOption,
    choose_device,
)
from r2flow.cli.scans import PictureScale, views_to_draw
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.reports.view.panels import Panel

SCANS, SAMPLES = 16, 4  # of a folder, of a generator, where nobody says how many
MOST = 256  # of each; a page holds no more


@dataclass(frozen=True)
class GeneratorOptions:
    """What is drawn of a run, a checkpoint or a model."""

    steps: Annotated[
        str | None, typer.Option(help="As 1,2,4,32: the same noise at each number of steps, side by side.")
    ] = None
    times: Annotated[
        int | None, typer.Option(min=2, max=MOST, help="Show x_t at so many times, from noise to scan.")
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Of the samples.")] = 0
    device: DeviceOption = "auto"


@app.command(epilog="Example: r2flow view street velodyne/0000000100.bin --steps 1,2,4,32 --out page.html")
@grouped
def view(
    what: Annotated[
        list[str],
        typer.Argument(help=f"Scan files, range images, {SETS}; or a run, checkpoint or model to draw from."),
    ],
    drawn: GeneratorOptions,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The .html to write; a temporary one, opened, if left out.")
    ] = None,
    num: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST,
            help=f"The most scans of a folder, spread evenly ({SCANS}); samples of a model ({SAMPLES}).",
        ),
    ] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="Scans one after another, on a slider.")] = False,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: PictureScale = None,
    columns: ColumnsOption = None,
) -> None:
    """Look at scans in 3-D: one page that works offline, to turn, colour and compare them.

    Points and range image find each other under the cursor; labels beside the scans are shown.
    """
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.reports.view.panels import in_turn, scan_panels, write_panels

    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--out must be a file that ends in .html, found {out}.")
    flows = [one for one in what if is_checkpoint(one)]
    if not flows and (drawn.steps or drawn.times):
        raise InputError("--steps and --times are of a run, a checkpoint or a model; found none.")
    if not flows and (drawn.seed or drawn.device != "auto"):
        raise InputError("--seed and --device are of a run, a checkpoint or a model that is drawn from; found none.")
    of_files = (sensor, size, reflectance_scale, columns)
    if len(flows) == len(what) and (projection != "spherical" or any(one is not None for one in of_files)):
        raise InputError(
            "--sensor, --size, --projection, --reflectance-scale and --columns are of scans; found none beside a model."
        )
    if sequence and drawn.times:
        raise InputError("--sequence and --times both use the slider; give one of them.")
    if sequence and len(flows) == len(what):
        raise InputError("--sequence is of scans; for samples of a model on a slider give --steps.")
    panels: list[Panel] = []
    frames: list[str] = []
    for one in what:
        if one in flows:
            found, frames = _drawn(one, num or SAMPLES, drawn)
        else:
            views = views_to_draw([one], sensor, size, projection, reflectance_scale, columns, num or SCANS)
            found = scan_panels(views)
            if sequence and len(found) > 1:
                together, frames = in_turn(found, one)
                found = [together]
        panels += found
    title = ", ".join(Path(one).name or one for one in what)
    path = write_panels(out or Path(mkdtemp(prefix="r2flow-"), "view.html"), panels, frames, title)
    print(path)
    if out is None:
        open_browser(path)


def _drawn(name: str, num: int, how: GeneratorOptions) -> "tuple[Sequence[Panel], list[str]]":
    from r2flow.cli.output import numbers
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.view.panels import sample_panels, way_panels

    steps = numbers("steps", how.steps, int) if how.steps else []
    loaded = load_checkpoint(name, choose_device(how.device))
    if how.times is None:
        frames = [f"sample {number}" for number in range(num)] if steps else []
        return sample_panels(loaded, name, num, how.seed, steps), frames
    if len(steps) > 1:
        raise InputError(f"--times takes one number of --steps, found {how.steps}.")
    return way_panels(loaded, name, num, how.seed, steps[0] if steps else None, how.times)


def open_browser(path: Path) -> bool:
    """Open a page where there is a screen; whether it was tried with success."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False  # a browser of text would take the terminal
    try:
        return webbrowser.open(path.resolve().as_uri())
    except webbrowser.Error:
        return False
