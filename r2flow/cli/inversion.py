"""Verbs that go from scans to noise."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import CheckpointOption, OutOption, choose_device

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
    scans: Annotated[list[Path], typer.Argument(help="Scan files, range images (.npy), or folders of them.")],
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
    from r2flow.reports.inversion import invert_scans, print_rows
    from r2flow.reports.pages import write_page
    from r2flow.reports.views import scans_of

    loaded = load_checkpoint(checkpoint, choose_device(device))
    paths = [path for scan in scans for path in scans_of(scan, most)]
    page = invert_scans(loaded, paths, out, Sampler(solver, steps, tolerance), batch_size, reflectance_scale, command())
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
    from r2flow.reports.pages import write_page

    loaded = load_checkpoint(checkpoint, choose_device(device))
    page = interpolation(
        loaded, [first, last], frames, out, Sampler(solver, steps, tolerance), batch_size, reflectance_scale, command()
    )
    written = write_page(page, out)
    print(f"{frames} scans in {out / 'frames'}; {', '.join(str(path) for path in written)}")
