"""`r2flow view` and `r2flow show`: scans in a browser and as pictures."""

import os
import sys
import webbrowser
from contextlib import suppress
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from typing import Annotated, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.options import SETS, DeviceOption, OutOption, ReadingOptions, grouped, numbers
from r2flow.devices import choose_device
from r2flow.errors import InputError, check

SCANS, SAMPLES = 16, 4  # default numbers per folder and per generator
MOST = 256  # largest number of each per page


@app.command(epilog="Example: r2flow show scans/000000.ply velodyne/0000000100.bin --out views")
@grouped
def show(
    scans: Annotated[list[str], typer.Argument(help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    how: ReadingOptions,
    most: Annotated[int, typer.Option("--num", min=1, help="Maximum number of scans per folder.")] = SCANS,
    format: Annotated[
        Literal["png", "pdf", "npy"], typer.Option(help="png, pdf: pictures; npy: range images, (2, H, W).")
    ] = "png",
) -> None:
    """Draw each scan (range, reflectance, bird's-eye view, perspective) as a PNG or PDF, or write range images."""
    from r2flow.data.opening import FOLDER, parse
    from r2flow.files import save_array
    from r2flow.reports.pictures import save_figure, scan_figure
    from r2flow.reports.view.panels import one_scale, scan_panels

    check(out.suffix.lower() not in (".png", ".pdf", ".npy"), f"--out is a folder, for a file per scan; found {out}.")
    for options, file in map(parse, scans) if format == "npy" else ():
        source, target = options.folder.resolve(), out.resolve()
        inside = source == target or (file is None and source in target.parents)  # a set includes all folders below
        check(not inside or options.name != FOLDER, f"{out} is in the folder of the scans; give another --out.")
    names: list[str] = []
    readings = one_scale({spec: how.reading([spec], estimate_scale=True) for spec in scans}, most)
    for _, (caption, (image,), rays, *_) in scan_panels(readings, most, labelled=False):
        file = Path(caption)
        names.append(next(s for n in count(1) if (s := file.stem if n == 1 else f"{file.stem}_{n}") not in names))
        path = out / f"{names[-1]}.{format}"
        if format == "npy":
            save_array(path, image)
        else:
            save_figure(scan_figure(image, rays, caption), path)
        print(path)


@app.command(epilog="Example: r2flow view street velodyne/0000000100.bin --steps 1,2,4,32 --out page.html")
@grouped
def view(
    what: Annotated[
        list[str], typer.Argument(help=f"Scan files, range images, {SETS}; or a run, checkpoint or model to sample.")
    ],
    how: ReadingOptions,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="HTML file to write. Default: a temporary file, opened in the browser."),
    ] = None,
    num: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST,
            help=f"Maximum number of scans per folder, evenly spaced ({SCANS}); samples per model ({SAMPLES}).",
        ),
    ] = None,
    sequence: Annotated[bool, typer.Option("--sequence", help="Show scans as a sequence with a slider.")] = False,
    steps: Annotated[
        str | None, typer.Option(help="Such as 1,2,4,32: compare numbers of steps from the same noise.")
    ] = None,
    times: Annotated[int | None, typer.Option(min=2, max=MOST, help="Show x_t at N times from noise to scan.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the samples.")] = 0,
    device: DeviceOption = "auto",
) -> None:
    """View scans in 3-D: an offline page to rotate, colour and compare them.

    The cursor links points and range image; labels next to the scans are shown.
    """
    from r2flow.data.opening import own_reading
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.files import write_file
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.view import Panel, page
    from r2flow.reports.view.panels import in_turn, one_scale, sample_panels, scan_panels, way_panels

    check(out is None or out.suffix.lower() in (".html", ".htm"), f"--out is a file that ends in .html; found {out}.")
    models = [spec for spec in what if is_checkpoint(spec)]
    scans = [spec for spec in what if spec not in models]
    if not models and (steps or times or seed or device != "auto"):
        raise InputError("--steps, --times, --seed and --device are of a run, a checkpoint or a model; found none.")
    names = "--sensor, --size, --projection, --convention, --reflectance-scale and --columns"
    check(scans or not (sequence or how != ReadingOptions()), f"--sequence, {names} are of scans; found none.")
    check(not (sequence and times), "--sequence and --times both use the slider; give one of them.")
    counts = numbers("steps", steps) if steps else []
    check(not times or len(counts) <= 1, f"--times takes one number of --steps, found {steps}.")
    panels: list[Panel] = []
    loaded = {spec: load_checkpoint(spec, choose_device(device)) for spec in models}
    first = None if how.sensor or how.size else next(iter(loaded.values()), None)
    each = [how.reading([spec], None if own_reading(spec) else first, estimate_scale=True) for spec in scans]
    readings = one_scale(dict(zip(scans, each, strict=True)), num or SCANS)
    apart = [{spec: reading} for spec, reading in readings.items()] if sequence else [readings]  # frames share captions
    drawn = [pair for together in apart for pair in scan_panels(together, num or SCANS)]
    for spec in what:
        if spec in readings:
            new = [panel for of, panel in drawn if of == spec]
            panels += [in_turn(new, spec)] if sequence and len(new) > 1 else new
        elif times:
            panels += way_panels(loaded[spec], spec, num or SAMPLES, seed, counts[0] if counts else None, times)
        else:
            panels += sample_panels(loaded[spec], spec, num or SAMPLES, seed, counts)
    content = page(panels, ", ".join(Path(spec).name or spec for spec in what))  # may be refused or stopped
    path = out or Path(mkdtemp(prefix="r2flow-"), "view.html")
    write_file(path, content)
    print(path)
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or not sys.platform.startswith("linux")
    if out is None and display:  # without one, a text browser would block the terminal
        with suppress(webbrowser.Error):
            webbrowser.open(path.resolve().as_uri())
