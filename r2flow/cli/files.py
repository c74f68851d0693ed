"""`r2flow export` and `info`."""

import logging
from hashlib import sha256
from json import dumps as to_json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from r2flow.base.errors import InputError, check
from r2flow.base.files import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import ModelArgument, SamplerOptions, SizeOption, grouped

if TYPE_CHECKING:
    from r2flow.model.checkpoint import Checkpoint

_LABELS = {"few": "in fewer steps"}  # of `info`


@app.command(
    rich_help_panel="Files",
    epilog="Example: r2flow export runs/NAME --to onnx --steps 8 --out flow.onnx",
)
@grouped
def export(
    checkpoint: ModelArgument,
    how: SamplerOptions,
    to: Annotated[
        Literal["onnx", "pt2", "safetensors", "web"],
        Option(
            help="onnx (onnxruntime and others), pt2 (torch), safetensors (r2flow), or web: a "
            "folder with a page that completes scans in the browser."
        ),
    ] = "onnx",
    what: Annotated[
        Literal["sampler", "network"],
        Option(help="sampler: noise to scan; network: only v(t, x)."),
    ] = "sampler",
    source: Annotated[
        str | None,
        Option("--from", help="Of densify: sensor of the scans to complete, name or YAML file."),
    ] = None,
    sensor: Annotated[
        str | None,
        Option(
            help="Of densify: sensor of the completed scans, whose limits hold. Default: as of "
            "r2flow complete."
        ),
    ] = None,
    size: SizeOption = None,
    half: Annotated[
        bool,
        Option(
            "--half",
            help="Store large weights of a .safetensors file in float16: half the size.",
        ),
    ] = False,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File to write. Default: NAME.onnx, ...")
    ] = None,
) -> None:
    """Export a flow as a file that runs without r2flow: from noise to range in metres, reflectance
    and points; densify: from the points of a scan to those of the completed one.

    The file has a fixed number of steps; r2flow runs it and compares it with the flow. --to
    safetensors writes the averaged weights, config and sampler of any generator, reproducibly.
    """
    from r2flow.generators import RectifiedFlow, TransferFlow
    from r2flow.model import export as writing
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.saving import save_checkpoint

    network = what == "network"
    name = checkpoint.stem if checkpoint.is_file() else checkpoint.resolve().name
    if to == "web":
        _export_web(checkpoint, out or Path("try"), source)
        return
    out = out or Path(f"{name}-network.{to}" if network else f"{name}.{to}")
    if out.suffix != f".{to}" or out.is_dir():
        raise InputError(f"--to {to} writes a .{to}, found --out {out}.")
    loaded = load_checkpoint(checkpoint)
    check_folder(out.parent)
    if to == "safetensors":
        if out.exists() and out.samefile(loaded.path):
            raise InputError(f"{out} is the model itself and would be replaced; give another name.")
        save_checkpoint(loaded, out, half)
        digest = sha256(out.read_bytes()).hexdigest()
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, SHA-256 {digest}")
        return
    logging.getLogger("r2flow.model.export").setLevel(logging.INFO)
    if isinstance(loaded.generator, TransferFlow):
        if source is None:
            raise InputError("name the sensor of the scans: --from vlp16, or its YAML file.")
        check(not (network or how.fields), "densify is exported whole, as one jump.")
        _export_completion(loaded, out, source, sensor, size)
        return
    check(
        not (source or sensor or size),
        "--from, --sensor and --size are for models that complete, as densify.",
    )
    # Other generators are refused whatever their sampler.
    sampler = None
    if isinstance(loaded.generator, RectifiedFlow):
        sampler = loaded.generator.choose(**how.fields)
    written = writing.export(loaded, out, sampler, network)
    content = "the network v(t, x)" if network else sampler
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {content}")
    if not network:
        print(f"compared with the flow: {writing.compare(loaded, written, sampler)}")


def _export_web(checkpoint: Path, out: Path, source: str | None) -> None:
    """Write the page for the usual sensors, or for one."""
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.web import SENSORS, write_web

    write_web(load_checkpoint(checkpoint), out, [source] if source else SENSORS)
    print(f"{out}: python -m http.server --directory {out}, then open http://localhost:8000")


def _export_completion(
    model: "Checkpoint", out: Path, source: str, sensor: str | None, size: Any
) -> None:
    """Export a transfer flow for scans of a sensor, completed in the view of `complete`."""
    from r2flow.data.seeing import seeing_all
    from r2flow.lidar.sensors import named_sensor
    from r2flow.model.completion_export import compare_completion, export_completion

    seen = named_sensor(source)
    view = named_sensor(sensor or model.sensor, size)
    if not sensor:
        view = seeing_all(seen, view) or view
    model = model.through(view)
    written = export_completion(model, out, seen)
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, scans of {seen.name} to {view}")
    print(f"returns from {view.min_range:g} to {view.max_range:g} m are used")
    print(f"compared with the flow: {compare_completion(model, written, seen)}")


@app.command(
    rich_help_panel="Files",
    epilog="Example: r2flow info runs/simulated-hdit_tiny",
)
def info(
    checkpoint: Annotated[
        Path | None,
        Argument(
            help="A checkpoint file, a run folder or a model. Default: list models and networks."
        ),
    ] = None,
    json: Annotated[bool, Option("--json", help="Print JSON, with the whole config.")] = False,
    add: Annotated[
        tuple[str, Path] | None,
        Option(metavar="NAME FILE", help="Install a feature network from its file or folder."),
    ] = None,
) -> None:
    """Print the contents of a checkpoint, or list the models and the feature networks of published
    metrics.

    r2flow does not download networks: get the published file, then --add it. It is loaded as
    tensors only, checked and stored in R2FLOW_WEIGHTS (default ~/.cache/r2flow/weights).
    """
    from r2flow.metrics.extractors.base import add as install
    from r2flow.metrics.extractors.base import kept_file
    from r2flow.reports.contents import describe, print_known
    from r2flow.reports.tables import print_table, words

    if add is not None:
        name, path = add
        print(f"{kept_file(name)}: weights {install(name, path)} of {path.name}")
    elif checkpoint is None:
        print_known()
    elif json:
        print(to_json(describe(checkpoint), indent=2))
    else:
        about = describe(checkpoint)
        del about["config"]  # of --json
        rows = [
            (_LABELS.get(key, key), words(x) if isinstance(x, dict) else str(x))
            for key, x in about.items()
            if x is not None
        ]
        print_table(rows, ("", ""))
