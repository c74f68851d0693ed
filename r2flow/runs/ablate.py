"""Train the runs of an ablation and measure them, resumed from the rows of its CSV."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from r2flow.data.detection import reading_for
from r2flow.data.opening import open_scans
from r2flow.data.sets import ScanSet
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.ablation import Judge, measure_run, read_rows, reference_rows, write_rows
from r2flow.reports.ablation_page import ablation_page
from r2flow.reports.pages import Page
from r2flow.reports.tables import Row
from r2flow.runs.ablation import Ablation, training_cost

_EVALUATIONS = (1, 2, 4, 16)  # of samples of flows; of other systems, each one's own


def ablate(
    ablation: Ablation,
    csv: Path,
    real: str | None = None,
    num: int = 64,
    evaluations: Sequence[int] | None = None,
    device: str = "cpu",
) -> Page | None:
    """Train what an ablation lacks, measure it, and make the page; None if `trainer.max_time` has
    stopped a run, which the same call resumes.

    Args:
        csv: Rows of the finished runs, of any budget; rows of others' settings stay.
        real: Held-out scans by name; default: simulated ones, if the training scans are.
        num: Held-out scans, and samples of each run.
        evaluations: Network evaluations of samples; default: 1, 2, 4, 16.

    Raises:
        InputError: what a run of the ablation refuses.
    """
    held_out = real or ablation.simulated()
    if not ablation.of_systems:
        evaluations = evaluations or _EVALUATIONS
    ablation.check()
    settings = f"{ablation.settings}; {num} scans of {held_out}"
    rows = [row for row in read_rows(csv) if row["settings"] == settings]
    others = [row for row in read_rows(csv) if row["settings"] != settings]
    seconds = ablation.seconds
    done = {(row["seed"], row["combination"]) for row in rows if row["budget"] == seconds}
    missing = [run for run in ablation.runs if run not in done]
    if missing:
        judge = _judge(ablation, held_out, num, device)
        if not rows:
            rows = [{"settings": settings, "budget": 0, **row} for row in reference_rows(judge)]
    for number, (seed, name) in enumerate(missing):
        left = (len(missing) - number) * seconds / 60
        count = f"[{number + 1}/{len(missing)}]"
        print(f"{count} {name}, seed {seed}: {left:.0f} min of training left", flush=True)
        if not ablation.train(seed, name):
            return None
        run = {"combination": name, "seed": seed, "budget": seconds, "settings": settings}
        rows += [run | row for row in _measured(ablation, seed, name, judge, evaluations)]
        write_rows([*others, *rows], csv)
    seeds = f"{ablation.seeds} seed{'s' * (ablation.seeds != 1)}"
    about = f"{seeds} of {seconds / 60:.3g} minutes each; {settings}."
    return ablation_page(rows, list(ablation.variants), seconds, about, device)


def _judge(ablation: Ablation, held_out: str, num: int, device: str) -> Judge:
    """What measures the runs, with the training scans of the first."""
    first = ablation.first()
    model = Checkpoint(first.stage.generator, first.config.model_config())
    scans = open_scans(held_out, reading_for([held_out], model), num=num)
    source: Any = first.data.training_source
    training = ScanSet("training scans", source, scans.sensor)
    return Judge(scans, training, device)


def _measured(
    ablation: Ablation, seed: int, name: str, judge: Judge, evaluations: Sequence[int] | None
) -> list[Row]:
    """Rows of a trained run, of each link of a chain; a link costs the training of those before."""
    rows = []
    spent = 0.0
    for link in ablation.runs[seed, name]:
        cost = training_cost(link.config.run_dir)
        spent += cost["seconds of training"]
        for row in measure_run(link.config.run_dir, judge, evaluations):
            of_link = {"model": link.name or name, **cost, **row, "seconds of training": spent}
            rows.append(of_link)
    return rows
