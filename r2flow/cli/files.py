"""`r2flow export`, `info` and `weights`."""

import logging
from hashlib import sha256
from json import dumps as to_json
from pathlib import Path
from typing import Annotated, Literal

import typer

from r2flow.cli.app import app
from r2flow.cli.options import SamplerOptions, grouped
from r2flow.errors import InputError, check, check_folder


@app.command(epilog="Example: r2flow export runs/NAME --to onnx --steps 8 --out flow.onnx")
@grouped
def export(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file, a run folder or a model.")],
    how: SamplerOptions,
    to: Annotated[
        str, typer.Option(help="onnx (onnxruntime and others), pt2 (torch) or safetensors (r2flow).")
    ] = "onnx",
    what: Annotated[
        Literal["sampler", "network"], typer.Option(help="sampler: noise to scan; network: only v(t, x).")
    ] = "sampler",
    half: Annotated[
        bool, typer.Option("--half", help="Store large weights of a .safetensors file in float16: half the size.")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write. Default: NAME.onnx, ...")] = None,
) -> None:
    """Export a flow as a file that runs without r2flow: from noise to range in metres, reflectance and points.

    The file has a fixed number of steps; r2flow runs it and compares it with the flow. --to safetensors writes the
    averaged weights, config and sampler of any generator, reproducibly.
    """
    from r2flow.generators import RectifiedFlow
    from r2flow.model import export as writing
    from r2flow.model.checkpoint import load_checkpoint, save_checkpoint

    name = checkpoint.stem if checkpoint.is_file() else checkpoint.resolve().name
    out = out or Path(f"{name}{'-network' * (what == 'network')}.{to}")
    check(to in (*writing.FORMATS, "safetensors"), f"no export format named {to!r}; known: onnx, pt2, safetensors.")
    check(out.suffix == f".{to}" and not out.is_dir(), f"--to {to} writes a .{to}, found --out {out}.")
    check(not half or to == "safetensors", "--half is for --to safetensors.")
    check(what == "sampler" or to != "safetensors", "--what network is for --to onnx and --to pt2.")
    if (to == "safetensors" or what == "network") and how != SamplerOptions():
        raise InputError("a network or .safetensors takes no sampler: leave sampler, steps, tolerance and grid out.")
    loaded = load_checkpoint(checkpoint)
    if to == "safetensors":
        if out.exists() and out.samefile(loaded.path):
            raise InputError(f"{out} is the model itself and would be replaced; give another name.")
        save_checkpoint(loaded, out, half)
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, SHA-256 {sha256(out.read_bytes()).hexdigest()}")
        return
    # Other generators are refused whatever their sampler.
    sampler = loaded.generator.choose(**how.given) if isinstance(loaded.generator, RectifiedFlow) else None
    check_folder(out.parent)
    logging.getLogger("r2flow.model.export").setLevel(logging.INFO)
    written = writing.export(loaded, out, sampler, what == "network")
    batch = "any batch" if written.any_batch else "batch of one scan (torch could not export a variable batch)"
    content = "the network v(t, x)" if what == "network" else sampler
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {content}, {batch}")
    if what == "sampler":
        difference = writing.compare(loaded, written, sampler)
        print(
            f"compared with the flow: range within {difference.metres:.2g} m, reflectance within "
            f"{difference.reflectance:.2g}, {difference.rays} rays differ in ray-drop"
        )


@app.command(epilog="Example: r2flow info runs/simulated-hdit_tiny")
def info(
    checkpoint: Annotated[Path, typer.Argument(help="A checkpoint file, a run folder or a model.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the contents of a checkpoint."""
    from r2flow.reports.contents import describe, print_contents

    contents = describe(checkpoint)
    if json:
        print(to_json(contents, indent=2))
    else:
        print_contents(contents)


@app.command(epilog="Example: r2flow weights --add rangenet53 darknet53-1024.tar.gz")
def weights(
    add: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Install a network from its file or folder."),
    ] = None,
) -> None:
    """List the models, and the feature networks of published metrics: which are installed, and where to get others.

    r2flow does not download: get a network's file, then --add it. It is loaded as tensors only, checked and stored in
    R2FLOW_WEIGHTS (default ~/.cache/r2flow/weights).
    """
    from r2flow.metrics import FIELD_NAMES
    from r2flow.metrics.extractors.base import SOURCES, kept, kept_file, weights_folder
    from r2flow.metrics.extractors.base import add as take
    from r2flow.models import MODELS
    from r2flow.reports.tables import print_table

    if add is not None:
        name, path = add
        print(f"{kept_file(name)}: weights {take(name, path)} of {path.name}")
        return
    print_table([(name, model.about) for name, model in MODELS.items()], ("model", "samples"))
    print()
    rows = [(name, FIELD_NAMES[name].upper(), kept(name) or "no", Path(page).name) for name, page in SOURCES.items()]
    print_table(rows, ("network", "distance", "installed", "published file"))
    print(f"\nLooked for in {weights_folder()} (R2FLOW_WEIGHTS). Install one: r2flow weights --add NAME FILE")
    for name, page in SOURCES.items():
        print(f"  {name}: {page}")
