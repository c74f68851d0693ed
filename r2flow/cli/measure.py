"""Reports: `r2flow report NAME`."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import grouped
from r2flow.cli.options import (
    SETS,
    DeviceOption,
    OutOption,
    ScaleChoice,
    SurfacesOption,
    choose_device,
)
from r2flow.errors import InputError


@report.command(epilog="Example: r2flow report completion kitti360/test street --num 15 --out reports")
@grouped
def completion(
    real: Annotated[str, typer.Argument(help=f"Scans, of which a part is hidden: {SETS}.")],
    models: Annotated[
        list[str] | None, typer.Argument(help="Models, run folders or checkpoint files; street if left out.")
    ] = None,
    tasks: Annotated[
        str | None, typer.Option(help="Masks, as rows:4, a space between them; five masks if left out.")
    ] = None,
    samplers: Annotated[str | None, typer.Option(help="Samplers for the models, as mmps,replace.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each sampler.")] = None,
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

    from r2flow.cli.groups import SamplerOptions
    from r2flow.cli.output import command, finish
    from r2flow.inversion import real_scans
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.completion import completing
    from r2flow.progress import Bar
    from r2flow.reports.completion import TASKS, Way, completion_page, completion_rows, measured_by, pictured
    from r2flow.reports.pages import prepare_folder

    loaded = {Path(name).stem: load_checkpoint(name, choose_device(device)) for name in models or ["street"]}
    ways = [
        Way(name, one, completing(one.generator, **SamplerOptions(sampler, steps).given))
        for name, one in loaded.items()
        for sampler in (samplers.split(",") if samplers else [None])
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
    cost = sum(way.sampler.evaluations(way.checkpoint.generator) or 0 for way in ways) * len(masks)
    with Bar("completing", len(truths) * -(-answers // batch_size) * cost, "evaluations") as advance:
        shown = list(
            completion_rows(truths, first.sensor, ways, masks, answers, seed, batch_size, surfaces, progress=advance)
        )
    figure = pictured(truths[0], shown, first.sensor)
    about = f"{len(truths)} scans of {real}, {answers} answers to each."
    page = completion_page([row for row, _ in shown], figure, about, seed, command(), str(choose_device(device)))
    finish(page, out, page.text[1:])
