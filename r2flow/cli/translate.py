"""`r2flow translate`: scans with the ray-drop and reflectance of a real sensor."""

from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import ReadingOptions, SamplerOptions, grouped
from r2flow.cli.options import SETS, DeviceOption, OutOption, choose_device


@app.command(epilog="Example: r2flow translate simulated --to runs/sensor --out real_looking")
@grouped
def translate(
    what: Annotated[str, typer.Argument(metavar="SCANS", help=f"Scan files of any simulator: {SETS}.")],
    to: Annotated[
        str, typer.Option(help="A model of experiment=sensor: a run folder or a checkpoint.", show_default=False)
    ],
    out: OutOption,
    how: SamplerOptions,
    reading: ReadingOptions,
    format: Annotated[str, typer.Option(help="Any of bin,ply,pcd, or npy: the range image.")] = "bin",
    scans: Annotated[int | None, typer.Option("--scans", min=1, help="At most so many scans; all.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Scan i depends on the seed and on i alone.")] = 0,
    device: DeviceOption = "auto",
) -> None:
    """Give simulated scans a real sensor's ray-drop and reflectance. Geometry and labels stay.

    The same command resumes where it stopped.
    """
    from dataclasses import replace

    from r2flow.data.opening import open_scans
    from r2flow.errors import InputError
    from r2flow.generators import SensorFlow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.translated import write_translated

    formats = tuple(dict.fromkeys(format.split(",")))
    if unknown := [name for name in formats if name not in ("bin", "ply", "pcd", "npy")]:
        raise InputError(f"--format must be of bin, ply, pcd and npy, found {unknown[0]!r}.")
    model = load_checkpoint(to, choose_device(device))
    if not isinstance(model.generator, SensorFlow):
        raise InputError(f"{to} is a {type(model.generator).__name__}: --to needs a model of experiment=sensor.")
    sampler = model.generator.choose(**how.given)
    seen = replace(reading.reading([], model), reflectance=False)
    found = open_scans(what, seen, num=scans)
    done = write_translated(model, found, out, formats, seed, sampler)
    kept = len(found.source) - done
    print(f"{done} scans ({', '.join(formats)}) in {out}" + (f", {kept} were there already" if kept else ""))
