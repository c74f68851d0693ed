"""The verb that trains the extractor that comes with the package."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import SizeOption, build_sized
from r2flow.progress import Bar


@app.command("train-extractor", epilog="Example: r2flow train-extractor --seed 7 --out embedded.safetensors")
def train_extractor(
    out: Annotated[Path, typer.Option("--out", "-o", help="The .safetensors to write.", show_default=False)],
    seed: Annotated[int, typer.Option(min=0, help="Of scenes, initial weights and augmentation.")] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps.")] = 1500,
    batch_size: Annotated[int, typer.Option(min=1, help="Scans of a step, each seen once.")] = 4,
    sensor: Annotated[str | None, typer.Option(help="One alone; several take turns if left out.")] = None,
    size: SizeOption = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes that simulate; they do not change the weights.")] = 1,
) -> None:
    """Train the embedded extractor on simulated scans: the same seed gives the same weights, bit for bit.

    Without --sensor and --size, sensors and sizes take turns, as for the shipped weights.
    """
    from r2flow.metrics.extractors.training import VIEWS, Settings, judge_held_out, train, write_weights
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.tables import print_table

    views = VIEWS
    if sensor is not None or size is not None:
        one = build_sized(sensor or "hdl64e", size)
        views = (f"{one.name} {one.shape[0]}x{one.shape[1]}",)
    prepare_folder(out.parent)
    settings = Settings(seed, steps, batch_size, views)
    with Bar("training", steps, "steps") as advance:
        network = train(settings, workers, advance)
    judged = judge_held_out(network, settings)
    write_weights(out, network, settings, judged)
    rows = [(view, figures["accuracy"], figures["mean_iou"], figures["classes"]) for view, figures in judged.items()]
    print_table(rows, ("held-out simulated scans", "accuracy", "mean IoU", "classes"))
    print(f"{out}: {out.stat().st_size / 2**20:.2f} MiB")
