"""Reports: `r2flow report NAME`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import ReadingOptions, grouped
from r2flow.cli.options import (
    SETS,
    CheckpointOption,
    DeviceOption,
    OutOption,
    ScaleChoice,
    SurfacesOption,
    choose_device,
    choose_reading,
)
from r2flow.errors import InputError


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


@report.command(epilog="Example: r2flow report completion kitti360/test -c street --num 15 --out reports")
@grouped
def completion(
    real: Annotated[str, typer.Argument(help=f"Scans, of which a part is hidden: {SETS}.")],
    checkpoint: CheckpointOption = Path("street"),
    also: Annotated[list[str] | None, typer.Option(help="More models, one each time.")] = None,
    tasks: Annotated[
        str | None, typer.Option(help="Masks, as rows:4, a space between them; five masks if left out.")
    ] = None,
    solvers: Annotated[str | None, typer.Option(help="Methods for the models, as mmps,replace.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each method.")] = None,
    num: Annotated[int, typer.Option(min=1, help="The most scans of a set, evenly spread over it.")] = 16,
    answers: Annotated[int, typer.Option(min=1, help="Answers to each scan; 19 give intervals of 90 %.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise. What is hidden of a scan does not depend on it.")] = 0,
    batch_size: Annotated[int, typer.Option(min=1, help="Answers at once.")] = 4,
    surfaces: SurfacesOption = True,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
    out: OutOption = Path("reports"),
) -> None:
    """Hide a part of scans and complete them, by models and by plain interpolation: errors against evaluations."""
    import numpy as np

    from r2flow.cli.output import command, finish
    from r2flow.flow.posterior import methods_in
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.completion import completing
    from r2flow.progress import Bar
    from r2flow.reports.completion import TASKS, Way, completion_page, completion_rows, measured_by, pictured
    from r2flow.reports.inversion import real_scans
    from r2flow.reports.pages import prepare_folder

    loaded = {Path(name).stem: load_checkpoint(name, choose_device(device)) for name in (checkpoint, *(also or []))}
    ways = [
        Way(name, one, completing(one.generator, method=method, steps=steps))
        for name, one in loaded.items()
        for method in (methods_in(solvers) if solvers else [None])
    ]
    first = ways[0].checkpoint
    masks = tasks.split() if tasks else list(TASKS)
    for task in masks:
        measured_by(task, first.sensor, 0)
    scans = real_scans(first, [real], reflectance_scale, num)
    truths = [np.asarray(scan.image) for scan in scans if scan.image[0].any()]
    if not truths:
        raise InputError(f"{real}: no scan has a return, so there is nothing to hide.")
    prepare_folder(out)
    cost = sum(way.checkpoint.generator.evaluations_of(way.sampler) for way in ways) * len(masks)
    with Bar("completing", len(truths) * -(-answers // batch_size) * cost, "evaluations") as advance:
        shown = list(
            completion_rows(truths, first.sensor, ways, masks, answers, seed, batch_size, surfaces, progress=advance)
        )
    figure = pictured(truths[0], shown, first.sensor)
    about = f"{len(truths)} scans of {real}, {answers} answers to each."
    page = completion_page([row for row, _ in shown], figure, about, seed, command(), str(choose_device(device)))
    finish(page, out, page.text[1:])
