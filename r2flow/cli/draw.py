"""`r2flow sample`, `complete` and `interpolate`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import (
    SETS,
    ColumnsOption,
    DeviceOption,
    DrawOptions,
    OutOption,
    PrecisionOption,
    SamplerOptions,
    ScaleChoice,
    SizeOption,
    grouped,
    named_columns,
    parsed,
    rows_and_columns,
)
from r2flow.devices import choose_device
from r2flow.errors import check, check_folder

if TYPE_CHECKING:
    from r2flow.data.partial import PartialScan
    from r2flow.lidar.region import Region
    from r2flow.model.checkpoint import Checkpoint


@app.command(epilog="Example: r2flow sample street --num 16 --steps 64 --out scans")
@grouped
def sample(
    out: OutOption,
    draw: DrawOptions,
    how: SamplerOptions,
    sector: Annotated[
        str | None, typer.Option(help="Generate only these azimuths, in degrees: -45,45 is the quarter ahead.")
    ] = None,
    rows: Annotated[str | None, typer.Option(help="Image rows, such as 0-31 for the upper half of 64.")] = None,
    model: Annotated[str | None, typer.Argument(help="A model, a run folder or a checkpoint file.")] = None,
    precision: PrecisionOption = "32-true",
    format: Annotated[str | None, typer.Option(help="Formats, of ply,bin,npy. Default: all possible.")] = None,
    pictures: Annotated[int, typer.Option(min=0, help="Number of scans to draw as pictures.")] = 8,
) -> None:
    """Sample scans from a trained model (default: `street`): point clouds, range images and pictures.

    The default sampler is the generator's.
    """
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.models import DEFAULT, MODELS, find_model
    from r2flow.reports.outputs import write_samples

    check_folder(out)
    if model is None:
        print(f"the model {DEFAULT}: {MODELS[DEFAULT].about} (r2flow info {DEFAULT})")
    loaded = load_checkpoint(model or find_model(DEFAULT), device=choose_device(draw.device))
    sampler = loaded.generator.choose(**how.given)
    chosen = [*dict.fromkeys(map(str.strip, format.split(",")))] if format else None
    region = _region(loaded, sector, rows) if sector or rows else None
    formats = write_samples(
        loaded, out, draw.num, draw.seed, sampler, chosen, pictures, draw.batch_size, region, precision=precision
    )
    pages = f", pictures in {out / 'samples.png'}, in 3-D in {out / 'samples.html'}" if pictures else ""
    print(f"{draw.num} scan{'s' * (draw.num != 1)} ({', '.join(formats)}) in {out}{pages}")


def _region(checkpoint: "Checkpoint", sector: str | None, rows: str | None) -> "Region":
    """Region of --sector and --rows; prints the part that the generator evaluates."""
    from r2flow.lidar.region import MARGIN, region
    from r2flow.model.sampling import evaluated_region

    angles = parsed("--sector", sector, "two azimuths in degrees, such as -45,45", ",", float, 2) if sector else None
    limits = parsed("--rows", rows, "the first and the last row, such as 0-31", "-", int, 2) if rows else None
    requested = region(checkpoint.sensor.shape, angles, limits, MARGIN if angles else 0.0)
    evaluated = evaluated_region(checkpoint.generator, requested)
    print(f"generating {evaluated}, for {requested}: {evaluated.share:.0%} of the image")
    return requested


@app.command(epilog="Example: r2flow interpolate 0000000100.bin 0000000250.bin -c runs/NAME --frames 6 --out between")
@grouped
def interpolate(
    first: Annotated[str, typer.Argument(help="A scan file or a range image (.npy).")],
    last: Annotated[str, typer.Argument(help="A second scan file or range image.")],
    checkpoint: Annotated[Path, typer.Option("--checkpoint", "-c", help="A checkpoint file, a run folder or a model.")],
    out: OutOption,
    sampling: SamplerOptions,
    frames: Annotated[int, typer.Option(min=2, help="Number of scans, both ends included.")] = 6,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
) -> None:
    """Interpolate between two real scans in noise space: a figure and a point cloud per frame.

    Default solver: dopri5 with tolerance 1e-4; with --steps or --grid, the flow's own.
    """
    from r2flow.generators.flow import as_flow, ode_sampler
    from r2flow.inversion import real_scans
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.interpolation import interpolation
    from r2flow.reports.pages import write_page
    from r2flow.samplers import Adaptive, build_sampler

    loaded = load_checkpoint(checkpoint, choose_device(device))
    given, flow = sampling.given, as_flow(loaded.generator, "interpolation")
    usual = ode_sampler(flow) if given.keys() & {"steps", "grid"} else Adaptive(tolerance=1e-4)
    sampler = build_sampler(given) if "name" in given else usual.changed(**given)
    sampler.check(flow)
    names, pair = real_scans(loaded, [first, last], reflectance_scale)
    check(len(names) == 2, f"give two scans, found {len(names)}.")
    check_folder(out)
    written = write_page(interpolation(loaded, names, pair, frames, out, sampler), out)
    pages = ", ".join(map(str, [*written, out / "interpolation.html"]))
    print(f"{frames} scans in {out / 'frames'}; {pages}")


@dataclass(frozen=True)
class PartialOptions:
    """The scans to complete: their sensor, what is known of them, and the sensor of the completed scans."""

    source: Annotated[
        str | None,
        typer.Option("--from", help="Sensor of the scans, name or YAML file. Default: detected from the scans."),
    ] = None
    to: Annotated[
        str | None, typer.Option(help="Sensor of the completed scans, name or YAML file. Default: the model's.")
    ] = None
    size: SizeOption = None
    mask: Annotated[
        str | None,
        typer.Option(help="Use a part of the scan: rows:4, random:0.5, points:0.1, sector:-30,30, FILE.npy."),
    ] = None
    fill_gaps: Annotated[
        bool, typer.Option("--fill-gaps", help="Treat rays without a return as unmeasured, as in a thinned scan.")
    ] = False
    reflectance_scale: ScaleChoice = None
    columns: ColumnsOption = None
    scans: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of scans per folder, evenly spaced. Default: all.")
    ] = None

    def open(self, model: str, device: str, what: Sequence[str]) -> "tuple[Checkpoint, list[PartialScan], list[str]]":
        """The model, for another sensor if given, the scans as it takes them, and remarks on their sensor."""
        from r2flow.lidar.sensors import named_sensor
        from r2flow.model.checkpoint import load_checkpoint

        loaded = load_checkpoint(model, choose_device(device))
        if self.to or self.size:
            loaded = loaded.through(named_sensor(self.to or loaded.sensor, rows_and_columns(self.size)))
        how = {"scale": self.reflectance_scale, "most": self.scans, "columns": named_columns(self.columns)}
        return loaded.open_partial(what, self.source, **how)


@app.command(epilog="Example: r2flow complete scan.pcd --from vlp16 --num 8 --out dense")
@grouped
def complete(
    what: Annotated[list[str], typer.Argument(metavar="SCANS", help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    given: PartialOptions,
    how: SamplerOptions,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--checkpoint",
            "-c",
            help="A checkpoint file, a run folder or a model. Default: densify; street for sectors without rays or a "
            "--sampler for flows from noise.",
        ),
    ] = None,
    precision: PrecisionOption = "32-true",
    num: Annotated[int, typer.Option(min=1, help="Completions per scan.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="A completion depends only on seed, scan and its index.")] = 0,
    batch_size: Annotated[int, typer.Option(min=1, help="Completions per batch.")] = 1,
    pictures: Annotated[int, typer.Option(min=0, help="Number of scans to show in pictures and a 3-D page.")] = 8,
    device: DeviceOption = "auto",
) -> None:
    """Complete scans: more beams, filled gaps, hidden parts.

    Files have the format of the input, or .ply if it cannot be written. The same command resumes an interrupted run.
    """
    from r2flow.lidar.known import mask_identity, parse_mask
    from r2flow.model.completion import completing
    from r2flow.models import DEFAULT, DENSIFY, MODELS
    from r2flow.reports.completed import Job, lack_sectors, print_completed, write_completed

    check_folder(out)
    mask = parse_mask(given.mask) if given.mask else None
    job = Job(num, seed, mask, given.fill_gaps, batch_size, pictures, precision)
    name = str(checkpoint or (DENSIFY if how.given.get("name", "jump") in ("jump", "transport") else DEFAULT))
    loaded, scans, remarks = given.open(name, device, what)
    if not (checkpoint or given.to or given.size or how.sampler) and name == DENSIFY and lack_sectors(scans, job):
        name = DEFAULT
        loaded, scans, remarks = given.open(name, device, what)
    if checkpoint is None:
        print(f"the model {name}: {MODELS[name].about} (r2flow info {name})")
    sampler = completing(loaded.generator, several=num > 1, **how.given)
    for line in remarks:
        print(line)
    if not loaded.encoding.reflectance:
        print("the model is of range alone: answers have no reflectance")
    about = {
        "mask": given.mask and mask_identity(given.mask), "from": given.source,
        "reflectance_scale": given.reflectance_scale, "columns": given.columns,
    }  # fmt: skip
    print_completed(write_completed(loaded, scans, out, job, sampler, about), out, len(scans))
