"""`r2flow report paper`: the paper's tables and figures from runs and checkpoints."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.options import SETS, DeviceOption, OutOption, choose_device
from r2flow.errors import InputError


@report.command(epilog="Example: r2flow report paper runs/1rf runs/2rf --results speed --real kitti360/test -o paper")
def paper(
    models: Annotated[list[str], typer.Argument(help="Runs, checkpoint files or models; ROLE=MODEL sets the row.")],
    out: OutOption,
    results: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of `r2flow evaluate REAL -c MODEL --out FOLDER`; may be repeated."),
    ] = None,
    real: Annotated[str | None, typer.Option(help=f"Real scans for figures 3, 5 and 7: {SETS}.")] = None,
    num: Annotated[int, typer.Option(min=1, help="Scans of each model in figures 5 and 7.")] = 16,
    paths: Annotated[int, typer.Option(min=0, help="Scans whose paths figure 8 follows; 0 leaves it out.")] = 4,
    steps: Annotated[int, typer.Option(min=1, help="Euler steps of these paths.")] = 256,
    repeats: Annotated[int, typer.Option(min=0, help="Timed evaluations of each network for table II.")] = 3,
    device: DeviceOption = "auto",
) -> None:
    """The paper's tables I and II and figures 3 and 5 to 8: its printed numbers next to those of `evaluate`."""
    from r2flow.cli.output import command, finish
    from r2flow.data.opening import open_scans, reading_for
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.paper import PaperRun, paper_page, read_results, role_of

    where = choose_device(device)
    files = [folder / "speed_quality.json" for folder in results or []]
    if missing := [file for file in files if not file.is_file()]:
        raise InputError(f"--results: {missing[0]} does not exist; r2flow evaluate REAL -c MODEL --out writes it.")
    runs = []
    for text in models:
        role, _, model = text.rpartition("=")
        checkpoint = load_checkpoint(model, where)
        if not checkpoint.generator.draws:
            raise InputError(f"{model} is an autoencoder and draws no scans.")
        runs.append(PaperRun(role or role_of(checkpoint, Path(model).stem), model, checkpoint))
    scans = None if real is None else open_scans(real, reading_for([], runs[0].checkpoint))
    prepare_folder(out)
    page = paper_page(runs, read_results(files), scans, num, paths, steps, repeats, command(), where)
    finish(page, out, page.text[:1])
