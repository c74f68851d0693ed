"""Verbs that go from scans to noise, and the report on what a scene need not cost."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app, report
from r2flow.cli.options import SETS, CheckpointOption, OutOption, choose_device

SolverOption = Annotated[str, typer.Option(help="dopri5, bosh3, or one of fixed steps: euler, rk4, ab2, ...")]
ToleranceOption = Annotated[float, typer.Option(help="Of an adaptive solver.")]
StepsOption = Annotated[int, typer.Option(min=1, help="Of a solver of fixed steps.")]
BatchOption = Annotated[int, typer.Option(min=1, help="Scans at once.")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")]
OwnScaleOption = Annotated[
    float | None,
    typer.Option(min=1e-6, help="Value in the files that means full reflectance; the training's if left out."),
]


@app.command(epilog="Example: r2flow invert velodyne/0000000100.bin --checkpoint runs/NAME --out noise")
def invert(
    scans: Annotated[list[str], typer.Argument(help=f"Scan files, range images (.npy), or {SETS}.")],
    checkpoint: CheckpointOption,
    out: OutOption,
    solver: SolverOption = "dopri5",
    tolerance: ToleranceOption = 1e-5,
    steps: StepsOption = 32,
    most: Annotated[int, typer.Option(min=1, help="The most scans of a folder, evenly spread over it.")] = 16,
    reflectance_scale: OwnScaleOption = None,
    batch_size: BatchOption = 1,
    device: DeviceOption = "auto",
) -> None:
    """Carry scans back to the noise that they come from, and forward again: how far from themselves they end."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.cli.output import command
    from r2flow.generators import Sampler
    from r2flow.reports.inversion import invert_scans, print_rows, real_scans
    from r2flow.reports.pages import write_page

    loaded = load_checkpoint(checkpoint, choose_device(device))
    real = real_scans(loaded, scans, reflectance_scale, most)
    page = invert_scans(loaded, real, out, Sampler(solver, steps, tolerance), batch_size, command())
    written = write_page(page, out)
    print_rows(page.rows)  # type: ignore[arg-type]
    print(f"noise in {out}/*.x_0.npy; {', '.join(str(path) for path in written)}")


@app.command(epilog="Example: r2flow interpolate 0000000100.bin 0000000250.bin -c runs/NAME --frames 6 --out between")
def interpolate(
    first: Annotated[Path, typer.Argument(help="A scan file or a range image (.npy).")],
    last: Annotated[Path, typer.Argument(help="Another.")],
    checkpoint: CheckpointOption,
    out: OutOption,
    frames: Annotated[int, typer.Option(min=2, help="Scans in all, the two ends included.")] = 6,
    solver: SolverOption = "dopri5",
    tolerance: ToleranceOption = 1e-4,
    steps: StepsOption = 32,
    reflectance_scale: OwnScaleOption = None,
    batch_size: BatchOption = 1,
    device: DeviceOption = "auto",
) -> None:
    """Go from one real scan to another through their noises: a figure and a point cloud for every frame."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.cli.output import command
    from r2flow.generators import Sampler
    from r2flow.reports.interpolation import interpolation
    from r2flow.reports.inversion import real_scans
    from r2flow.reports.pages import write_page

    loaded = load_checkpoint(checkpoint, choose_device(device))
    ends = real_scans(loaded, [first, last], reflectance_scale)
    page = interpolation(loaded, ends, frames, out, Sampler(solver, steps, tolerance), batch_size, command())
    written = write_page(page, out)
    print(f"{frames} scans in {out / 'frames'}; {', '.join(str(path) for path in written)}")


@report.command(epilog="Example: r2flow report savings runs/NAME --out reports")
def savings(
    checkpoint: Annotated[
        Path | None, typer.Argument(help="A checkpoint file or a run folder; without one, exact problems alone.")
    ] = None,
    out: OutOption = Path("reports"),
    num: Annotated[int, typer.Option(min=1, help="Scenes of the checkpoint's flow.")] = 4,
    steps: Annotated[int, typer.Option(min=1, help="AB2 steps of the regions.")] = 16,
    tolerance: Annotated[float, typer.Option(help="Of the checkpoint's adaptive solutions.")] = 1e-3,
    seed: Annotated[int, typer.Option(min=0, help="Scene i depends on the seed and on i alone.")] = 0,
    device: DeviceOption = "auto",
) -> None:
    """What a scene need not cost: own steps, leaving early, one step for the straight, regions, single channels."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.cli.output import command, finish
    from r2flow.flow.solvers import check_tolerance
    from r2flow.progress import Bar
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.savings_page import evaluations_of_page, savings_page

    check_tolerance(tolerance)
    loaded = None if checkpoint is None else load_checkpoint(checkpoint, choose_device(device))
    prepare_folder(out)
    with Bar("measuring", evaluations_of_page(num, steps) if loaded else 0, "evaluations") as advance:
        page = savings_page(loaded, num, steps, tolerance, seed, command(), advance)
    finish(page, out)
