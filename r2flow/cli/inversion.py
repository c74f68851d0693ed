"""Verbs that go from scans to noise."""

from dataclasses import dataclass
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import SamplerOptions, grouped
from r2flow.cli.options import CheckpointOption, DeviceOption, OutOption, choose_device


@dataclass(frozen=True)
class ScanOptions:
    """How scans are read and carried."""

    reflectance_scale: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e9, help="Value in the files that means full reflectance; else the training's."),
    ] = None
    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 1
    device: DeviceOption = "auto"


@app.command(epilog="Example: r2flow interpolate 0000000100.bin 0000000250.bin -c runs/NAME --frames 6 --out between")
@grouped
def interpolate(
    first: Annotated[str, typer.Argument(help="A scan file or a range image (.npy).")],
    last: Annotated[str, typer.Argument(help="Another.")],
    checkpoint: CheckpointOption,
    out: OutOption,
    sampling: SamplerOptions,
    how: ScanOptions,
    frames: Annotated[int, typer.Option(min=2, help="Scans in all, the two ends included.")] = 6,
) -> None:
    """Go from one real scan to another through their noises: a figure and a point cloud for every frame.

    The solver is dopri5 at a tolerance of 1e-4 if left out.
    """
    from r2flow.cli.output import command
    from r2flow.inversion import real_scans
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.interpolation import interpolation
    from r2flow.reports.pages import write_page
    from r2flow.samplers import build_sampler

    loaded = load_checkpoint(checkpoint, choose_device(how.device))
    ends = real_scans(loaded, [first, last], how.reflectance_scale)
    given = sampling.given
    sampler = build_sampler(given if "name" in given else {"name": "dopri5", "tolerance": 1e-4, **given})
    written = write_page(interpolation(loaded, ends, frames, out, sampler, how.batch_size, command()), out)
    pages = ", ".join(map(str, [*written, out / "interpolation.html"]))
    print(f"{frames} scans in {out / 'frames'}; {pages}")
