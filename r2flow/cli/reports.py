"""`r2flow report`: solvers, curvature, backbones, completion, the paper's tables; and `r2flow
compare`.
"""

import logging
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import InputError
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
    from r2flow.model.checkpoint import Checkpoint
    from r2flow.reports.pages import Page
    from r2flow.reports.tables import Row


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
    from r2flow.base.progress import Bar
    from r2flow.generators import as_flow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.curvature import curvature_page, measure_paths

    where = choose_device(draw.device)
    loaded = {name: load_checkpoint(name, where) for name in dict.fromkeys(models)}
    for name, checkpoint in loaded.items():
        as_flow(checkpoint.generator, f"{name}: curvature")
    check_folder(out)
    evaluations = len(loaded) * math.ceil(draw.num / draw.batch_size) * steps
    how = (draw.num, steps, draw.seed, draw.batch_size)
    with Bar("measuring", evaluations, "evaluations") as advance:
        flows = {
            label: measure_paths(checkpoint, label, *how, progress=advance)
            for label, checkpoint in loaded.items()
        }
    _finish(curvature_page(flows, draw.seed, where), out)


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
        float, Option(min=1, help="Time for more solvers, scans and repetitions.")
    ] = 60,
) -> None:
    """Compare solvers by error against run time, on test problems with exact solutions and on a
    trained flow.

    A first table of usual solvers on one scan comes soon. The page lists the best sampler for each
    error as a command, and what scans of this flow can leave out.
    """
    import time

    from r2flow.base.progress import Bar
    from r2flow.flow.problems import PROBLEMS
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports import solvers as measuring
    from r2flow.reports.pages import print_text
    from r2flow.reports.savings import savings

    where = choose_device(draw.device)
    methods = samplers.split(",") if samplers else measuring.METHODS
    names = problems.split(",") if problems else list(PROBLEMS)
    if problems == "none":
        names = []
    chosen = measuring.configurations(methods, budgets)
    subjects = measuring.problem_subjects(names)
    if not chosen or not (names or model):
        raise InputError(
            "nothing to measure: give a model or more --budgets, or no --problems none."
        )
    check_folder(out)
    logging.getLogger("r2flow.flow").setLevel(logging.ERROR)  # the report counts failed scans
    until = math.inf if samplers else time.monotonic() + seconds
    flow = None
    saved: list[Row] = []
    first: list[Row] = []
    if model is not None:
        loaded = load_checkpoint(model, where)
        flow = measuring.checkpoint_subject(loaded, model, 1, draw.seed, steps=32, tolerance=1e-5)
        usual = measuring.configurations(
            methods if samplers else measuring.USUAL, budgets, measuring.TOLERANCES[:2]
        )
        first = measuring.measure([flow], usual)
        print_text(measuring.flow_text(first, flow))
        saved = savings(loaded.generator, min(draw.num, 4), draw.seed)
        num = measuring.affordable(first, chosen, (until - time.monotonic()) / 2)
        num = min(num, draw.num)
        if num > 0:
            with Bar("measuring", num * 512, "reference evaluations") as advance:
                flow = measuring.checkpoint_subject(
                    loaded, model, num, draw.seed, draw.batch_size, progress=advance
                )
            subjects.insert(0, flow)
            first = []
    with Bar("measuring", len(subjects) * len(chosen), "solutions") as advance:
        rows = first + measuring.measure(subjects, chosen, advance, until)
    page = measuring.solvers_page(rows, flow, budgets, {"scans": draw.seed}, where, saved)
    _finish(page, out)


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
    from r2flow.backbones import configurations
    from r2flow.base.progress import track
    from r2flow.lidar.sensors import named_sensor
    from r2flow.reports.backbones import backbone_costs, print_costs

    chosen = named_sensor(sensor, size)
    where = choose_device(device)
    names = only.split(",") if only else list(configurations())
    rows = backbone_costs(chosen, names, repeats, where)
    print_costs(list(track(rows, "measuring", "backbones", total=len(names))), chosen, where)


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
    from r2flow.base.progress import Bar
    from r2flow.model.completion import completing
    from r2flow.model.inversion import real_scans
    from r2flow.model.shipped import DENSIFY
    from r2flow.reports.completion import TASKS, completion_page, completion_rows, kept_rays

    where = choose_device(device)
    ways = {}
    for name, model in _completers(real, models or [DENSIFY], sensor, size, where).items():
        sampler = completing(model.generator, several=answers > 1, **how.given)
        ways[f"{name}, {sampler}"] = (model, sampler)
    first = next(iter(ways.values()))[0]
    masks = re.split(r"\s*,\s*(?=[a-z]+:)|\s+", tasks.strip()) if tasks else TASKS
    for task in masks:
        kept_rays(task, first.sensor, 0)
    _, images = real_scans(first, [real], reflectance_scale, num, need_reflectance=False)
    truths = [image for image in images.numpy() if image[0].any()]
    if not truths:
        raise InputError(f"{real}: no scan has a return, so there is nothing to hide.")
    check_folder(out)
    batches = len(truths) * math.ceil(answers / batch_size) * len(masks)
    cost = sum(sampler.evaluations(model.generator) or 0 for model, sampler in ways.values())
    given = (truths, first.sensor, ways, masks, answers, seed, batch_size)
    with Bar("completing", batches * cost, "evaluations") as advance:
        rows = list(completion_rows(*given, progress=advance))
    about = f"{len(truths)} scans of {real} (at most {num}, --num), {answers} completions per scan."
    page = completion_page(rows, about, seed, where)
    _finish(page, out)


def _completers(
    real: str, models: list[str], sensor: str | None, size: Any, device: str
) -> "dict[str, Checkpoint]":
    """Models by name; those of any sensor take the sensor of the others, or of the scans."""
    from r2flow.data.opening import describe
    from r2flow.generators import TransferFlow
    from r2flow.lidar.sensors import named_sensor
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.tables import short_names

    names = short_names([Path(name) for name in models])
    loaded = {name: load_checkpoint(path, device) for name, path in zip(names, models, strict=True)}
    stored = describe(real).stored
    fixed = [m.sensor for m in loaded.values() if not isinstance(m.generator, TransferFlow)]
    known = [*fixed, *([stored.sensor] if stored else [])]
    for name, model in loaded.items():
        if isinstance(model.generator, TransferFlow):
            target = named_sensor(sensor or next(iter(known), model.sensor), size)
            loaded[name] = model.through(target)
        elif sensor or size or model.sensor != fixed[0]:
            raise InputError(f"{name} is a model of another sensor or size: report it apart.")
    return loaded


@report.command(epilog="Example: r2flow report paper runs/1rf runs/2rf --results e.json -o paper")
def paper(
    models: Annotated[
        list[str],
        Argument(help="Runs, checkpoint files or models; ROLE=MODEL selects the row."),
    ],
    out: OutOption,
    results: Annotated[
        list[Path] | None,
        Option(help="JSON file of `r2flow evaluate REAL MODEL... --json FILE`; may be repeated."),
    ] = None,
    real: Annotated[str | None, Option(help=f"Real scans for figure 7: {SETS}.")] = None,
    steps: Annotated[int, Option(min=1, help="Euler steps of the paths in figure 8.")] = 256,
    device: DeviceOption = "auto",
) -> None:
    """Reproduce the paper's tables I and II and figures 6 to 8, printed numbers next to those of
    `evaluate`.
    """
    from r2flow.data.opening import open_scans, reading_for
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.paper import PaperRun, paper_page, read_results, role_of
    from r2flow.reports.tables import short_names

    where = choose_device(device)
    rows = read_results(results or [])
    runs = []
    named = [("", text) if Path(text).exists() else _role(text) for text in models]
    labels = short_names([Path(model) for _, model in named])
    for (role, model), label in zip(named, labels, strict=True):
        checkpoint = load_checkpoint(model, where)
        runs.append(PaperRun(role or role_of(checkpoint, label), model, checkpoint))
        if not checkpoint.generator.unconditional:
            raise InputError(f"{model} does not generate scans from noise.")
        if checkpoint.sensor.shape != runs[0].checkpoint.sensor.shape:
            raise InputError(f"{model} makes images of another size than {runs[0].label}.")
    scans = real and open_scans(real, reading_for([real], runs[0].checkpoint))
    check_folder(out)
    _finish(paper_page(runs, rows, scans or None, steps, where), out)


def _role(text: str) -> tuple[str, str]:
    """A role and its model, from ROLE=MODEL."""
    role, equals, model = text.partition("=")
    return (role, model) if equals else ("", text)


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
    from r2flow.reports.compare import compare_page, group_runs, print_comparison
    from r2flow.reports.pages import write_page
    from r2flow.reports.runs import read_runs

    compared = read_runs(runs)
    groups = group_runs(compared) if group else {run.label: [run] for run in compared}
    if out is not None:
        check_folder(out)
    print_comparison(groups, tex=format == "tex")
    if out is not None:
        print(*write_page(compare_page(groups), out), sep="\n")


@app.command(rich_help_panel="Draw", epilog="Example: r2flow calibrate my/scans --sensor mine.yaml")
def calibrate(
    real: Annotated[str, Argument(help=f"A few whole scans: {SETS}.")],
    sensor: Annotated[Path, Option(help="YAML file of their sensor: the factors go into it.")],
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
    from r2flow.base.progress import Bar
    from r2flow.lidar.sensors import read_sensor, write_sensor
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.inversion import real_scans
    from r2flow.reports.calibration import TASKS, trust_of

    own = read_sensor(sensor)
    flow = load_checkpoint(model, choose_device(device)).through(own)
    _, images = real_scans(flow, [real], reflectance_scale, num, need_reflectance=False)
    with Bar("completing", len(images) * len(TASKS), "evaluations") as advance:
        found = trust_of(flow, [*images.numpy()], advance)
    lines = sensor.read_text(encoding="utf-8").splitlines()
    said = [line for line in lines if line.startswith("#") and "error_factors" not in line]
    about = f"error_factors: r2flow calibrate, {model}, {len(images)} scans"
    comment = "\n".join(line.removeprefix("#").strip() for line in [*said[:-1], about])
    write_sensor(replace(own, error_factors=found.factors), sensor, comment)
    first, second = found.factors
    print(
        f"{found.points:,} added points: {found.shares[0]:.1%} within error_68, "
        f"{found.shares[1]:.1%} within error_95; error_factors [{first:.3f}, {second:.3f}] in "
        f"{sensor}"
    )
