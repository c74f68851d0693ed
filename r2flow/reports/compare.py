"""Runs side by side: settings, losses, straightness and cost."""

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

from r2flow.config import flatten
from r2flow.errors import InputError, naming
from r2flow.model.checkpoint import checkpoints_of, step_of
from r2flow.reports.backbones import cost
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import print_table, shown, table
from r2flow.reports.training import Curve, read_curves
from r2flow.runs.folder import CONFIG, contradictions, read_config

log = logging.getLogger(__name__)

# As logged, and the titles of the panels.
CURVES = {
    "train/loss": "training loss", "val/loss": "validation loss", "curvature/s_normalised": "straightness, s / length²",
}  # fmt: skip

# Column -> heading: what is equal for all seeds, and what is averaged over them.
FIXED = {
    "stage": "stage", "backbone": "backbone", "parameters": "parameters", "gmac": "GMAC", "steps": "steps",
    "images": "images",
}  # fmt: skip
MEASURED = {
    "train_loss": "train loss, last tenth", "val_best": "val loss, best", "val_last": "val loss, last",
    "straightness": "s / length^2",
}  # fmt: skip


@dataclass(frozen=True)
class ComparedRun:
    """A run, read from its folder.

    Attributes:
        values: By the columns of `FIXED` and `MEASURED`; None where the folder does not hold one.
        curves: (steps, values) by logged name.
    """

    label: str
    config: dict[str, Any]
    values: dict[str, Any]
    curves: dict[str, Curve]


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed alone, or a single run."""

    label: str
    runs: tuple[ComparedRun, ...]


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """Run folders: those given, and for a folder of runs (a chain's, a sweep's, a sweep's of chains) those in it.

    Paths that are neither are skipped with a warning where there are others, as in `runs/sweep/*`.

    Raises:
        InputError: a path that does not exist, or no run among the paths.
    """
    found: list[Path] = []
    others: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist.")
        inside = _runs_in(path, levels=2)
        found += inside
        others += [] if inside else [path]
    if others and not found:
        raise InputError(f"{others[0]} is no run: it has no {CONFIG}. Give folders that train.py has written.")
    for path in others:
        if path.suffix not in (".yaml", ".log"):  # which lie in a sweep's folder
            log.warning("%s holds no run and is skipped.", path)
    return list(dict.fromkeys(found))


def _runs_in(path: Path, levels: int) -> list[Path]:
    """The folder itself where it is a run; else the runs in it, down to so many levels, without hidden folders."""
    if (path / CONFIG).is_file():
        return [path]
    if not levels or not path.is_dir():
        return []
    folders = sorted(folder for folder in path.iterdir() if folder.is_dir() and not folder.name.startswith("."))
    return [run for folder in folders for run in _runs_in(folder, levels - 1)]


def labels(folders: Sequence[Path]) -> list[str]:
    """Each folder's name, with as many parents as it takes to tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    depth = 1
    while depth < max(map(len, parts), default=1) and len({p[-depth:] for p in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(p[-depth:]) for p in parts]


def read_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """Every run, each backbone built once."""
    folders = find_runs(paths)
    costs: dict[str, dict[str, Any]] = {}
    runs = []
    for path, label in zip(folders, labels(folders), strict=True):
        config = _config_of(path)
        architecture = json.dumps([config.get(key) for key in ("sensor", "encoding", "backbone")], sort_keys=True)
        if architecture not in costs:
            with naming(path):
                costs[architecture] = cost(config)
        curves = read_curves(path, tuple(CURVES))
        runs.append(ComparedRun(label, config, {**costs[architecture], **_read_values(path, config, curves)}, curves))
    return runs


def _config_of(path: Path) -> dict[str, Any]:
    try:
        config = read_config(path)
    except yaml.YAMLError:
        raise InputError(f"{path / CONFIG} cannot be read as YAML; is it whole?") from None
    if not isinstance(config, dict) or not {"stage", "backbone", "data"} <= config.keys():
        raise InputError(f"{path / CONFIG} is no config of a run.")
    return config


def _read_values(path: Path, config: Mapping[str, Any], curves: Mapping[str, Curve]) -> dict[str, Any]:
    """The columns of a run that its network does not decide."""
    nothing = (np.empty(0), np.empty(0))
    train, validation, straightness = (curves.get(name, nothing)[1] for name in CURVES)
    checkpoints = checkpoints_of(path)
    logged = [int(steps[-1]) for name, (steps, _) in curves.items() if name.endswith("loss")]
    step = step_of(checkpoints[0]) if checkpoints else max(logged, default=None)
    stage = config["stage"]
    return {
        "stage": f"{stage['name']} {stage['steps']}" if "steps" in stage else str(stage["name"]),
        "backbone": (config["backbone"] or {}).get("name"),
        "steps": step,
        "images": None if step is None else step * int(config["data"]["batch_size"]),
        "train_loss": float(train[-max(len(train) // 10, 1) :].mean()) if len(train) else None,
        "val_best": float(validation.min()) if len(validation) else None,
        "val_last": float(validation[-1]) if len(validation) else None,
        "straightness": float(straightness[-1]) if len(straightness) else None,
    }


def group_runs(runs: Sequence[ComparedRun]) -> list[Group]:
    """Runs of one configuration and several seeds together, in the order given."""
    groups: list[list[ComparedRun]] = []
    for run in runs:
        same = next((group for group in groups if same_but_seed(group[0].config, run.config)), None)
        if same is None:
            groups.append([run])
        else:
            same.append(run)
    return [Group(_common_label(group), tuple(group)) for group in groups]


def same_but_seed(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two configs train the same thing, from another seed or from parents that do so."""
    # Pairs carry their parent's hash, which differs between seeds.
    ignored = {"seed", "data.pairs.parent", "scans"} if first["data"]["name"] == "pairs" else {"seed"}
    trimmed = [
        {key: value for key, value in flatten(config) if key not in ignored and not key.startswith("parent.")}
        for config in (first, second)
    ]
    if contradictions(*trimmed):
        return False
    one, other = first.get("parent"), second.get("parent")
    if not one or not other or one["weights"] == other["weights"]:
        return bool(one) == bool(other)
    parents = [read_config(Path(parent["path"]).parent.parent) for parent in (one, other)]
    return bool(parents[0] and parents[1] and same_but_seed(parents[0], parents[1]))


def _common_label(runs: Sequence[ComparedRun]) -> str:
    """The common part of several runs' names, without the word seed."""
    if len(runs) == 1:
        return runs[0].label
    words = zip(*(re.split(r"([-_.,/= ]+)", run.label) for run in runs), strict=False)
    common = "".join(word[0] for word in takewhile(lambda word: len(set(word)) == 1, words))
    common = re.sub(r"[-_.,/= ]*(seed)?[-_.,/= ]*$", "", common)
    return common or f"{runs[0].values['stage']}, {runs[0].values['backbone']}"


def rows_of(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """A row for each group: means, with the spread and n where there are several runs."""
    rows = []
    for group in groups:
        row: dict[str, Any] = {"name": group.label, "n": len(group.runs)}
        for column in FIXED:
            found = {run.values[column] for run in group.runs}
            row[column] = found.pop() if len(found) == 1 else None
        for column in MEASURED:
            values = [run.values[column] for run in group.runs if run.values[column] is not None]
            row[column] = fmean(values) if values else None
            row[f"{column}_spread"] = stdev(values) if len(values) > 1 else None
        rows.append(row)
    return rows


def cell(row: Mapping[str, Any], column: str) -> str:
    """A value for a reader, '0.243 ± 0.004' over several runs, '-' where there is none."""
    value, deviation = row.get(column), row.get(f"{column}_spread")
    if value is None:
        return "-"
    text = f"{value:,}" if isinstance(value, int) else shown(value)
    return text if deviation is None else f"{text} ± {shown(deviation)}"


def tables(groups: Sequence[Group]) -> dict[str, tuple[list[list[str]], list[str]]]:
    """(cells, headings) by title: what the runs are, and their results."""
    rows = rows_of(groups)
    measured = {key: heading for key, heading in MEASURED.items() if any(row[key] is not None for row in rows)}
    parts = {"Runs": {"n": "n", **FIXED}, "Results": measured}
    return {
        title: ([[row["name"], *(cell(row, key) for key in own)] for row in rows], ["run", *own.values()])
        for title, own in parts.items()
    }


def print_comparison(groups: Sequence[Group]) -> None:
    """The tables in the terminal."""
    for title, (cells, headings) in tables(groups).items():
        print_table(cells, headings, title)
        print()


NOTES = (
    "Losses are those that were logged: of validation, with the averaged weights; compare them only between runs with "
    "the same loss and the same data. s / length^2 is the last `curvature/s_normalised`; an untrained flow is straight "
    "too. Several seeds: mean ± standard deviation."
)


def compare_page(groups: Sequence[Group], command: str) -> Page:
    """`compare.md .csv .json .png`."""
    runs = [(group.label, run) for group in groups for run in group.runs]
    seeds = {run.label: int(run.config["seed"]) for _, run in runs if "seed" in run.config}
    written = [text for title, parts in tables(groups).items() for text in (f"## {title}", table(*parts))]
    members = [{"group": label, "run": run.label, **run.values} for label, run in runs]
    drawn = any(run.curves for _, run in runs)
    return Page(
        "compare", "Runs compared", [*written, NOTES], rows_of(groups),
        {"compare": compare_figure(groups)} if drawn else {}, command, seeds, more={"runs": members},
    )  # fmt: skip


def compare_figure(groups: Sequence[Group]) -> Figure:
    """A panel for each curve that a run has logged, every run in its group's style."""
    names = [name for name in CURVES if any(name in run.curves for group in groups for run in group.runs)]
    figure = blank_figure(5.5 * len(names), 3.8)
    for place, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), place + 1)
        for index, group in enumerate(groups):
            for number, run in enumerate([run for run in group.runs if name in run.curves]):
                steps, values = smooth(*run.curves[name])
                axes.plot(
                    steps, values, **STYLES[index % len(STYLES)], ms=4, lw=1.1, markevery=max(len(steps) // 8, 1),
                    label=group.label if number == 0 else None,
                )  # fmt: skip
        axes.set(title=CURVES[name], xlabel="optimiser step")
        if all((line.get_ydata() > 0).all() for line in axes.lines):  # type: ignore[operator, union-attr]
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def smooth(steps: np.ndarray, values: np.ndarray) -> Curve:
    """The running mean over a twentieth of the points, each at the middle of its steps."""
    width = max(len(values) // 20, 1)
    kernel = np.full(width, 1 / width)
    return np.convolve(steps, kernel, "valid"), np.convolve(values, kernel, "valid")
