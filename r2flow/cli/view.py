"""`r2flow view` and `r2flow show`: scans in a browser and as pictures."""

import os
import sys
import webbrowser
from contextlib import suppress
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import InputError
from r2flow.cli.app import app
from r2flow.cli.options import (
    SETS,
    DeviceOption,
    MostOption,
    OutOption,
    ReadingOptions,
    SeedOption,
    StepsList,
    grouped,
)

_SCANS = 16  # default number of scans per folder
_SAMPLES = 4  # default number of samples per generator


@app.command(
    rich_help_panel="Look",
    epilog="Example: r2flow show scans/000000.ply velodyne/0000000100.bin --out views",
)
@grouped
def show(
    scans: Annotated[list[str], Argument(help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    how: ReadingOptions,
    most: MostOption = _SCANS,
    format: Annotated[
        Literal["png", "pdf", "npy"],
        Option(help="png, pdf: pictures; npy: range images, (2, H, W)."),
    ] = "png",
) -> None:
    """Draw each scan (range, reflectance, bird's-eye view, perspective) as a PNG or PDF, or write
    range images.
    """
    from r2flow.base.files import check_folder, save_array
    from r2flow.data.described import describe
    from r2flow.reports.figures import save_figure
    from r2flow.reports.pictures import scan_figure, view_of
    from r2flow.reports.view.panels import scan_panels, share_scale

    described = [describe(spec) for spec in scans]
    if format == "npy" and out.resolve() in {one.options.folder.resolve() for one in described}:
        raise InputError(f"{out} is the folder of the scans; give another --out.")
    check_folder(out)
    names: set[str] = set()
    readings = {one: how.reading([one], estimate=True) for one in described}
    panels = [panel for _, panel in scan_panels(share_scale(readings, most), most)]
    view = view_of(*((panel.images[0][:2], panel.rays) for panel in panels))
    for panel in panels:
        stem = Path(panel.caption).stem
        versions = (stem if number == 1 else f"{stem}_{number}" for number in count(1))
        name = next(version for version in versions if version not in names)
        names.add(name)
        path = out / f"{name}.{format}"
        if format == "npy":
            save_array(path, panel.images[0])
        else:
            labels = None if panel.labels is None else panel.labels[0]
            figure = scan_figure(panel.images[0], panel.rays, panel.caption, view, labels)
            save_figure(figure, path)
        print(path)


@app.command(
    rich_help_panel="Look",
    epilog="Example: r2flow view street velodyne/0000000100.bin --steps 1,2,4,32 --out page.html",
)
@grouped
def view(
    what: Annotated[
        list[str],
        Argument(
            help=f"Scan files, range images, {SETS}; or a run, checkpoint or model to sample."
        ),
    ],
    how: ReadingOptions,
    out: Annotated[
        Path | None,
        Option(
            "--out",
            "-o",
            help="HTML file to write. Default: a temporary file, opened in the browser.",
        ),
    ] = None,
    num: Annotated[
        int | None,
        Option(
            min=1,
            max=256,
            help=f"Maximum number of scans per folder, evenly spread ({_SCANS}); "
            f"samples per model ({_SAMPLES}).",
        ),
    ] = None,
    sequence: Annotated[
        bool, Option("--sequence", help="Show scans as a sequence with a slider.")
    ] = False,
    steps: StepsList = None,
    seed: SeedOption = 0,
    device: DeviceOption = "auto",
) -> None:
    """View scans in 3-D: an offline page to rotate, colour and compare them.

    The cursor links points and range image; labels next to the scans are shown.
    """
    from r2flow.base.files import write_file
    from r2flow.data.described import describe
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.view import page
    from r2flow.reports.view.panels import as_frames, sample_panels, scan_panels, share_scale

    where = choose_device(device)
    models = {spec: load_checkpoint(spec, where) for spec in what if is_checkpoint(spec)}
    first = None if how.sensor or how.size else next(iter(models.values()), None)
    described = {spec: describe(spec) for spec in what if spec not in models}
    readings = {
        scans: how.reading([scans], None if scans.stored else first, estimate=True)
        for scans in described.values()
    }
    drawn = list(scan_panels(share_scale(readings, num or _SCANS), num or _SCANS))
    panels = []
    for spec in what:
        if spec in models:
            panels += sample_panels(models[spec], spec, num or _SAMPLES, seed, steps or ())
        else:
            own = [panel for of, panel in drawn if of is described[spec]]
            panels += [as_frames(own, spec)] if sequence else own
    content = page(panels, ", ".join(Path(spec).name or spec for spec in what))
    path = out or Path(mkdtemp(prefix="r2flow-"), "view.html")
    write_file(path, content)
    print(path)
    screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if out is None and (screen or not sys.platform.startswith("linux")):
        # without a screen, a text browser would block the terminal
        with suppress(webbrowser.Error):
            webbrowser.open(path.resolve().as_uri())
