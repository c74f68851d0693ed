"""`r2flow sample`, `interpolate` and `info`."""

from dataclasses import dataclass
from json import dumps as to_json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import DrawOptions, SamplerOptions, grouped
from r2flow.cli.options import CheckpointOption, DeviceOption, OutOption, PrecisionOption, choose_device
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.lidar.region import Region
    from r2flow.model.checkpoint import Checkpoint


@dataclass(frozen=True)
class RegionOptions:
    """The part of a scan that is asked for."""

    sector: Annotated[
        str | None, typer.Option(help="Azimuths in degrees, as -45,45 for the quarter ahead: generate no more.")
    ] = None
    rows: Annotated[str | None, typer.Option(help="Rows of the image, as 0-31 for the upper half of 64.")] = None
    channels: Annotated[Literal["both", "range", "reflectance"], typer.Option(help="What is decoded and written.")] = (
        "both"
    )

    def region(self, checkpoint: "Checkpoint") -> "Region | None":
        """The region of --sector and --rows; prints what is generated for it."""
        from r2flow.lidar.region import MARGIN, region
        from r2flow.model.sampling import evaluated_region

        if self.sector is None and self.rows is None:
            return None
        angles = self.sector and _pair("--sector", self.sector, ",", float, "two azimuths in degrees, as -45,45")
        limits = self.rows and _pair("--rows", self.rows, "-", int, "the first and the last row, as 0-31")
        wanted = region(checkpoint.sensor.shape, angles or None, limits or None, MARGIN if angles else 0.0)
        seen = evaluated_region(checkpoint.generator, wanted)
        print(f"generating {seen}, for {wanted}: {seen.share:.0%} of the image")
        return wanted


def _pair(option: str, text: str, between: str, kind: type, meaning: str) -> tuple[Any, Any]:
    try:
        first, second = (kind(part) for part in text.split(between))
    except ValueError:
        raise InputError(f"{option} must be {meaning}; found {text!r}.") from None
    return first, second


@app.command(epilog="Example: r2flow sample street --num 16 --steps 64 --out scans")
@grouped
def sample(
    out: OutOption,
    draw: DrawOptions,
    how: SamplerOptions,
    part: RegionOptions,
    model: Annotated[
        str | None, typer.Argument(help="A model, a run folder or a checkpoint file.", show_default=False)
    ] = None,
    precision: PrecisionOption = "32-true",
    format: Annotated[str | None, typer.Option(help="Any of ply,bin,npy; all that fit if left out.")] = None,
    pictures: Annotated[int, typer.Option(min=0, help="Scans that get a picture.")] = 8,
) -> None:
    """Draw scans from a trained generator, `street` if left out: point clouds, range images and pictures.

    The sampler is the generator's own if left out.
    """
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.models import DEFAULT, MODELS, find_model
    from r2flow.reports.outputs import formats_of, write_samples

    if model is None:
        print(f"the model {DEFAULT}: {MODELS[DEFAULT].about} (r2flow info {DEFAULT})")
    loaded = load_checkpoint(model or find_model(DEFAULT), device=choose_device(draw.device))
    sampler = loaded.generator.choose(**how.given)
    formats = [*dict.fromkeys(map(str.strip, format.split(",")))] if format else formats_of(loaded, part.channels)
    region = part.region(loaded)
    write_samples(loaded, out, draw.num, draw.seed, sampler, formats, pictures, draw.batch_size, region, part.channels,
        precision=precision,
    )  # fmt: skip
    seen = f", pictures in {out / 'samples.png'}" if pictures else ""
    seen += f", in 3-D in {out / 'samples.html'}" if pictures and part.channels != "reflectance" else ""
    print(f"{draw.num} scan{'s' * (draw.num != 1)} ({', '.join(formats)}) in {out}{seen}")


@app.command(epilog="Example: r2flow interpolate 0000000100.bin 0000000250.bin -c runs/NAME --frames 6 --out between")
@grouped
def interpolate(
    first: Annotated[str, typer.Argument(help="A scan file or a range image (.npy).")],
    last: Annotated[str, typer.Argument(help="Another.")],
    checkpoint: CheckpointOption,
    out: OutOption,
    sampling: SamplerOptions,
    frames: Annotated[int, typer.Option(min=2, help="Scans in all, the two ends included.")] = 6,
    reflectance_scale: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e9, help="Value in the files that means full reflectance; else the training's."),
    ] = None,
    device: DeviceOption = "auto",
) -> None:
    """Go from one real scan to another through their noises: a figure and a point cloud for every frame.

    The solver is dopri5 at a tolerance of 1e-4 if left out.
    """
    from r2flow.cli.output import command
    from r2flow.generators import as_flow
    from r2flow.inversion import real_scans
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.interpolation import interpolation
    from r2flow.reports.pages import prepare_folder, write_page
    from r2flow.samplers import build_sampler

    loaded = load_checkpoint(checkpoint, choose_device(device))
    given = sampling.given
    sampler = build_sampler(given if "name" in given else {"name": "dopri5", "tolerance": 1e-4, **given})
    sampler.check(as_flow(loaded.generator, "interpolation"))
    ends = real_scans(loaded, [first, last], reflectance_scale)
    if len(ends) != 2:
        raise InputError(f"give two scans, found {len(ends)}.")
    prepare_folder(out)
    written = write_page(interpolation(loaded, ends, frames, out, sampler, command()), out)
    pages = ", ".join(map(str, [*written, out / "interpolation.html"]))
    print(f"{frames} scans in {out / 'frames'}; {pages}")


@app.command(epilog="Example: r2flow info runs/simulated-hdit_tiny")
def info(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file, a run folder or a model.")],
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Print what is in a checkpoint."""
    from r2flow.reports.contents import describe, print_contents

    contents = describe(checkpoint)
    if json:
        print(to_json(contents, indent=2))
    else:
        print_contents(contents)
