"""`r2flow sample` and `interpolate`."""

from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import InputError, check
from r2flow.base.files import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import (
    DeviceOption,
    DrawOptions,
    LabelIdsOption,
    ModelArgument,
    OutOption,
    SamplerOptions,
    ScaleChoice,
    grouped,
    print_model,
    several,
)

if TYPE_CHECKING:
    from r2flow.model.checkpoint import Checkpoint


@app.command(
    rich_help_panel="Draw", epilog="Example: r2flow sample street --num 16 --steps 64 --out scans"
)
@grouped
def sample(
    out: OutOption,
    draw: DrawOptions,
    how: SamplerOptions,
    model: Annotated[
        str | None, Argument(help="A model, a run folder or a checkpoint file.")
    ] = None,
    precision: Annotated[
        Literal["32-true", "bf16-mixed"] | None,
        Option(
            help="Precision of the network. Default: bf16-mixed for street on a CPU with bfloat16, "
            "else 32-true."
        ),
    ] = None,
    format: Annotated[
        str | None, Option(help="Formats, of ply,bin,npy. Default: all possible.")
    ] = None,
    pictures: Annotated[int, Option(min=0, help="Number of scans to draw as pictures.")] = 8,
    labels: Annotated[
        str | None, Option(help="A labelled model that labels the points: NAME.label.")
    ] = None,
    label_ids: LabelIdsOption = None,
) -> None:
    """Sample scans from a trained model (default: `street`): point clouds, range images and
    pictures.

    The default sampler is the generator's.
    """
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.completion import usual_precision
    from r2flow.model.shipped import DEFAULT, find_model
    from r2flow.reports.outputs import write_samples

    check_folder(out)
    if model is None:
        print_model(DEFAULT)
    loaded = load_checkpoint(model or find_model(DEFAULT), device=choose_device(draw.device))
    sampler = loaded.generator.choose(**how.fields)
    formats = [*dict.fromkeys(format.split(","))] if format else None
    endings = write_samples(
        loaded,
        out,
        draw.num,
        draw.seed,
        sampler,
        formats,
        pictures,
        draw.batch_size,
        precision=precision or usual_precision(loaded.generator, model in (None, DEFAULT)),
        labels=_labelling(labels, loaded) if labels else None,
        label_ids=label_ids,
    )
    there = len(list(out.glob(f"[0-9]*.{endings[0]}")))
    more = f", next to {there - draw.num} of an earlier command" if there > draw.num else ""
    print(f"{several(draw.num)} ({', '.join(endings)}) in {out}{more}")
    if pictures:
        print(f"pictures in {out / 'samples.png'}, in 3-D in {out / 'samples.html'}")


def _labelling(name: str, drawn: "Checkpoint") -> "Checkpoint":
    """The labelled model of a name, for the scans of another one."""
    from r2flow.model.checkpoint import load_checkpoint

    model = load_checkpoint(name, drawn.generator.device)
    check(model.encoding.labels, f"{name} has no labels: give --labels labels.")
    return model.through(drawn.sensor)


@app.command(
    rich_help_panel="Draw",
    epilog="Example: r2flow interpolate runs/NAME 100.bin 250.bin --frames 6 --out between",
)
@grouped
def interpolate(
    model: ModelArgument,
    first: Annotated[str, Argument(help="A scan file or a range image (.npy).")],
    last: Annotated[str, Argument(help="A second scan file or range image.")],
    out: OutOption,
    sampling: SamplerOptions,
    frames: Annotated[int, Option(min=2, help="Number of scans, both ends included.")] = 6,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
) -> None:
    """Interpolate between two real scans in noise space: a figure and a point cloud per frame.

    Default solver: dopri5 with tolerance 1e-4; with --steps or --grid, the flow's own.
    """
    from r2flow.generators.flow import as_flow, ode_sampler
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.inversion import real_scans
    from r2flow.reports.interpolation import interpolation
    from r2flow.reports.pages import write_page
    from r2flow.samplers import Adaptive, build_sampler

    loaded = load_checkpoint(model, choose_device(device))
    flow = as_flow(loaded.generator, "interpolation")
    fields = sampling.fields
    if "name" in fields:
        sampler = build_sampler(fields)
    elif sampling.steps or sampling.grid:
        sampler = ode_sampler(flow).changed(**fields)
    else:
        sampler = Adaptive(tolerance=sampling.tolerance or 1e-4)
    sampler.check(flow)
    names, pair = real_scans(loaded, [first, last], reflectance_scale)
    if len(names) != 2:
        raise InputError(f"give two scans, found {len(names)}.")
    check_folder(out)
    written = write_page(interpolation(loaded, names, pair, frames, out, sampler), out)
    print(f"{frames} scans in {out / 'frames'}", *written, out / "interpolation.html", sep="\n")
