"""r2flow VERB: what is done with scans and checkpoints from the command line."""

import logging
import os
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from r2flow.errors import InputError, explain_mistake

# Imports of torch and matplotlib stay inside the verbs: --help and a mistyped option answer at once.

app = typer.Typer(
    help="Rectified flows for LiDAR scans. Train with train.py; sample, show and measure here.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

# Its home is click in older releases of typer and typer itself in newer ones.
USAGE_ERROR: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

report = typer.Typer(help="Measure scans and flows.", no_args_is_help=True, pretty_exceptions_enable=False)
app.add_typer(report, name="report")

CheckpointOption = Annotated[
    Path, typer.Option("--checkpoint", "-c", help="A checkpoint file or a run folder.", show_default=False)
]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.", show_default=False)]
SensorOption = Annotated[str, typer.Option(help="Name of the sensor.")]
SizeOption = Annotated[str | None, typer.Option(help="Rows x columns, as 64x1024; the sensor's own if left out.")]
ProjectionOption = Annotated[str, typer.Option(help="spherical or unfolding.")]
ConventionOption = Annotated[str, typer.Option(help="centre, or reference for the published models'.")]
ScaleOption = Annotated[float, typer.Option(min=1e-6, help="Value in the file that means full reflectance, often 255.")]


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


@app.command(epilog="Example: r2flow show scans/000000.ply velodyne/0000000100.bin --out views")
def show(
    files: Annotated[list[Path], typer.Argument(help="Scan files, range images (.npy), or folders of them.")],
    out: OutOption,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: Annotated[
        float | None, typer.Option(help="Value in the file that means full reflectance; guessed if left out.")
    ] = None,
    most: Annotated[int, typer.Option(min=1, help="The most scans to draw of a folder.")] = 16,
) -> None:
    """Draw scans: range, reflectance, bird's-eye view and perspective, a PNG each."""
    from r2flow.reports.pictures import save_figure, scan_figure
    from r2flow.reports.views import open_view, scans_of

    if projection == "unfolding" and sensor == "hdl64e":
        sensor = "hdl64e_rings"  # rows are rings then, and these are not evenly spaced
    chosen = build_sized(sensor, size)
    paths = [path for file in files for path in scans_of(file, most)]
    for path in paths:
        image, rays = open_view(path, chosen, projection, reflectance_scale)
        written = save_figure(scan_figure(image, rays, path.name), out / f"{unique_stem(path, paths)}.png")
        print(written)


@app.command(
    epilog="Example: r2flow project velodyne/0000000100.bin --projection unfolding --size 64x1024 --out image.npy"
)
def project(
    scan: Annotated[Path, typer.Argument(help="A scan file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npy to write.", show_default=False)],
    projection: ProjectionOption = "spherical",
    convention: ConventionOption = "centre",
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    reflectance_scale: ScaleOption = 1.0,
) -> None:
    """Project a scan to a range image: float32 (2, H, W), range in metres and reflectance, 0 where missing."""
    import numpy as np

    from r2flow.files import atomic_write
    from r2flow.reports.views import project_file

    image = project_file(scan, build_sized(sensor, size), projection, convention, reflectance_scale)
    with atomic_write(out) as file:
        np.save(file, image)
    returns = int((image[0] > 0).sum())
    print(f"{out}: {image.shape[1]} x {image.shape[2]}, {returns} returns ({returns / image[0].size:.1%})")


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


@report.command(epilog="Example: r2flow report fidelity kitti360/test runs/real/samples --train raw --size 64x1024")
def fidelity(
    real: Annotated[Path, typer.Argument(help="Real scans: a folder.")],
    other: Annotated[Path, typer.Argument(help="Scans to judge: a folder of any known format, or range images.")],
    train: Annotated[Path | None, typer.Option(help="The scans that were learned from.")] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    projection: ProjectionOption = "spherical",
    reflectance_scale: ScaleOption = 1.0,
    most: Annotated[int, typer.Option(min=1, help="The most scans of a folder, evenly spread over it.")] = 1000,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for fidelity.md and .json.")] = None,
) -> None:
    """Set scans against real ones, beside controls that know nothing of scenes: noise, flat ground, mean, shuffle."""
    import json

    from r2flow.files import atomic_write
    from r2flow.reports.fidelity import fidelity as measure
    from r2flow.reports.fidelity import load_images, markdown

    chosen = build_sized(sensor, size)
    load = partial(load_images, sensor=chosen, projection=projection, reflectance_scale=reflectance_scale, most=most)  # type: ignore[arg-type]
    training = None if train is None else load(train)
    judged, truth = load(other), load(real)
    text = markdown(result := measure(truth, judged, chosen, training), "judged")
    print(text)
    if out is not None:
        for name, content in (("fidelity.md", text + "\n"), ("fidelity.json", json.dumps(result, indent=2))):
            with atomic_write(out / name, "w") as file:
                file.write(content)


def build_sized(sensor: str, size: str | None) -> "Sensor":  # type: ignore[name-defined] # noqa: F821
    """The sensor at an image size written as 64x1024."""
    from r2flow.lidar.sensors import build_sensor

    if size is None:
        return build_sensor(sensor)
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--size must be ROWSxCOLUMNS, as 64x1024; found {size!r}.")
    return build_sensor(sensor, int(parts[0]), int(parts[1]))


def choose_device(name: str) -> str:
    """`auto` takes a GPU where there is one."""
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.device(name)
    except RuntimeError:
        raise InputError(f"--device must be auto, cpu, cuda, cuda:1, ...; found {name!r}.") from None
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"--device {name}, but torch sees no GPU here; use --device cpu.")
    return name


def unique_stem(path: Path, paths: list[Path]) -> str:
    """The file's stem, with its folder's name where two files share one."""
    shared = sum(other.stem == path.stem for other in paths) > 1
    return f"{path.parent.name}_{path.name.replace('.', '_')}" if shared else path.stem


def main() -> None:
    """Run a verb; what the user can mend is one line and exit code 2."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", force=True)
    try:
        code = app(standalone_mode=False)
    except BrokenPipeError:  # r2flow ... | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except (InputError, OSError) as error:
        print(f"error: {explain_mistake(error)}", file=sys.stderr)
        sys.exit(2)
    except USAGE_ERROR as error:
        print(f"error: {error.format_message()} See --help.", file=sys.stderr)
        sys.exit(2)
    except typer.Abort:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)
