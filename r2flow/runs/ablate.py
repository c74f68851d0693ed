"""Train the runs of an ablation and measure them, resumed from the rows of its CSV."""

import multiprocessing
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from r2flow.base.errors import check
from r2flow.base.plugins import load_plugins, loaded_plugins
from r2flow.base.pool import attempts_of
from r2flow.base.progress import Bar
from r2flow.base.signals import Stopped
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
    workers: int = 1,
    steps: Path | None = None,
    follow: Callable[[Page], object] = lambda page: None,
) -> Page | None:
    """Train what an ablation lacks, measure it, and make the page; None if `trainer.max_time` has
    stopped a run, which the same call resumes.

    Args:
        csv: Rows of the finished runs, of any budget; rows of others' settings stay.
        real: Held-out scans by name; default: simulated ones, if the training scans are.
        num: Held-out scans, and samples of each run.
        evaluations: Network evaluations of samples; default: 1, 2, 4, 16.
        workers: Runs at once, each in a process of its own with one thread if more than one.
        steps: Rows that give the training steps of each combination, to repeat their runs.
            Default: `csv`, whose other seeds give them.
        follow: Called with the page of what is finished, after each run.

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
    known = [row for row in read_rows(steps or csv) if row["settings"] == settings]
    ablation.steps = _steps_of(row for row in known if row["budget"] == seconds)
    seeds = f"{ablation.seeds} seed{'s' * (ablation.seeds != 1)}"
    about = f"{seeds} of {seconds / 60:.3g} minutes each; {settings}."

    def page() -> Page:
        return ablation_page(rows, list(ablation.variants), seconds, about, device)

    done = {(row["seed"], row["combination"]) for row in rows if row["budget"] == seconds}
    missing = [run for run in ablation.runs if run not in done]
    if not missing:
        return page()
    judge = _judge(ablation, held_out, num, device, workers)
    if not rows:
        rows = [{"settings": settings, "budget": 0, **row} for row in reference_rows(judge)]
    if done:
        follow(page())
    with closing(_trained(ablation, missing, workers)) as trained:
        for (seed, name), finished in trained:
            if not finished:
                return None
            run = {"combination": name, "seed": seed, "budget": seconds, "settings": settings}
            rows += [run | row for row in _measured(ablation, seed, name, judge, evaluations)]
            write_rows([*others, *rows], csv)
            follow(page())
    return page()


@dataclass(frozen=True)
class _Trainings:
    """Trainings of an ablation's runs, in the processes of a pool."""

    ablation: Ablation
    runs: Sequence[tuple[int, str]]
    plugins: Sequence[str]

    @property
    def folder(self) -> Path:
        return self.ablation.out

    def attempt(self, number: int, work: Callable[[int], Any]) -> bool:
        return work(number)

    def train(self, number: int) -> bool:
        """Train a run; False if `trainer.max_time` has stopped it."""
        seed, name = self.runs[number]
        label = f"[{number + 1}/{len(self.runs)}] {name}, seed {seed}"
        if multiprocessing.parent_process() is not None:
            torch.set_num_threads(1)
            Bar.label = f"{label}: "
            load_plugins(self.plugins)
        print(label, flush=True)
        try:
            return self.ablation.train(seed, name)
        except Stopped as stop:
            raise SystemExit(stop.code) from None


def _trained(
    ablation: Ablation, runs: Sequence[tuple[int, str]], workers: int
) -> Generator[tuple[tuple[int, str], bool]]:
    """Runs as they end, and whether they are finished."""
    trainings = _Trainings(ablation, runs, loaded_plugins())
    begin = time.monotonic()
    minutes = len(runs) * ablation.seconds / min(workers, len(runs)) / 60
    print(f"{len(runs)} runs, {minutes:.0f} min of training", flush=True)
    attempts = attempts_of(trainings, [*range(len(runs))], trainings.train, workers)
    with closing(attempts):
        for count, (number, finished) in enumerate(attempts, 1):
            yield runs[number], finished
            left = (len(runs) - count) * (time.monotonic() - begin) / count / 60
            print(f"{count} of {len(runs)} runs: {left:.0f} min left", flush=True)


def _steps_of(rows: Iterable[Row]) -> dict[str, list[int]]:
    """Steps of the links of each combination, by their rows, of which the last link's has all."""
    counted: dict[str, list[int]] = {}
    for row in rows:
        numbers = [int(text) for text in row.get("steps", "").split("+") if text]
        if len(numbers) > len(counted.get(row["combination"], ())):
            counted[row["combination"]] = numbers
    return counted


def _judge(ablation: Ablation, held_out: str, num: int, device: str, workers: int) -> Judge:
    """What measures the runs, with the training scans of the first.

    Raises:
        InputError: several workers on one accelerator, which they would share.
    """
    first = ablation.first()
    check(
        workers == 1 or first.trainer.strategy.root_device.type == "cpu",
        "runs on one device would slow each other: --workers 1.",
    )
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
    steps: list[str] = []
    for link in ablation.runs[seed, name]:
        cost = training_cost(link)
        spent += cost.seconds
        steps.append(str(cost.steps))
        of_link = {
            "model": link.name or name,
            "seconds of training": spent,
            "images": cost.images,
            "steps": "+".join(steps),
        }
        rows += [of_link | row for row in measure_run(link.config.run_dir, judge, evaluations)]
    return rows
