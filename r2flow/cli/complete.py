"""`r2flow complete`: a scan from a part of a scan."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import SamplerOptions, grouped
from r2flow.cli.options import (
    SETS,
    ColumnsOption,
    DeviceOption,
    OutOption,
    PrecisionOption,
    SizeOption,
    build_sized,
    choose_device,
    named_columns,
    rows_and_columns,
)


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
            "without any ray or with --sampler.",
        ),
    ] = None,
    precision: PrecisionOption = "32-true",
    source: Annotated[
        str | None,
        typer.Option("--from", help="Sensor of the scans, by name or YAML; found in the scans if left out."),
    ] = None,
    to: Annotated[
        str | None, typer.Option(help="Sensor of the answers, by name or YAML, of a model for any; the model's own.")
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
    reflectance_scale: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1e9, help="Value in the files that means full reflectance; found if left out."),
    ] = None,
    columns: ColumnsOption = None,
    num: Annotated[int, typer.Option(min=1, help="Answers to each scan.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="An answer depends on seed, scan and its number alone.")] = 0,
    scans: Annotated[
        int | None, typer.Option("--scans", min=1, help="The most scans of each folder, evenly spread; all.")
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

    name = str(checkpoint or (DEFAULT if how.sampler else DENSIFY))
    loaded, partial, said = opened(name)
    if name == DENSIFY and not (checkpoint or to or size) and lack_sectors(partial, job):
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
        off = [error["mae_m"] for error in errors if not np.isnan(error["mae_m"])]
        mae = f"MAE {np.mean(off):.2f} m where both return" if off else "no ray returns in both"
        wrong = np.mean([error["drop_wrong"] for error in errors])
        print(f"on the hidden rays of {len(errors)} scans: {mae}; {wrong:.1%} of the rays wrong in ray-drop")
