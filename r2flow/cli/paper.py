"""`r2flow report paper`: the paper's tables and figures from run folders and checkpoints."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import report
from r2flow.cli.groups import WorkOptions, grouped
from r2flow.cli.options import OutOption, choose_device
from r2flow.errors import InputError

if TYPE_CHECKING:
    from r2flow.evaluation.sets import ScanSet
    from r2flow.metrics.base import ScanMetric

HEADLINE = "frechet_handcrafted"  # of equally many scans everywhere, so that its bias is that of all; never below 0


@dataclass(frozen=True)
class BudgetOptions:
    """How much is measured."""

    num: Annotated[int, typer.Option(min=2, help="Scans of each, at each number of steps; the paper: 10000.")] = 1000
    steps: Annotated[str, typer.Option(help="Of generators with any number of steps: Euler's of a flow.")] = (
        "1,2,4,8,16,32,64,128,256"
    )
    curved: Annotated[int, typer.Option(min=0, help="Scenes whose paths are followed for figure 8.")] = 4
    repeats: Annotated[int, typer.Option(min=0, help="Timed evaluations of each network; 0 leaves latency out.")] = 3
    bootstrap: Annotated[int, typer.Option(min=0, help="Resamples for intervals of the figures; 0 for none.")] = 100
    tolerance: Annotated[float, typer.Option(min=0, help="Of the inversion in figure 3; 0 leaves it out.")] = 1e-3


@report.command(epilog="Example: r2flow report paper runs/r2flow runs/r2dm lidargen.pth --out paper")
@grouped
def paper(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Run folders, folders of them (a chain's, a sweep's), checkpoint files."),
    ],
    out: OutOption,
    budget: BudgetOptions,
    work: WorkOptions,
    real: Annotated[
        str | None,
        typer.Option(help="Scans to compare with, as `r2flow evaluate` takes them; held-out ones if left out."),
    ] = None,
    split: Annotated[str | None, typer.Option(help="Of the real scans' standard split.")] = None,
    metrics: Annotated[str | None, typer.Option(help="By name; all that can be computed here if left out.")] = None,
    protocol: Annotated[
        str | None, typer.Option(help="paper or r2flow; the paper's where the real scans allow it if left out.")
    ] = None,
    primary: Annotated[
        str | None, typer.Option(help="The metric that judges the claims; frd, else frechet_handcrafted if left out.")
    ] = None,
) -> None:
    """The paper's tables I and II and figures 3, 5, 6, 7, 8 from runs, its printed numbers and claims beside ours.

    Takes the paper's flows and the systems that it compares them with (R2DM, LiDM, LiDARGen, the GANs).

    What is measured is kept in the folder: the same command again goes on where it stopped.
    """
    from r2flow.cli.evaluate import work_of
    from r2flow.cli.output import command, finish, numbers
    from r2flow.evaluation.protocols import named_rules
    from r2flow.reports.pages import prepare_folder
    from r2flow.reports.paper.claims import primary_of
    from r2flow.reports.paper.report import Budget, first_of, report
    from r2flow.reports.paper.subjects import find_subjects

    rules = None if protocol is None else named_rules(protocol)
    where = choose_device(work.device)
    counts = tuple(sorted(set(numbers("steps", budget.steps, int))))
    amount = Budget(budget.num, counts, budget.curved, budget.repeats, budget.bootstrap, budget.tolerance or None)
    subjects = find_subjects(runs)
    truth = None if real is None else real_set(real, split, first_of(subjects).run, protocol)
    reflectance = all(one.config["encoding"]["reflectance"] for one in subjects)
    chosen, missing = build_metrics(metrics.split(",") if metrics else None, amount.bootstrap > 0, reflectance, where)
    judging = primary_of(list(chosen), primary)
    prepare_folder(out)
    print(f"{len(subjects)} generators: {', '.join(f'{one.label} ({one.role})' for one in subjects)}")
    doing = work_of(work.batch_size, work.workers)
    page = report(subjects, out, chosen, judging, missing, amount, doing, truth, where, command(), rules)
    finish(page, out, page.text[2:4] if any(one.role == "1-RF" for one in subjects) else page.text[4:5])


def real_set(text: str, split: str | None, run: Path, protocol: str | None = None) -> "ScanSet":
    """The real scans as a run's flow sees them; those that may be compared as in the paper, projected as there."""
    from r2flow.cli.evaluate import reading_of
    from r2flow.data.opening import open_scans
    from r2flow.evaluation.protocols import PAPER
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.paper.report import not_as_printed

    reading = reading_of([text], [load_checkpoint(run)])
    found = open_scans(text, reading, split)
    if protocol == "r2flow" or (protocol is None and not_as_printed(found)):
        return found
    return open_scans(text, replace(reading, convention=PAPER.convention or reading.convention), split)


def build_metrics(
    names: list[str] | None, keep: bool, reflectance: bool, device: str
) -> "tuple[dict[str, ScanMetric], dict[str, str]]":
    """The metrics, `jsd` always among them; of the paper's those that are missing, and why.

    Without names: whatever of the paper's can be computed here, and the Frechet distance of hand-made features.
    """
    from r2flow.metrics import METRICS
    from r2flow.reports.paper.printed import COLUMNS

    headline = HEADLINE if reflectance else f"{HEADLINE}_range"
    asked = list(dict.fromkeys(["jsd", *(names or ["mmd", headline, *COLUMNS])]))
    built: dict[str, ScanMetric] = {}
    missing: dict[str, str] = {name: "not asked for" for name in COLUMNS if name not in asked}
    for name in asked:
        try:
            built[name] = METRICS[name](keep=keep).to(device)
        except InputError as error:
            if names is not None:
                raise
            missing[name] = str(error)
    return built, {name: missing[name] for name in COLUMNS if name in missing}
