"""`r2flow report`, `compare` and `calibrate`: each is a function of `r2flow.reports`."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import check
from r2flow.base.files import check_folder
from r2flow.cli.app import app, report
from r2flow.cli.options import (
    SETS,
    BatchOption,
    DeviceOption,
    DrawOptions,
    OutOption,
    SamplerOptions,
    ScaleChoice,
    SeedOption,
    SensorChoice,
    SensorOption,
    SizeOption,
    grouped,
    parse_counts,
)

if TYPE_CHECKING:
    from r2flow.reports.pages import Page


def _finish(page: "Page", out: Path) -> None:
    """Print the text of a page; write it."""
    from r2flow.reports.pages import print_text, write_page

    print_text(page.text)
    print(*write_page(page, out), sep="\n")


@report.command(epilog="Example: r2flow report curvature runs/1rf runs/2rf --out reports")
@grouped
def curvature(
    models: Annotated[list[str], Argument(help="Models, run folders or checkpoint files.")],
    out: OutOption,
    draw: DrawOptions,
    steps: Annotated[int, Option(min=1, help="Euler steps per path.")] = 256,
) -> None:
    """Measure the straightness s(t) of trained flows; plot paths of the most curved pixels (the
    paper's figure 8).
    """
    from r2flow.reports.curvature import report_curvature

    device = choose_device(draw.device)
    check_folder(out)
    _finish(report_curvature(models, draw.num, steps, draw.seed, draw.batch_size, device), out)


@report.command(epilog="Example: r2flow report solvers runs/NAME --out reports")
@grouped
def solvers(
    out: OutOption,
    draw: DrawOptions,
    model: Annotated[
        str | None,
        Argument(help="A model, a run folder or a checkpoint file. Default: test problems only."),
    ] = None,
    samplers: Annotated[
        str | None, Option(help="Solvers, separated by commas. Default: all built-in.")
    ] = None,
    budgets: Annotated[
        Any,
        Option(parser=parse_counts, metavar="N,N,...", help="Evaluations of fixed-step solvers."),
    ] = "4,8,16,32,64",
    problems: Annotated[
        str | None, Option(help="Test problems by name, or none. Default: all.")
    ] = None,
    seconds: Annotated[
        float, Option(min=1, help="Time for more solvers and scans than a few; about.")
    ] = 60,
) -> None:
    """Compare solvers by error against run time, on test problems with exact solutions and on a
    trained flow.

    The page lists the best sampler for each error as a command.
    """
    from r2flow.flow.problems import PROBLEMS
    from r2flow.reports.solvers import report_solvers

    device = choose_device(draw.device)
    methods = samplers.split(",") if samplers else None
    names = problems.split(",") if problems else list(PROBLEMS)
    if problems == "none":
        names = []
    check_folder(out)
    scans = (draw.num, draw.seed, draw.batch_size)
    _finish(report_solvers(model, methods, budgets, names, *scans, seconds, device), out)


@report.command(epilog="Example: r2flow report backbones --size 64x1024")
def backbones(
    only: Annotated[
        str | None, Option(help="Configurations, separated by commas. Default: all.")
    ] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    repeats: Annotated[
        int, Option(min=0, help="Timed evaluations per configuration; 0: no latency.")
    ] = 3,
    device: DeviceOption = "auto",
) -> None:
    """List parameters, multiply-accumulates and latency of all backbone configurations (the paper's
    table II).
    """
    from r2flow.lidar.sensors import named_sensor
    from r2flow.reports.backbones import report_backbones
    from r2flow.reports.pages import print_text

    names = only.split(",") if only else None
    measured = named_sensor(sensor, size)
    print_text(report_backbones(measured, names, repeats, choose_device(device)).text)


@report.command(
    epilog="Example: r2flow report completion kitti360/test street --num 15 --out reports"
)
@grouped
def completion(
    real: Annotated[str, Argument(help=f"Complete scans: {SETS}.")],
    how: SamplerOptions,
    models: Annotated[
        list[str] | None,
        Argument(help="Models, run folders or checkpoint files. Default: densify."),
    ] = None,
    tasks: Annotated[
        str | None,
        Option(help="Masks such as rows:4, separated by spaces or commas. Default: five masks."),
    ] = None,
    num: Annotated[
        int, Option(min=1, help="Maximum number of scans, evenly spread over the set.")
    ] = 16,
    answers: Annotated[
        int, Option(min=1, help="Completions per scan; 19 give 90 % intervals.")
    ] = 1,
    seed: SeedOption = 0,
    batch_size: BatchOption = 4,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
    out: OutOption = Path("reports"),
) -> None:
    """Mask scans and complete them by models and by interpolation: errors against evaluations."""
    from r2flow.model.shipped import DENSIFY
    from r2flow.reports.completion import TASKS, report_completion

    masks = re.split(r"\s*,\s*(?=[a-z]+:)|\s+", tasks.strip()) if tasks else TASKS
    device = choose_device(device)
    check_folder(out)
    page = report_completion(
        real,
        models or [DENSIFY],
        masks,
        num,
        answers,
        seed,
        batch_size,
        sensor,
        size,
        reflectance_scale,
        device,
        **how.fields,
    )
    _finish(page, out)


@report.command(epilog="Example: r2flow report paper runs/1rf runs/2rf --results e.json -o paper")
def paper(
    models: Annotated[
        list[str],
        Argument(help="Runs, checkpoint files or models; ROLE=MODEL selects the row."),
    ],
    results: Annotated[
        list[Path],
        Option(help="JSON file of `r2flow evaluate REAL MODEL... --json FILE`; may be repeated."),
    ],
    out: OutOption,
) -> None:
    """Reproduce the paper's table I and figure 6, printed numbers next to those of `evaluate`."""
    from r2flow.reports.paper import report_paper

    check_folder(out)
    _finish(report_paper(models, results), out)


@app.command(
    rich_help_panel="Measure", epilog="Example: r2flow compare runs/sweep --group --out reports"
)
def compare(
    runs: Annotated[
        list[Path], Argument(help="Run folders, or folders of runs (a chain, a sweep).")
    ],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for compare.md, .json and .png.")
    ] = None,
    group: Annotated[
        bool, Option("--group", help="Join the seeds of a configuration: mean ± spread.")
    ] = False,
    format: Annotated[
        Literal["text", "tex"], Option(help="Of the printed tables; tex: LaTeX with booktabs.")
    ] = "text",
) -> None:
    """Compare runs: loss, bend, parameters, cost."""
    from r2flow.reports.compare import report_runs
    from r2flow.reports.pages import print_text, write_page
    from r2flow.reports.tables import Table, latex

    if out is not None:
        check_folder(out)
    page = report_runs(runs, group)
    if format == "tex":
        print(*(latex(*part) for part in page.text if isinstance(part, Table)), sep="\n")
    else:
        print_text(page.text)
    if out is not None:
        print(*write_page(page, out), sep="\n")


@app.command(rich_help_panel="Draw", epilog="Example: r2flow calibrate my/scans --sensor mine.yaml")
def calibrate(
    real: Annotated[str, Argument(help=f"A few whole scans: {SETS}.")],
    sensor: Annotated[str, Option(help="Their sensor: a YAML file, or a name with --out.")],
    out: Annotated[
        Path | None,
        Option("--out", "-o", help="YAML file for the factors. Default: that of the sensor."),
    ] = None,
    model: Annotated[
        str, Option("--checkpoint", "-c", help="The model whose errors are compared.")
    ] = "densify",
    num: Annotated[int, Option(min=1, help="Maximum number of scans, evenly spread.")] = 16,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
) -> None:
    """Improve the errors of added points for your own sensor: rows of its scans are hidden, and
    the factors that hold the truth are written into its file.
    """
    from r2flow.lidar.sensors import ENDINGS
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.calibration import calibrate as calibrate_sensor

    file = out or Path(sensor)
    is_yaml = file.suffix.lower() in ENDINGS
    check(is_yaml, f"{file} cannot hold the factors: give --out {file.stem}_mine.yaml.")
    flow = load_checkpoint(model, choose_device(device))
    trust = calibrate_sensor(flow, real, sensor, file, num, reflectance_scale)
    (first, second), (near, far) = trust.factors, trust.shares
    print(
        f"{trust.points:,} added points by {sensor}: {near:.1%} within error_68, {far:.1%} within "
        f"error_95; new error_factors [{first:.3f}, {second:.3f}] in {file}"
    )
