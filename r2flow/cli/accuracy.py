"""Reports on flows and solvers: `r2flow report curvature`, `work-precision`, `stability`."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.options import OutOption, choose_device
from r2flow.cli.output import command, finish, numbers
from r2flow.errors import InputError
from r2flow.progress import Bar


@report.command(epilog="Example: r2flow report curvature runs/1rf runs/2rf --out reports")
def curvature(
    checkpoints: Annotated[list[Path], typer.Argument(help="Checkpoint files or run folders.")],
    out: OutOption,
    steps: Annotated[int, typer.Option(min=1, help="Euler steps of a path.")] = 256,
    num: Annotated[int, typer.Option(min=1, help="Scenes.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Scene i depends on the seed and on i alone.")] = 0,
    most_curved: Annotated[int, typer.Option(min=1, help="Pixels whose paths are drawn.")] = 200,
    batch_size: Annotated[int, typer.Option(min=1, help="Scenes at once.")] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, ...")] = "auto",
) -> None:
    """How straight trained flows are: s(t), and the paths of the most curved pixels (the paper's figure 8)."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.reports.curvature import curvature_page, measure_paths
    from r2flow.reports.pages import prepare_folder
    from r2flow.sampling import batches

    where = choose_device(device)
    loaded = {str(path): load_checkpoint(path, where) for path in dict.fromkeys(checkpoints)}
    prepare_folder(out)
    with Bar("measuring", len(loaded) * batches(num, batch_size) * 2 * steps, "evaluations") as advance:
        flows = [
            measure_paths(checkpoint, label, num, steps, seed, batch_size, most_curved, advance)
            for label, checkpoint in loaded.items()
        ]
    finish(curvature_page(flows, seed, command(), where), out)


@report.command("work-precision", epilog="Example: r2flow report work-precision runs/simulated-hdit_tiny --out reports")
def work_precision(
    out: OutOption,
    checkpoint: Annotated[
        Path | None, typer.Argument(help="A checkpoint file or a run folder; the exact problems alone if left out.")
    ] = None,
    num: Annotated[int, typer.Option(min=1, help="Scenes of the checkpoint.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Scene i depends on the seed and on i alone.")] = 0,
    methods: Annotated[str | None, typer.Option(help="Solvers, separated by commas; all of ours if left out.")] = None,
    budgets: Annotated[str, typer.Option(help="Evaluations of the fixed-step solvers.")] = "4,8,16,32,64",
    tolerances: Annotated[str, typer.Option(help="Of the adaptive solvers.")] = "1e-2,1e-3,1e-4,1e-5",
    problems: Annotated[str | None, typer.Option(help="Exact problems by name; all if left out, or none.")] = None,
    problem_scenes: Annotated[int, typer.Option(min=1, help="Scenes of each exact problem.")] = 16,
    repeats: Annotated[int, typer.Option(min=1, help="The most timed solutions of a scene.")] = 9,
    reference_steps: Annotated[int, typer.Option(min=1, help="Of the rk4 that the checkpoint is judged by.")] = 128,
    reference_tolerance: Annotated[float, typer.Option(min=1e-13, help="Of the dopri5 that confirms it.")] = 1e-7,
    batch_size: Annotated[int, typer.Option(min=1, help="Scenes of the checkpoint at once.")] = 1,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda, ...")] = "auto",
) -> None:
    """Error of every solver against evaluations and time, on exact problems and on a checkpoint."""
    from r2flow.checkpoints import load_checkpoint
    from r2flow.flow.solvers import check_tolerance
    from r2flow.generators import as_flow
    from r2flow.reports import work_precision as measuring
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.work_precision_page import work_precision_page

    where = choose_device(device)
    names = methods.split(",") if methods else measuring.METHODS
    asked = numbers("budgets", budgets, int)
    chosen = measuring.configurations(names, asked, numbers("tolerances", tolerances))
    if not chosen:
        raise InputError(f"--budgets {budgets} leaves no solver a step; give more evaluations.")
    wanted = [] if problems == "none" else problems.split(",") if problems else list(measuring.PROBLEMS)
    subjects = measuring.problem_subjects(wanted, problem_scenes)
    loaded = None if checkpoint is None else load_checkpoint(checkpoint, where)
    if loaded is None and not subjects:
        raise InputError("nothing to measure: give a checkpoint, or leave --problems none out.")
    check_tolerance(reference_tolerance)
    prepare_folder(out)
    found = None
    with only_errors():
        if loaded is not None:
            x_0 = measuring.starts(loaded, num, seed)
            with Bar("measuring", num * 4 * reference_steps, "reference evaluations") as advance:
                found = measuring.reference(
                    as_flow(loaded.generator, measuring.NAME), x_0, reference_steps, reference_tolerance, advance
                )
            subjects.append(measuring.checkpoint_subject(loaded, str(checkpoint), found, num, seed, batch_size))
        with Bar("measuring", measuring.runs(subjects, chosen, repeats), "solutions") as advance:
            rows = measuring.measure(subjects, chosen, repeats, advance)
    seeds = {"scenes": seed, "exact problems": measuring.PROBLEM_SEED}
    name = None if checkpoint is None else str(checkpoint)
    finish(work_precision_page(rows, name, found, seeds, command(), where, asked), out)


@report.command(epilog="Example: r2flow report stability --problems stiff_1e4,narrow_jet --out reports")
def stability(
    out: OutOption,
    problems: Annotated[str | None, typer.Option(help="Exact problems by name; all if left out.")] = None,
    solvers: Annotated[str | None, typer.Option(help="By name, separated by commas; all of ours if left out.")] = None,
    tolerances: Annotated[str, typer.Option(help="Of the adaptive solvers.")] = "1e-3,1e-5",
    steps: Annotated[int, typer.Option(min=1, help="Of the fixed-step solvers.")] = 32,
    scenes: Annotated[int, typer.Option(min=1, help="Of each problem; a cell tells of the worst.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of the scenes' starts.")] = 0,
    max_evaluations: Annotated[int, typer.Option(min=1, help="Of an adaptive solver, for a scene.")] = 5000,
) -> None:
    """Where solvers fail and whether they say so: exact problems, stiff and extreme, in four precisions."""
    from r2flow.flow.problems import PROBLEMS
    from r2flow.flow.solvers import SOLVERS, adapts, check_method
    from r2flow.reports import stability as measuring
    from r2flow.reports.pages import Page, prepare_folder

    chosen = solvers.split(",") if solvers else list(SOLVERS)
    names = problems.split(",") if problems else list(PROBLEMS)
    held_to = numbers("tolerances", tolerances)
    for solver in chosen:
        check_method(solver)
    for name in names:
        PROBLEMS[name]
    prepare_folder(out)
    cells = len(measuring.PRECISIONS) * (len(names) + ("point_mass" in names))
    cells *= sum(len(held_to) if adapts(solver) else 1 for solver in chosen)
    with only_errors(), Bar("measuring", cells, "cells") as advance:
        rows = measuring.stability(
            names, chosen, tolerances=held_to, steps=steps, scenes=scenes, seed=seed,
            max_evaluations=max_evaluations, progress=advance,
        )  # fmt: skip
        probe = measuring.jet_probe(seed=seed) if measuring.KNOWN_EXCEPTION in names else []
    text = measuring.markdown(rows, probe)
    page = Page(
        "stability", "Where solvers fail, and whether they say so", [text.strip()], rows,
        {"stability": measuring.figure(rows)}, command(), {"scenes": seed}, more={"jet_probe": probe},
    )  # fmt: skip
    finish(page, out, [text.partition("\n\n")[0]])


@contextmanager
def only_errors() -> Iterator[None]:
    """No warnings about scenes that a solver gave up on: the report counts them."""
    log = logging.getLogger("r2flow.flow")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)
