"""Reports on flows and solvers: `r2flow report curvature`, `work-precision`, `stability`, `savings`."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import DrawOptions, grouped
from r2flow.cli.options import OutOption, choose_device
from r2flow.cli.output import command, finish, numbers
from r2flow.errors import InputError

OptionalCheckpoint = Annotated[
    Path | None,
    typer.Option("--checkpoint", "-c", help="A checkpoint, a run or a model; exact problems alone if left out."),
]
ProblemsOption = Annotated[str | None, typer.Option(help="Exact problems by name; all if left out, or none.")]


@report.command(epilog="Example: r2flow report curvature -c runs/1rf -c runs/2rf --out reports")
@grouped
def curvature(
    checkpoints: Annotated[
        list[Path], typer.Option("--checkpoint", "-c", help="A checkpoint, a run or a model; may be repeated.")
    ],
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
    loaded = {str(path): load_checkpoint(path, where) for path in dict.fromkeys(checkpoints)}
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

    solvers: Annotated[str | None, typer.Option(help="Solvers, separated by commas; all of ours if left out.")] = None
    budgets: Annotated[str, typer.Option(help="Evaluations of the fixed-step solvers.")] = "4,8,16,32,64"
    tolerances: Annotated[str, typer.Option(help="Of the adaptive solvers.")] = "1e-2,1e-3,1e-4,1e-5"
    problems: ProblemsOption = None
    problem_scenes: Annotated[int, typer.Option(min=1, help="Scans of each exact problem.")] = 16
    repeats: Annotated[int, typer.Option(min=1, help="The most timed solutions of a scan.")] = 9


@dataclass(frozen=True)
class ReferenceOptions:
    """What errors on the checkpoint are measured against."""

    reference_steps: Annotated[int, typer.Option(min=1, help="Of rk4.")] = 128
    reference_tolerance: Annotated[float, typer.Option(min=1e-13, help="Of the dopri5 that confirms it.")] = 1e-7


@report.command("work-precision", epilog="Example: r2flow report work-precision -c runs/NAME --out reports")
@grouped
def work_precision(
    out: OutOption,
    draw: DrawOptions,
    solvers: SolversOptions,
    tight: ReferenceOptions,
    checkpoint: OptionalCheckpoint = None,
) -> None:
    """Error of every solver against evaluations and time, on exact problems and on a checkpoint."""
    from r2flow.flow.solvers import check_tolerance
    from r2flow.generators import as_flow
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.noise import Draws
    from r2flow.progress import Bar
    from r2flow.reports import work_precision as measuring
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.work_precision_page import work_precision_page

    where = choose_device(draw.device)
    names = solvers.solvers.split(",") if solvers.solvers else measuring.METHODS
    budgets = numbers("budgets", solvers.budgets, int)
    chosen = measuring.configurations(names, budgets, numbers("tolerances", solvers.tolerances))
    if not chosen:
        raise InputError(f"--budgets {solvers.budgets} leaves no solver a step; give more evaluations.")
    subjects = measuring.problem_subjects(_problems(solvers.problems), solvers.problem_scenes)
    loaded = None if checkpoint is None else load_checkpoint(checkpoint, where)
    if loaded is None and not subjects:
        raise InputError("nothing to measure: give a checkpoint, or leave --problems none out.")
    check_tolerance(tight.reference_tolerance)
    flow = None if loaded is None else as_flow(loaded.generator, "a work-precision report")
    prepare_folder(out)
    found = name = None
    with only_errors():
        if loaded is not None and flow is not None:
            x_0 = Draws(draw.seed, range(draw.num)).start(flow.noise_shape).to(flow.device)
            with Bar("measuring", draw.num * 4 * tight.reference_steps, "reference evaluations") as advance:
                found = measuring.reference(flow, x_0, tight.reference_steps, tight.reference_tolerance, advance)
            name = str(checkpoint)
            subjects.append(
                measuring.Subject(name, flow, x_0, found.x_1, draw.batch_size, found.floor, loaded.encoding)
            )
        with Bar("measuring", measuring.runs(subjects, chosen, solvers.repeats), "solutions") as advance:
            rows = measuring.measure(subjects, chosen, solvers.repeats, advance)
    seeds = {"scenes": draw.seed, "exact problems": measuring.PROBLEM_SEED}
    page = work_precision_page(rows, name, found, budgets, seeds, command(), where)
    finish(page, out, page.text if found is None else [*page.text[:-3], page.text[-1]])  # without the long table


@report.command(epilog="Example: r2flow report stability --problems stiff_1e4,narrow_jet --out reports")
@grouped
def stability(
    out: OutOption,
    problems: ProblemsOption = None,
    solvers: Annotated[str | None, typer.Option(help="By name, separated by commas; all of ours if left out.")] = None,
    tolerances: Annotated[str, typer.Option(help="Of the adaptive solvers.")] = "1e-3,1e-5",
    steps: Annotated[int, typer.Option(min=1, help="Of the fixed-step solvers.")] = 32,
    scenes: Annotated[int, typer.Option(min=1, help="Scans of each problem; the worst one counts.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of the scans' noise.")] = 0,
    max_evaluations: Annotated[int, typer.Option(min=1, help="Of an adaptive solver, for a scan.")] = 5000,
) -> None:
    """Where solvers fail and whether they say so: exact problems, stiff and extreme, in four precisions."""
    from r2flow.flow.solvers import SOLVERS, check_method
    from r2flow.progress import Bar
    from r2flow.reports import stability as measuring
    from r2flow.reports.pages import prepare_folder

    chosen = solvers.split(",") if solvers else list(SOLVERS)
    for solver in chosen:
        check_method(solver)
    cells = measuring.cells(_problems(problems), chosen, numbers("tolerances", tolerances))
    if not cells:
        raise InputError("nothing to measure: leave --problems none out.")
    prepare_folder(out)
    with only_errors(), Bar("measuring", len(cells), "cells") as advance:
        rows = measuring.stability(cells, steps, scenes, seed=seed, max_evaluations=max_evaluations, progress=advance)
        probe = measuring.jet_probe(seed=seed) if any(row["problem"] == measuring.JET for row in rows) else []
    page = measuring.stability_page(rows, probe, seed, command())
    finish(page, out, page.text[:1])


def _problems(named: str | None) -> list[str]:
    """Names of exact problems.

    Raises:
        InputError: an unknown one.
    """
    from r2flow.flow.problems import PROBLEMS

    names = [] if named == "none" else named.split(",") if named else list(PROBLEMS)
    for name in names:
        PROBLEMS[name]
    return names


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
