"""A flow for programs that have no r2flow: `r2flow export`."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.groups import SolverOptions, grouped
from r2flow.cli.options import FlattenOption
from r2flow.errors import InputError


@app.command(epilog="Example: r2flow export runs/NAME --to onnx --steps 8 --out flow.onnx")
@grouped
def export(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file, a run folder or a model.")],
    solver: SolverOptions,
    to: Annotated[str, typer.Option(help="onnx for onnxruntime and its like, or pt2 for torch.")] = "onnx",
    what: Annotated[str, typer.Option(help="sampler: noise in, scan out; or network: v(t, x) alone.")] = "sampler",
    grid: Annotated[
        str | None, typer.Option(help="Where the steps fall: uniform, power:P, power-start:P or late:K.")
    ] = None,
    flatten: FlattenOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write; NAME.onnx or NAME.pt2 if left out.")
    ] = None,
) -> None:
    """Write a flow as one file that runs without r2flow: noise in, range in metres, reflectance and points out.

    The number of steps is fixed by the file. The file is run and compared with the flow.
    """
    from r2flow.generators import Sampler
    from r2flow.model import export as writing
    from r2flow.model.checkpoint import load_checkpoint

    writing.FORMATS[to]
    if what not in ("sampler", "network"):
        raise InputError(f"--what must be sampler or network, found {what!r}.")
    network = what == "network"
    if network and (solver != SolverOptions() or grid or flatten is not None):
        raise InputError("--what network has no sampler: leave solver, steps, tolerance, grid and flatten out.")
    loaded = load_checkpoint(checkpoint)
    sampler: Sampler = solver.change(writing.flow_of(loaded).sampler, grid=grid, flatten=flatten)
    if out is None:
        out = Path(f"{checkpoint.stem if checkpoint.is_file() else checkpoint.resolve().name}.{to}")
    elif out.suffix != f".{to}":
        raise InputError(f"--to {to} writes a .{to}, found --out {out}.")
    written = writing.export(loaded, out, sampler, network)
    size = f"{out.stat().st_size / 1e6:.1f} MB"
    batch = "any batch" if written.any_batch else "one scan at a time, torch could not free its batch"
    if network:
        print(f"{out}: {size}, the network v(t, x), {batch}")
        return
    print(f"{out}: {size}, {sampler.method} with {sampler.steps} steps, {batch}")
    try:
        apart = writing.compare(loaded, written, sampler)
    except InputError as missing:
        print(f"not compared with the flow: {missing}")
        return
    print(
        f"compared with the flow: range within {1000 * apart.metres:.2g} mm, reflectance within "
        f"{apart.reflectance:.2g}, {apart.rays} rays dropped by one alone"
    )
