"""`r2flow report`: solvers, curvature, backbones, completion, the paper's tables; and `r2flow compare`."""

import logging
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app, report
from r2flow.cli.options import (
    SETS,
    DeviceOption,
    DrawOptions,
    OutOption,
    SamplerOptions,
    ScaleChoice,
    SensorChoice,
    SensorOption,
    SizeOption,
    grouped,
    numbers,
    rows_and_columns,
)
from r2flow.devices import choose_device
from r2flow.errors import check, check_folder

if TYPE_CHECKING:
    from r2flow.reports.pages import Page


def finish(page: "Page", out: Path, parts: Sequence[str]) -> None:
    """Write a page; print the given parts and the paths of its files."""
    from r2flow.reports.pages import write_page

    print("\n\n".join(parts), "", *write_page(page, out), sep="\n")


@report.command(epilog="Example: r2flow report curvature runs/1rf runs/2rf --out reports")
@grouped
def curvature(
    models: Annotated[list[str], typer.Argument(help="Models, run folders or checkpoint files.")],
    out: OutOption,
    draw: DrawOptions,
    steps: Annotated[int, typer.Option(min=1, help="Euler steps per path.")] = 256,
) -> None:
    """Measure the straightness s(t) of trained flows; plot paths of the most curved pixels (the paper's figure 8)."""
    from r2flow.generators import as_flow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.progress import Bar
    from r2flow.reports.curvature import curvature_page, measure_paths

    where = choose_device(draw.device)
    loaded = {name: load_checkpoint(name, where) for name in dict.fromkeys(models)}
    for name, checkpoint in loaded.items():
        as_flow(checkpoint.generator, f"{name}: curvature")
    check_folder(out)
    with Bar("measuring", len(loaded) * math.ceil(draw.num / draw.batch_size) * steps, "evaluations") as advance:
        flows = {
            label: measure_paths(checkpoint, label, draw.num, steps, draw.seed, draw.batch_size, progress=advance)
            for label, checkpoint in loaded.items()
        }
    page = curvature_page(flows, draw.seed, where)
    finish(page, out, page.text)


@report.command(epilog="Example: r2flow report solvers runs/NAME --out reports")
@grouped
def solvers(
    out: OutOption,
    draw: DrawOptions,
    model: Annotated[
        str | None, typer.Argument(help="A model, a run folder or a checkpoint file. Default: test problems only.")
    ] = None,
    samplers: Annotated[str | None, typer.Option(help="Solvers, separated by commas. Default: all built-in.")] = None,
    budgets: Annotated[str, typer.Option(help="Evaluations of fixed-step solvers.")] = "4,8,16,32,64",
    problems: Annotated[str | None, typer.Option(help="Test problems by name, or none. Default: all.")] = None,
) -> None:
    """Compare solvers by error against run time, on test problems with exact solutions and on a trained flow.

    The page lists the best sampler for each error as a command.
    """
    from r2flow.flow.problems import PROBLEMS
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.progress import Bar
    from r2flow.reports import solvers as measuring

    check(model or draw == DrawOptions(device=draw.device), "--num, --seed, --batch-size are of a model; found none.")
    where = choose_device(draw.device)
    methods = samplers.split(",") if samplers else measuring.METHODS
    names = [] if problems == "none" else problems.split(",") if problems else list(PROBLEMS)
    most = numbers("budgets", budgets)
    chosen, subjects, flow = measuring.configurations(methods, most), measuring.problem_subjects(names), None
    check(chosen and (names or model), "nothing to measure: give a model or more --budgets, or no --problems none.")
    check_folder(out)
    logging.getLogger("r2flow.flow").setLevel(logging.ERROR)  # the report counts failed scans
    if model is not None:
        loaded = load_checkpoint(model, where)
        with Bar("measuring", draw.num * 512, "reference evaluations") as advance:
            flow = measuring.checkpoint_subject(loaded, model, draw.num, draw.seed, draw.batch_size, progress=advance)
        subjects.append(flow)
    with Bar("measuring", len(subjects) * len(chosen), "solutions") as advance:
        rows = measuring.measure(subjects, chosen, advance)
    page = measuring.solvers_page(rows, flow, most, {"scans": draw.seed}, where)
    finish(page, out, page.text[:-2])  # without the long table


@report.command(epilog="Example: r2flow report backbones --size 64x1024")
def backbones(
    only: Annotated[str | None, typer.Option(help="Configurations, separated by commas. Default: all.")] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    repeats: Annotated[int, typer.Option(min=0, help="Timed evaluations per configuration; 0: no latency.")] = 3,
    device: DeviceOption = "auto",
) -> None:
    """List parameters, multiply-accumulates and latency of all backbone configurations (the paper's table II)."""
    from r2flow.backbones import configurations
    from r2flow.lidar.sensors import named_sensor
    from r2flow.progress import track
    from r2flow.reports.backbones import backbone_costs, print_costs

    chosen, where = named_sensor(sensor, rows_and_columns(size)), choose_device(device)
    names = only.split(",") if only else list(configurations())
    rows = backbone_costs(chosen, names, repeats, where)
    measured = list(track(rows, "measuring", "backbones", total=len(names), least=0 if repeats else 99))
    check(any("error" not in row for row in measured), measured[0].get("error", ""))
    print_costs(measured, chosen, where)


@report.command(epilog="Example: r2flow report completion kitti360/test street --num 15 --out reports")
def completion(
    real: Annotated[str, typer.Argument(help=f"Complete scans: {SETS}.")],
    models: Annotated[
        list[str] | None, typer.Argument(help="Models, run folders or checkpoint files. Default: densify.")
    ] = None,
    tasks: Annotated[
        str | None, typer.Option(help="Masks such as rows:4, separated by spaces or commas. Default: five masks.")
    ] = None,
    samplers: Annotated[str | None, typer.Option(help="Samplers of the models, such as mmps,replace.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps per sampler.")] = None,
    num: Annotated[int, typer.Option(min=1, help="Maximum number of scans, evenly spaced over the set.")] = 16,
    answers: Annotated[int, typer.Option(min=1, help="Completions per scan; 19 give 90 % intervals.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise; masks do not depend on it.")] = 0,
    batch_size: Annotated[int, typer.Option(min=1, help="Completions per batch.")] = 4,
    sensor: SensorChoice = None,
    size: SizeOption = None,
    reflectance_scale: ScaleChoice = None,
    device: DeviceOption = "auto",
    out: OutOption = Path("reports"),
) -> None:
    """Mask scans and complete them by models and by interpolation: errors against evaluations."""
    from r2flow.data.opening import own_reading
    from r2flow.generators import TransferFlow
    from r2flow.inversion import real_scans
    from r2flow.lidar.sensors import named_sensor
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.completion import completing
    from r2flow.models import DENSIFY
    from r2flow.progress import Bar
    from r2flow.reports.compare import labels
    from r2flow.reports.completion import TASKS, completion_page, completion_rows, measured_by, pictured
    from r2flow.samplers import split_samplers

    paths, where = [Path(name) for name in models or [DENSIFY]], choose_device(device)
    loaded = {name: load_checkpoint(path, where) for name, path in zip(labels(paths), paths, strict=True)}
    stored = own_reading(real)
    own = next((m.sensor for m in loaded.values() if not isinstance(m.generator, TransferFlow)), None)
    for name, model in loaded.items():
        other = (own or (stored and stored.sensor)) if isinstance(model.generator, TransferFlow) else None
        if sensor or size or other:
            loaded[name] = model.through(named_sensor(sensor or other or model.sensor, rows_and_columns(size)))
        check(own in (None, loaded[name].sensor), f"{name} is a model of another sensor or size: report it apart.")
    chosen = [
        (name, model, completing(model.generator, several=answers > 1, **SamplerOptions(sampler, steps).given))
        for name, model in loaded.items()
        for sampler in (split_samplers(samplers) if samplers else [None])
    ]
    names = [f"{name}, {sampler}" for name, _, sampler in chosen]
    ways = {
        short if names.count(short) == 1 else f"{name} ({sampler.text}), {sampler}": (model, sampler)
        for short, (name, model, sampler) in zip(names, chosen, strict=True)
    }
    first = next(iter(loaded.values()))
    masks = re.split(r"\s*,\s*(?=[a-z]+:)|\s+", tasks.strip()) if tasks else list(TASKS)
    for task in masks:
        measured_by(task, first.sensor, 0)
    _, images = real_scans(first, [real], reflectance_scale, num, need_reflectance=False)
    truths = [image for image in images.numpy() if image[0].any()]
    check(truths, f"{real}: no scan has a return, so there is nothing to hide.")
    check_folder(out)
    cost = sum(sampler.evaluations(model.generator) or 0 for model, sampler in ways.values()) * len(masks)
    with Bar("completing", len(truths) * -(-answers // batch_size) * cost, "evaluations") as advance:
        shown = list(completion_rows(truths, first.sensor, ways, masks, answers, seed, batch_size, progress=advance))
    about = f"{len(truths)} scans of {real} (at most {num}, --num), {answers} completions per scan."
    page = completion_page([row for row, _ in shown], pictured(truths[0], shown, first.sensor), about, seed, where)
    finish(page, out, [about, *page.text[1:]])


@report.command(epilog="Example: r2flow report paper runs/1rf runs/2rf --results e.json --real kitti360/test -o paper")
def paper(
    models: Annotated[list[str], typer.Argument(help="Runs, checkpoint files or models; ROLE=MODEL selects the row.")],
    out: OutOption,
    results: Annotated[
        list[Path] | None,
        typer.Option(help="JSON file of `r2flow evaluate REAL MODEL... --json FILE`; may be repeated."),
    ] = None,
    real: Annotated[str | None, typer.Option(help=f"Real scans for figures 3, 5 and 7: {SETS}.")] = None,
    num: Annotated[int, typer.Option(min=1, help="Scans per model in figures 5 and 7.")] = 16,
    steps: Annotated[int, typer.Option(min=1, help="Euler steps of the paths in figure 8.")] = 256,
    device: DeviceOption = "auto",
) -> None:
    """Reproduce the paper's tables I and II and figures 3 and 5 to 8, printed numbers next to those of `evaluate`."""
    from r2flow.data.opening import open_scans, reading_for
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.compare import labels
    from r2flow.reports.paper import PaperRun, paper_page, read_results, role_of

    where = choose_device(device)
    rows, runs = read_results(results or []), []
    named = [text.partition("=") if "=" in text and not Path(text).exists() else ("", "", text) for text in models]
    for (role, _, model), label in zip(named, labels([Path(model) for *_, model in named]), strict=True):
        checkpoint = load_checkpoint(model, where)
        check(checkpoint.generator.draws, f"{model} does not generate scans from noise.")
        runs.append(PaperRun(role or role_of(checkpoint, label), model, checkpoint))
        alike = checkpoint.sensor.shape == runs[0].checkpoint.sensor.shape
        check(alike, f"{model} makes images of another size than {runs[0].label}: report it apart.")
    scans = None if real is None else open_scans(real, reading_for([real], runs[0].checkpoint))
    check_folder(out)
    page = paper_page(runs, rows, scans, num, steps, where)
    finish(page, out, page.text[:1])


@app.command(epilog="Example: r2flow compare runs/sweep --group --out reports")
def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, or folders of runs (a chain, a sweep).")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for compare.md, .json and .png.")] = None,
    group: Annotated[bool, typer.Option("--group", help="Join the seeds of a configuration: mean ± spread.")] = False,
) -> None:
    """Compare runs: loss, bend, parameters, cost."""
    from r2flow.reports.compare import compare_page, group_runs, read_runs, tables
    from r2flow.reports.pages import write_page
    from r2flow.reports.tables import print_table

    compared = read_runs(runs)
    groups = group_runs(compared) if group else {run.label: [run] for run in compared}
    if out is not None:
        check_folder(out)
    for title, (cells, headings) in tables(groups).items():
        print_table(cells, headings, title)
        print()
    differ = {k for k in ("images", "stage", "loss", "data") if len({run.values[k] for run in compared} - {None}) > 1}
    if "images" in differ:
        print("the runs have seen different numbers of images: compare their curves at equal steps")
    if differ - {"images"}:
        print("the runs have different stages, losses or data: compare them by r2flow evaluate, not by their losses")
    if out is not None:
        print(*write_page(compare_page(groups), out), sep="\n")
