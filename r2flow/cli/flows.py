"""Verbs for trained flows and their backbones."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.options import CheckpointOption, OutOption, SensorOption, SizeOption, build_sized, choose_device


@app.command(epilog="Example: r2flow sample --checkpoint runs/simulated-hdit_tiny --num 16 --steps 64 --out scans")
def sample(
    checkpoint: CheckpointOption,
    out: OutOption,
    num: Annotated[int, typer.Option(min=1, help="Number of scans.")] = 4,
    steps: Annotated[int, typer.Option(min=1, help="Equal steps from noise to data.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Scan i depends on the seed and on i alone.")] = 0,
    solver: Annotated[str, typer.Option(help="euler, midpoint, heun2, heun3, rk4, torchdiffeq:dopri5, ...")] = "euler",
    tolerance: Annotated[float, typer.Option(help="Of an adaptive solver.")] = 1e-5,
    format: Annotated[str | None, typer.Option(help="Any of ply,bin,npy; all that fit if left out.")] = None,
    pictures: Annotated[int, typer.Option(min=0, help="Scans that get a picture.")] = 8,
    batch_size: Annotated[int, typer.Option(min=1, help="Scans at once.")] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1, ...")] = "auto",
) -> None:
    """Draw scans from a trained flow: point clouds, range images and pictures."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.reports.outputs import FORMATS, write_samples

    loaded = load_checkpoint(checkpoint, device=choose_device(device))
    formats = format.split(",") if format else [f for f in FORMATS if loaded.encoding.reflectance or f != "bin"]
    write_samples(loaded, out, num, steps, seed, solver, formats, pictures, batch_size, tolerance)
    seen = f", pictures in {out / 'samples.png'}" if pictures else ""
    print(f"{num} scans ({', '.join(formats)}) in {out}{seen}")


@app.command(epilog="Example: r2flow info runs/simulated-hdit_tiny")
def info(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file or a run folder.")],
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Say what is in a checkpoint."""
    from r2flow.reports.contents import describe, print_contents

    contents = describe(checkpoint)
    if json:
        import json as encoder

        print(encoder.dumps(contents, indent=2))
    else:
        print_contents(contents)


@app.command(epilog="Example: r2flow convert r2flow-kitti360-1rf.pth 1rf.safetensors")
def convert(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file of any format, or a run folder.")],
    out: Annotated[Path, typer.Argument(help="What to write: .safetensors (ours) or .pth (the published format).")],
) -> None:
    """Write a model's averaged weights and config in the other format, the weights bit-equal."""
    from r2flow.checkpoints import load_checkpoint, save_checkpoint

    save_checkpoint(load_checkpoint(checkpoint), out)
    print(out)


@app.command(epilog="Example: r2flow backbones --size 64x1024")
def backbones(
    only: Annotated[str | None, typer.Option(help="Names, separated by commas; all if left out.")] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    channels: Annotated[int, typer.Option(min=1, help="Channels of the image.")] = 2,
    repeats: Annotated[int, typer.Option(min=0, help="Timed evaluations of each; 0 leaves the latency out.")] = 3,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, ...")] = "auto",
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Parameters, multiply-accumulates and measured latency of every configuration: the paper's table II."""
    from rich.progress import track

    from r2flow.backbones import CONFIGURATIONS
    from r2flow.reports.backbones import backbone_costs, print_costs

    chosen, where = build_sized(sensor, size), choose_device(device)
    names = only.split(",") if only else list(CONFIGURATIONS)
    rows = backbone_costs(chosen, names, channels, repeats, where)
    measured = list(track(rows, "measuring", total=len(names), disable=json or repeats == 0, transient=True))
    if json:
        import json as encoder

        print(encoder.dumps(measured, indent=2))
    else:
        print_costs(measured, chosen, where)
