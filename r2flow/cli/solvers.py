"""`r2flow report solvers`, `curvature` and `backbones`: accuracy, straightness and cost of flows."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from json import dumps as to_json
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import DrawOptions, grouped
from r2flow.cli.options import DeviceOption, OutOption, SensorOption, SizeOption, build_sized, choose_device
from r2flow.cli.output import command, finish, numbers
from r2flow.errors import InputError


@report.command(epilog="Example: r2flow report curvature runs/1rf runs/2rf --out reports")
@grouped
def curvature(
    models: Annotated[list[str], typer.Argument(help="Models, run folders or checkpoint files.")],
    out: OutOption,
    draw: DrawOptions,
    steps: Annotated[int, typer.Option(min=1, help="Euler steps of a path.")] = 256,
    most_curved: Annotated[int, typer.Option(min=1, help="Pixels whose paths are drawn.")] = 200,
) -> None:
    """How straight trained flows are: s(t), and the paths of the most curved pixels (the paper's figure 8)."""
    from r2flow.generators import as_flow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.model.sampling import batches
    from r2flow.progress import Bar
    from r2flow.reports.curvature import curvature_page, measure_paths
    from r2flow.reports.pages import prepare_folder

    where = choose_device(draw.device)
    loaded = {name: load_checkpoint(name, where) for name in dict.fromkeys(models)}
    for checkpoint in loaded.values():
        as_flow(checkpoint.generator, "curvature")
    prepare_folder(out)
    with Bar("measuring", len(loaded) * batches(draw.num, draw.batch_size) * 2 * steps, "evaluations") as advance:
        flows = [
            measure_paths(checkpoint, label, draw.num, steps, draw.seed, draw.batch_size, most_curved, advance)
            for label, checkpoint in loaded.items()
        ]
    page = curvature_page(flows, draw.seed, command(), where)
    finish(page, out, page.text)


@dataclass(frozen=True)
class SolversOptions:
    """What is compared, and on which exact problems."""

    samplers: Annotated[str | None, typer.Option(help="Solvers, separated by commas; all of ours if left out.")] = None
    budgets: Annotated[str, typer.Option(help="Evaluations of the fixed-step solvers.")] = "4,8,16,32,64"
    tolerances: Annotated[str, typer.Option(help="Of the adaptive solvers.")] = "1e-2,1e-3,1e-4,1e-5"
    problems: Annotated[str | None, typer.Option(help="Exact problems by name; all if left out, or none.")] = None
    repeats: Annotated[int, typer.Option(min=1, help="The most timed solutions of a scan.")] = 5


@report.command(epilog="Example: r2flow report solvers runs/NAME --out reports")
@grouped
def solvers(
    out: OutOption,
    draw: DrawOptions,
    options: SolversOptions,
    model: Annotated[
        str | None, typer.Argument(help="A model, a run or a checkpoint; exact problems alone if left out.")
    ] = None,
) -> None:
    """Error against run time of every solver: exact problems, stiff and extreme ones too, and a trained flow.

    The page names the sampler that reaches a wanted error, as a command.
    """
    from r2flow.flow.problems import PROBLEMS
    from r2flow.flow.solvers import method_of
    from r2flow.generators import as_flow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.progress import Bar
    from r2flow.reports import solvers as measuring
    from r2flow.reports.pages import prepare_folder

    where = choose_device(draw.device)
    methods = options.samplers.split(",") if options.samplers else list(measuring.METHODS)
    for method in methods:
        method_of(method)
    problems = [] if options.problems == "none" else options.problems.split(",") if options.problems else list(PROBLEMS)
    for problem in problems:
        PROBLEMS[problem]
    budgets, tolerances = numbers("budgets", options.budgets, int), numbers("tolerances", options.tolerances)
    chosen = measuring.configurations(methods, budgets, tolerances)
    if not chosen or not (problems or model):
        raise InputError("nothing to measure: give a model, more --budgets, or leave --problems none out.")
    loaded = None if model is None else load_checkpoint(model, where)
    if loaded is not None:
        as_flow(loaded.generator, "report solvers")
    prepare_folder(out)
    subjects, flow = measuring.problem_subjects(problems), None
    with only_errors():
        if loaded is not None:
            with Bar("measuring", draw.num * 512, "reference evaluations") as advance:
                flow = measuring.checkpoint_subject(
                    loaded, str(model), draw.num, draw.seed, draw.batch_size, progress=advance
                )
        everything = [*subjects, flow] if flow else subjects
        with Bar("measuring", len(everything) * len(chosen), "solutions") as advance:
            rows = measuring.measure(everything, chosen, options.repeats, advance)
        with Bar("judging", 0, "solutions") as advance:
            verdicts = measuring.judge(problems, methods, progress=advance)
    page = measuring.solvers_page(rows, verdicts, flow, budgets, {"scans": draw.seed}, command(), where)
    finish(page, out, page.text[: -(2 + 3 * bool(verdicts))])  # without the long tables


@report.command(epilog="Example: r2flow report backbones --size 64x1024")
def backbones(
    only: Annotated[str | None, typer.Option(help="Names, separated by commas; all if left out.")] = None,
    sensor: SensorOption = "hdl64e",
    size: SizeOption = None,
    channels: Annotated[int, typer.Option(min=1, help="Channels of the image.")] = 2,
    repeats: Annotated[int, typer.Option(min=0, help="Timed evaluations of each; 0 leaves the latency out.")] = 3,
    device: DeviceOption = "auto",
    json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Parameters, multiply-accumulates and measured latency of every configuration: the paper's table II."""
    from r2flow.backbones import configurations
    from r2flow.progress import track
    from r2flow.reports.backbones import backbone_costs, print_costs

    chosen, where = build_sized(sensor, size), choose_device(device)
    names = only.split(",") if only else list(configurations())
    rows = backbone_costs(chosen, names, channels, repeats, where)
    measured = list(track(rows, "measuring", "backbones", total=len(names), least=0 if repeats else 99))
    print(to_json(measured, indent=2)) if json else print_costs(measured, chosen, where)


@contextmanager
def only_errors() -> Iterator[None]:
    """No warnings about scans that a solver gave up on: the report counts them."""
    log = logging.getLogger("r2flow.flow")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
