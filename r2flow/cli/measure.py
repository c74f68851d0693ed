"""Reports: `r2flow report NAME`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import ReadingOptions, grouped
from r2flow.cli.options import SETS, choose_reading


@report.command(epilog="Example: r2flow report fidelity kitti360/test runs/real/samples --train raw --out reports")
@grouped
def fidelity(
    real: Annotated[str, typer.Argument(help=f"Real scans: {SETS}.")],
    other: Annotated[str, typer.Argument(help="Scans to judge: likewise.")],
    how: ReadingOptions,
    also: Annotated[list[str] | None, typer.Option(help="More real scans, one set each time.")] = None,
    floor: Annotated[
        list[str] | None, typer.Option(help="Real scans of other places, to see what real scans come to.")
    ] = None,
    train: Annotated[str | None, typer.Option(help="The scans that were learned from.")] = None,
    name: Annotated[str, typer.Option(help="What the judged set is called on the page.")] = "judged",
    num: Annotated[int, typer.Option(min=1, help="The most scans of a set, evenly spread over it.")] = 1000,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the page and its figures.")] = None,
) -> None:
    """Set scans against real ones, beside real drives and beside controls: noise, flat ground, mean, shuffle."""
    from r2flow.cli.output import command, finish
    from r2flow.reports.fidelity import compare_sets, joined, load_scans, markdown
    from r2flow.reports.fidelity_page import fidelity_page
    from r2flow.reports.pages import prepare_folder

    folders = [real, *(also or [])]
    named = [*folders, other, *(floor or []), train]
    reading = replace(choose_reading(named, **vars(how)), on_bad_scan="error")
    if out is not None:
        prepare_folder(out)
    training = None if train is None else load_scans(train, reading, num)[0]
    apart = joined([load_scans(path, reading, num)[0] for path in floor]) if floor else None
    judged, _ = load_scans(other, reading, num)
    loaded = [load_scans(path, reading, num) for path in folders]
    truth = joined([images for images, _ in loaded])
    drives = [drive for _, names in loaded for drive in names]
    chosen = reading.sensor
    result, statistics = compare_sets(truth, judged, chosen, training, floor=apart, drives=drives)
    text = markdown(result, name)
    if out is None:
        print(text)
    else:
        finish(fidelity_page(result, statistics, truth, judged, chosen, name, command()), out, [text])
