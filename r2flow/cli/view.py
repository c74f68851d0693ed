"""`r2flow view` and `r2flow show`: scans in a browser, and as pictures."""

import logging
import os
import sys
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.options import SETS, DeviceOption, OutOption, ReadingOptions, choose_device, grouped, numbers
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.reports.view.panels import Panel
    from r2flow.reports.views import View

log = logging.getLogger(__name__)

SCANS, SAMPLES = 16, 4  # of a folder, of a generator, where nobody says how many
MOST = 256  # of each; a page holds no more


def views(scans: Sequence[str], how: ReadingOptions, most: int) -> "list[View]":
    """The scans that are named, of each folder at most so many."""
    from r2flow.data.opening import own_reading
    from r2flow.reports.views import views_of

    found: list[View] = []
    for spec in scans:
        reading = how.reading([spec])
        if how.reflectance_scale is None and own_reading(spec) is None:  # else guessed from the values
            reading = replace(reading, reflectance_scale=reading.sensor.reflectance_scale)
        found += views_of(spec, reading, most)
    return found


@app.command(epilog="Example: r2flow show scans/000000.ply velodyne/0000000100.bin --out views")
@grouped
def show(
    scans: Annotated[list[str], typer.Argument(help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    how: ReadingOptions,
    most: Annotated[int, typer.Option("--num", min=1, help="The most scans to draw of a folder.")] = SCANS,
    labels: Annotated[bool, typer.Option("--labels", help="Draw the classes of .label files, too.")] = False,
    format: Annotated[Literal["png", "npy"], typer.Option(help="npy: range images, (2, H, W).")] = "png",
) -> None:
    """Draw scans: range, reflectance, bird's-eye view and perspective, a PNG each; or write range images."""
    from r2flow.files import save_array
    from r2flow.reports.pictures import save_figure, scan_figure

    names: list[str] = []
    for view in views(scans, how, most):
        stem = view.path.stem
        names.append(next(one for n in count(1) if (one := stem if n == 1 else f"{stem}_{n}") not in names))
        path = out / f"{names[-1]}.{format}"
        if format == "npy":
            save_array(path, view.image)
            size, returns = " x ".join(map(str, view.image.shape)), (view.image[0] > 0).mean()
            print(f"{path}: {size}, {returns:.1%} returns")
            continue
        image, classes = view.labelled() if labels else (view.image, None)
        if labels and classes is None:
            log.warning("%s: no .label file lies beside it", view.path)
        print(save_figure(scan_figure(image, view.rays, view.path.name, classes), path))


@app.command(epilog="Example: r2flow view street velodyne/0000000100.bin --steps 1,2,4,32 --out page.html")
@grouped
def view(
    what: Annotated[
        list[str],
        typer.Argument(help=f"Scan files, range images, {SETS}; or a run, checkpoint or model to draw from."),
    ],
    how: ReadingOptions,
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
    steps: Annotated[
        str | None, typer.Option(help="As 1,2,4,32: the same noise at each number of steps, side by side.")
    ] = None,
    times: Annotated[
        int | None, typer.Option(min=2, max=MOST, help="Show x_t at so many times, from noise to scan.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the samples of a model.")] = 0,
    device: DeviceOption = "auto",
) -> None:
    """Look at scans in 3-D: one page that works offline, to turn, colour and compare them.

    Points and range image find each other under the cursor; labels beside the scans are shown.
    """
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.view.panels import in_turn, sample_panels, scan_panels, way_panels, write_panels

    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--out must be a file that ends in .html, found {out}.")
    models = [one for one in what if is_checkpoint(one)]
    if not models and (steps or times or seed or device != "auto"):
        raise InputError("--steps, --times, --seed and --device are of a run, a checkpoint or a model; found none.")
    if len(models) == len(what) and (sequence or how != ReadingOptions()):
        words = "--sensor, --size, --projection, --convention, --reflectance-scale and --columns"
        raise InputError(f"--sequence, {words} are of scans; found none.")
    if sequence and times:
        raise InputError("--sequence and --times both use the slider; give one of them.")
    counts = numbers("steps", steps, int) if steps else []
    if times and len(counts) > 1:
        raise InputError(f"--times takes one number of --steps, found {steps}.")
    panels: list[Panel] = []
    frames: list[str] = []
    for one in what:
        if one not in models:
            new = scan_panels(views([one], how, num or SCANS))
            if sequence and len(new) > 1:
                together, frames = in_turn(new, one)
                new = [together]
        elif times:
            model = load_checkpoint(one, choose_device(device))
            new, frames = way_panels(model, one, num or SAMPLES, seed, counts[0] if counts else None, times)
        else:
            new = sample_panels(load_checkpoint(one, choose_device(device)), one, num or SAMPLES, seed, counts)
            frames = [f"sample {number}" for number in range(num or SAMPLES)] if counts else []
        panels += new
    title = ", ".join(Path(one).name or one for one in what)
    path = write_panels(out or Path(mkdtemp(prefix="r2flow-"), "view.html"), panels, frames, title)
    print(path)
    if out is None:
        open_browser(path)


def open_browser(path: Path) -> None:
    """Open a page where there is a screen: a browser of text would take the terminal."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return
    with suppress(webbrowser.Error):
        webbrowser.open(path.resolve().as_uri())
