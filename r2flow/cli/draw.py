"""`r2flow sample`, `complete` and `interpolate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.options import (
    SETS,
    CheckpointOption,
    ColumnsOption,
    DeviceOption,
    DrawOptions,
    OutOption,
    PrecisionOption,
    SamplerOptions,
    ScaleChoice,
    SizeOption,
    build_sized,
    choose_device,
    command,
    grouped,
    named_columns,
    rows_and_columns,
)
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
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
) -> None:
    """Go from one real scan to another through their noises: a figure and a point cloud for every frame.

    The solver is dopri5 at a tolerance of 1e-4 if left out.
    """
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


@app.command(epilog="Example: r2flow complete scan.pcd --from vlp16 --num 8 --out dense")
@grouped
def complete(
    what: Annotated[list[str], typer.Argument(metavar="SCANS...", help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    how: SamplerOptions,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            "--checkpoint",
            "-c",
            help="A checkpoint file, a run folder or a model; if left out densify, and street for what lies in sectors "
            "without any ray or with a --sampler of flows from noise.",
        ),
    ] = None,
    precision: PrecisionOption = "32-true",
    source: Annotated[
        str | None,
        typer.Option("--from", help="Sensor of the scans, by name or YAML; found in the scans if left out."),
    ] = None,
    to: Annotated[
        str | None, typer.Option(help="Sensor of the answers, by name or YAML; the model's own if left out.")
    ] = None,
    size: SizeOption = None,
    mask: Annotated[
        str | None,
        typer.Option(help="Keep a part of what was measured: rows:4, random:0.5, points:0.1, sector:-30,30, FILE.npy."),
    ] = None,
    fill_gaps: Annotated[
        bool,
        typer.Option("--fill-gaps", help="Take rays without a return as not measured, as in a thinned scan."),
    ] = False,
    reflectance_scale: ScaleChoice = None,
    columns: ColumnsOption = None,
    num: Annotated[int, typer.Option(min=1, help="Answers to each scan.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="An answer depends on seed, scan and its number alone.")] = 0,
    scans: Annotated[
        int | None,
        typer.Option("--scans", min=1, help="Most scans of each folder, evenly spread; all if left out."),
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Answers at once.")] = 1,
    pictures: Annotated[int, typer.Option(min=0, help="Scans that get a picture and a page in 3-D.")] = 8,
    device: DeviceOption = "auto",
) -> None:
    """Complete scans: from fewer beams to more, from a part to the whole.

    Answers are files of the scan's own format. The same command resumes where it stopped.
    """
    from dataclasses import replace

    import numpy as np

    from r2flow.data.opening import named_sensor, reading_for
    from r2flow.data.partial import PartialScan, open_partial
    from r2flow.generators import TransferFlow
    from r2flow.lidar.known import mask_identity, parse_mask
    from r2flow.model.checkpoint import Checkpoint, load_checkpoint
    from r2flow.model.completion import completing
    from r2flow.models import DEFAULT, DENSIFY, MODELS
    from r2flow.reports.completed import Job, answer_ending, lack_sectors, write_completed

    job = Job(num, seed, None if mask is None else parse_mask(mask), fill_gaps, batch_size, pictures, precision)
    sensor = None if source is None else build_sized(source, None)

    def opened(name: str) -> tuple[Checkpoint, list[PartialScan], list[str]]:
        loaded = load_checkpoint(name, device=choose_device(device))
        if to or size:
            loaded = loaded.through(named_sensor(to or loaded.sensor, rows_and_columns(size)))
        reading = replace(reading_for([], loaded), columns=named_columns(columns))
        return loaded, *open_partial(what, reading, sensor, reflectance_scale, scans)

    by_densify = how.given.get("name", "jump") in ("jump", "transport")
    name = str(checkpoint or (DENSIFY if by_densify else DEFAULT))
    loaded, partial, said = opened(name)
    if name == DENSIFY and not (checkpoint or to or size or how.sampler) and lack_sectors(partial, job):
        name = DEFAULT
        loaded, partial, said = opened(name)
    if said and isinstance(loaded.generator, TransferFlow):  # of another sensor, which fills other rows
        loaded = loaded.through(loaded.sensor, numbered=False)
    if checkpoint is None:
        print(f"the model {name}: {MODELS[name].about} (r2flow info {name})")
    sampler = completing(loaded.generator, several=num > 1, **how.given)
    for line in said:
        print(line)
    for ending in sorted({scan.ending for scan in partial if answer_ending(loaded, scan) != scan.ending}):
        print(f"answers to {ending} are written as .ply")
    if not loaded.encoding.reflectance:
        print("the model is of range alone: answers have no reflectance")
    print(f"an answer has at most one point in each pixel of the image, {'x'.join(map(str, loaded.sensor.shape))}")
    about = {
        "mask": mask and mask_identity(mask), "from": source, "reflectance_scale": reflectance_scale,
        "columns": columns,
    }  # fmt: skip
    done = write_completed(loaded, partial, out, job, sampler, about)
    skipped = len(partial) - len(done)
    print(f"{len(done)} scans completed in {out}" + (f", {skipped} were there already" if skipped else ""))
    if errors := [error for error in done.values() if error is not None]:
        (mae, linear), (wrong, wrong_linear) = np.ma.masked_invalid(errors).mean(0).filled(np.nan)
        print(f"on the hidden rays of {len(errors)} scans, with linear interpolation in brackets:")
        off = f"MAE {mae:.2f} m ({linear:.2f}) where all return" if np.isfinite(mae) else "no ray returns in all"
        print(f"{off}, {wrong:.1%} ({wrong_linear:.1%}) wrong in ray-drop")
