"""`r2flow complete`: a scan from a part of a scan."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import SolverOptions, grouped
from r2flow.cli.options import (
    SETS,
    ColumnsOption,
    DeviceOption,
    OutOption,
    PrecisionOption,
    SurfacesOption,
    build_sized,
    choose_device,
    named_columns,
)
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.model.checkpoint import Checkpoint


@dataclass(frozen=True)
class KnownOptions:
    """What is known of the scans."""

    source: Annotated[
        str | None,
        typer.Option("--from", help="Sensor of the scans, by name or YAML; found in the scans if left out."),
    ] = None
    target: Annotated[
        str | None, typer.Option("--to", help="Sensor of the answers; the model's, which it must be.")
    ] = None
    mask: Annotated[
        str | None,
        typer.Option(help="Keep a part of what was measured: rows:4, random:0.5, points:0.1, sector:-30,30, FILE.npy."),
    ] = None
    fill_gaps: Annotated[
        bool,
        typer.Option("--fill-gaps", help="Take rays without a return as not measured, as in a thinned scan."),
    ] = False
    surfaces: SurfacesOption = True
    reflectance_scale: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e9, help="Value in the files that means full reflectance; found if left out."),
    ] = None
    columns: ColumnsOption = None


@dataclass(frozen=True)
class AnswerOptions:
    """How many answers, and where they are computed."""

    num: Annotated[int, typer.Option(min=1, help="Answers to each scan.")] = 1
    seed: Annotated[int, typer.Option(min=0, help="An answer depends on seed, scan and its number alone.")] = 0
    scans: Annotated[
        int | None, typer.Option("--scans", min=1, help="The most scans of each folder, evenly spread; all.")
    ] = None
    batch_size: Annotated[int, typer.Option(min=1, help="Answers at once.")] = 1
    pictures: Annotated[int, typer.Option(min=0, help="Scans that get a picture and a page in 3-D.")] = 8
    device: DeviceOption = "auto"


@app.command(epilog="Example: r2flow complete scan.pcd --from vlp16 --to hdl64e --num 8 --out dense")
@grouped
def complete(
    what: Annotated[list[str], typer.Argument(metavar="SCANS...", help=f"Scan files, range images (.npy), or {SETS}.")],
    out: OutOption,
    known: KnownOptions,
    answers: AnswerOptions,
    solver: SolverOptions,
    checkpoint: Annotated[
        Path | None,
        typer.Option("--checkpoint", "-c", help="A checkpoint file, a run folder or a model; street if left out."),
    ] = None,
    precision: PrecisionOption = None,
) -> None:
    """Complete scans: from fewer beams to more, from a part to the whole.

    Answers are files of the scan's own format. The same command resumes where it stopped.
    """
    from dataclasses import replace

    import numpy as np

    from r2flow.data.partial import open_partial
    from r2flow.evaluation.sets import reading_of_flow
    from r2flow.lidar.known import mask_identity, parse_mask
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.completion import completing
    from r2flow.models import DEFAULT, MODELS, find_model
    from r2flow.reports.completed import WRITTEN, Job, answer_ending, write_completed

    if checkpoint is None:
        print(f"the model {DEFAULT}: {MODELS[DEFAULT].about} (r2flow info {DEFAULT})")
    mask = None if known.mask is None else parse_mask(known.mask)
    source = None if known.source is None else build_sized(known.source, None)
    loaded = load_checkpoint(checkpoint or find_model(DEFAULT), device=choose_device(answers.device))
    _check_target(loaded, known.target)
    reading = replace(reading_of_flow(loaded), columns=named_columns(known.columns))
    scans, said = open_partial(what, reading, source, known.reflectance_scale, answers.scans)
    sampler = completing(loaded.generator, solver.change(completing(loaded.generator), precision=precision))
    for line in said:
        print(line)
    for ending in sorted({scan.ending for scan in scans if answer_ending(loaded, scan) != scan.ending}):
        why = "no answer of a model of range alone" if ending in WRITTEN else "read but not written"
        print(f"{ending} is {why}: answers are .ply ({', '.join(WRITTEN)} are written)")
    if not loaded.encoding.reflectance:
        print("the model is of range alone: answers have no reflectance")
    rows, columns = loaded.sensor.shape
    print(
        f"an answer has one point in a pixel of the model's image, {rows}x{columns}: {rows * columns} at most; of "
        "several measured points in a pixel it keeps the nearest"
    )
    job = Job(answers.num, answers.seed, mask, known.fill_gaps, answers.batch_size, known.surfaces, answers.pictures)
    about = {
        "mask": known.mask and mask_identity(known.mask), "from": known.source,
        "reflectance_scale": known.reflectance_scale, "columns": known.columns,
    }  # fmt: skip
    done = write_completed(loaded, scans, out, job, sampler, about)
    skipped = len(scans) - len(done)
    print(f"{len(done)} scans completed in {out}" + (f", {skipped} were there already" if skipped else ""))
    errors = [error for error in done.values() if error is not None]
    if errors:
        off = [error["mae_m"] for error in errors if not np.isnan(error["mae_m"])]
        apart = f"MAE {np.mean(off):.2f} m where both return" if off else "no hidden ray returns in both"
        wrong = np.mean([error["drop_wrong"] for error in errors])
        print(
            f"to the truth of {len(errors)} scans, on the rays that the mask hid: {apart}; {wrong:.1%} of the rays "
            "return in one alone"
        )


def _check_target(loaded: "Checkpoint", target: str | None) -> None:
    """Refuse a sensor that is not the model's."""
    if target is None:
        return
    sensor = loaded.sensor
    asked = build_sized(target, None)
    if sensor.elevations not in (asked.elevations, asked.resized(sensor.shape[0]).elevations):
        size = "x".join(map(str, sensor.shape))
        raise InputError(
            f"--to {target}: the model makes images of {sensor.name}, {size}; leave --to out, or give a model of "
            f"{asked.name} by -c."
        )
