"""Runs side by side: settings, losses, straightness, fidelity and cost."""

import json
import logging
import math
import os
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

from r2flow.backbones.cost import count_macs, count_parameters
from r2flow.config import flatten
from r2flow.errors import InputError, naming
from r2flow.files import read_json
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.model.checkpoint import checkpoints_of, step_of
from r2flow.reports.backbones import latency
from r2flow.reports.pages import STYLES, Page, blank_figure, few_log_ticks
from r2flow.reports.tables import print_table, shown, table
from r2flow.reports.training import Curve, read_curves
from r2flow.runs.folder import CONFIG, contradictions, read_config

log = logging.getLogger(__name__)

LOSSES = {"train/loss": "training loss", "val/loss": "validation loss"}  # as logged, and titled
STRAIGHTNESS = "curvature/s_normalised"

# Column -> heading: what is averaged over seeds, and what must be the same for all of them.
MEASURED = {
    "train_loss": "train loss, last tenth",
    "val_best": "val loss, best",
    "val_last": "val loss, last",
    "straightness": "s / length^2",
    "seconds": "seconds",
    "latency_ms": "latency, ms",
}
FIXED = {
    "stage": "stage",
    "backbone": "backbone",
    "parameters": "parameters",
    "gmac": "GMAC",
    "steps": "steps",
    "images": "images",
}
DRAWN = {  # the figure's lower panels
    "train_loss": "training loss, last tenth",
    "val_best": "validation loss, best",
    "straightness": "s / length^2",
    "gmac": "GMAC of an evaluation",
    "seconds": "training, s",
}


@dataclass(frozen=True)
class ComparedRun:
    """A run, read from its folder.

    Attributes:
        values: By the columns of `FIXED` and `MEASURED`; None where the folder does not hold one.
        curves: (steps, values) by logged name.
        fidelity: Distance to the real scans by member of the panel, if `r2flow report fidelity` wrote it there.
    """

    label: str
    config: dict[str, Any]
    values: dict[str, Any]
    curves: dict[str, Curve]
    fidelity: dict[str, float]


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but their seed; a run alone where they were not to be grouped."""

    label: str
    runs: tuple[ComparedRun, ...]

    def values(self, column: str) -> list[float]:
        """A column or a line of the fidelity panel, of the runs that have it."""
        found = [{**run.values, **run.fidelity}.get(column) for run in self.runs]
        return [value for value in found if value is not None]


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """Run folders: those given, and for a folder of runs (a chain's, a sweep's, a sweep's of chains) those in it.

    Paths that are neither are skipped with a warning where there are others, as in `runs/sweep/*`.

    Raises:
        InputError: a path that does not exist, or not one of them a run.
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
    """The folder itself where it is a run; else those in it, down to so many levels, hidden folders left out."""
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
    while depth < max(map(len, parts)) and len({p[-depth:] for p in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(p[-depth:]) for p in parts]


def read_runs(paths: Sequence[Path], repeats: int = 0, device: str = "cpu") -> list[ComparedRun]:
    """Every run, each backbone built once.

    Args:
        repeats: Timed evaluations of each backbone; 0 leaves the latency out.
    """
    folders = find_runs(paths)
    costs: dict[str, dict[str, Any]] = {}
    runs = []
    for path, label in zip(folders, labels(folders), strict=True):
        config = _config_of(path)
        architecture = json.dumps([config.get(key) for key in ("sensor", "encoding", "backbone")], sort_keys=True)
        if architecture not in costs:
            with naming(path):
                costs[architecture] = cost(config, repeats, device)
        curves = read_curves(path, (*LOSSES, STRAIGHTNESS))
        values = {**costs[architecture], **_read_values(path, config, curves)}
        runs.append(ComparedRun(label, config, values, curves, read_fidelity(path)))
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
    train, validation, straightness = (curves.get(name, nothing)[1] for name in (*LOSSES, STRAIGHTNESS))
    checkpoints = checkpoints_of(path)
    logged = [int(curves[name][0][-1]) for name in LOSSES if name in curves]
    step = step_of(checkpoints[0]) if checkpoints else max(logged, default=None)
    values = {
        "train_loss": train[-max(len(train) // 10, 1) :].mean() if len(train) else math.nan,
        "val_best": validation.min(initial=math.inf),
        "val_last": validation[-1] if len(validation) else math.nan,
        "straightness": straightness[-1] if len(straightness) else math.nan,
    }
    stage = config["stage"]
    return {
        "stage": f"{stage['name']} {stage['steps']}" if "steps" in stage else str(stage["name"]),
        "backbone": config["backbone"]["name"],
        "steps": step,
        "images": None if step is None else step * int(config["data"]["batch_size"]),
        **{name: float(value) if math.isfinite(value) else None for name, value in values.items()},
        "seconds": training_seconds(path),
    }


def cost(config: Mapping[str, Any], repeats: int, device: str) -> dict[str, Any]:
    """Parameters, GMAC and, on request, milliseconds of one evaluation for one image of a config's backbone."""
    generator = build_generator(config)
    if not isinstance(generator, RectifiedFlow):
        return {"parameters": count_parameters(generator)}
    model = generator.untold().backbone.eval()
    found: dict[str, Any] = {"parameters": count_parameters(model), "gmac": count_macs(model) / 1e9}
    shape = (1, *generator.space.shape)
    found["latency_ms"] = latency(model.to(device), shape, repeats, device) if repeats else None
    return found


def training_seconds(path: Path) -> float | None:
    """Time between the first and the last entry of TensorBoard's logs, all starts of the run added; None without."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    total = 0.0
    for file in sorted(path.glob("tensorboard/**/events.out.tfevents.*")):
        times = [event.wall_time for event in EventFileLoader(os.fspath(file)).Load() if event.HasField("summary")]
        total += max(times, default=0.0) - min(times, default=0.0)
    return total or None


def read_fidelity(path: Path) -> dict[str, float]:
    """The judged column of `fidelity.json` in the run's folder or one below it (`r2flow report fidelity --out`).

    Raises:
        InputError: the file holds something else.
    """
    files = [*path.glob("fidelity.json"), *path.glob("*/fidelity.json")]
    if not files:
        return {}
    newest = max(files, key=lambda file: file.stat().st_mtime)
    try:
        return {line: float(value) for line, value in read_json(newest)["sets"]["other"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{newest} is no result of 'r2flow report fidelity'; remove it or make it again.") from None


def group_runs(runs: Sequence[ComparedRun]) -> list[Group]:
    """Runs of one configuration and several seeds together, in the order given."""
    groups: list[list[ComparedRun]] = []
    for run in runs:
        same = next((g for g in groups if same_but_seed(g[0].config, run.config)), None)
        if same is None:
            groups.append([run])
        else:
            same.append(run)
    return [Group(_common_label(group), tuple(group)) for group in groups]


def same_but_seed(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two configs train the same thing, from another seed or from parents that do so."""
    # Pairs carry their parent's hash, which is another one for another seed.
    on_pairs = first["data"]["name"] == "pairs"
    ignored = {"seed", "data.pairs.parent", "scans"} if on_pairs else {"seed"}
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
    # Without a parent's folder its config is not known, and the runs stay apart.
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
            found = {run.values.get(column) for run in group.runs}
            row[column] = found.pop() if len(found) == 1 else None
        for column in (*MEASURED, *panel_lines(groups)):
            values = group.values(column)
            row[column] = fmean(values) if values else None
            row[f"{column}_spread"] = stdev(values) if len(values) > 1 else None
        rows.append(row)
    return rows


def panel_lines(groups: Sequence[Group]) -> list[str]:
    """The lines of the fidelity panel that any run has."""
    return list(dict.fromkeys(line for group in groups for run in group.runs for line in run.fidelity))


def cell(row: Mapping[str, Any], column: str) -> str:
    """A value for a reader, '0.243 ± 0.004' over several runs, '-' where there is none."""
    value, deviation = row.get(column), row.get(f"{column}_spread")
    if value is None:
        return "-"
    text = f"{value:,}" if isinstance(value, int) else shown(value)
    return text if deviation is None else f"{text} ± {shown(deviation)}"


def tables(groups: Sequence[Group]) -> list[tuple[str, list[list[str]], list[str]]]:
    """(title, cells, headings): what the runs are and cost, their results, and the fidelity panel where it was run."""
    rows = rows_of(groups)
    several = {"n": "n"} if any(row["n"] > 1 for row in rows) else {}
    results = dict(MEASURED)
    latencies = {"latency_ms": results.pop("latency_ms")}
    timed = any(row["latency_ms"] is not None for row in rows)
    lines = {line: line for line in panel_lines(groups)}
    titled = {"Runs": {**FIXED, **(latencies if timed else {})}, "Results": results, "Distance to real scans": lines}
    return [
        (title, [[row["name"], *(cell(row, key) for key in [*several, *own])] for row in rows],
         ["run", *several.values(), *own.values()])
        for title, own in titled.items() if own
    ]  # fmt: skip


def print_comparison(groups: Sequence[Group]) -> None:
    """The tables in the terminal."""
    for title, cells, headings in tables(groups):
        print_table(cells, headings, title)
        print()


NOTES = (
    "Losses are those that were logged: of validation, with the averaged weights; compare them only between runs with "
    "the same loss and the same data. s / length^2 is the last `curvature/s_normalised`; an untrained flow is straight "
    "too. Seconds are between the first and last entry of TensorBoard's logs, on whatever machine each run had. "
    "'-': the folder does not hold the value."
)


def compare_page(groups: Sequence[Group], command: str, device: str = "cpu") -> Page:
    """`compare.md .csv .json .png`."""
    runs = [(group.label, run) for group in groups for run in group.runs]
    spread = ["Several seeds: mean ± standard deviation over n runs."] if len(runs) > len(groups) else []
    seeds = {run.label: int(run.config["seed"]) for _, run in runs if "seed" in run.config}
    written = [part for title, cells, headings in tables(groups) for part in (f"## {title}", table(cells, headings))]
    members = [{"group": label, "run": run.label, **run.values, **run.fidelity} for label, run in runs]
    return Page(
        "compare", "Runs compared", [*written, "## How to read it", NOTES, *spread], rows_of(groups),
        {"compare": compare_figure(groups)}, command, seeds, device, {"runs": members},
    )  # fmt: skip


def compare_figure(groups: Sequence[Group]) -> Figure:
    """Learning curves above, a panel of points for each figure in which the groups differ below."""
    styled = [(STYLES[index % len(STYLES)], group) for index, group in enumerate(groups)]
    curves = [name for name in LOSSES if any(name in run.curves for group in groups for run in group.runs)]
    panels = [column for column in DRAWN if len({value for group in groups for value in group.values(column)}) > 1]
    heights = {"curves": 3.6 if curves else 0.0, "panels": 0.9 + 0.26 * len(groups) if panels else 0.0}
    figure = blank_figure(11, max(sum(heights.values()), 1.0))
    if not curves and not panels:
        figure.text(0.5, 0.5, "no losses were logged, and no figure differs", ha="center", va="center")
        return figure
    columns = {part: number for part, number in (("curves", len(curves)), ("panels", len(panels))) if number}
    rows = figure.add_gridspec(len(columns), 1, height_ratios=[heights[part] for part in columns])
    cells = {part: rows[place].subgridspec(1, columns[part]) for place, part in enumerate(columns)}
    for place, name in enumerate(curves):
        axes = figure.add_subplot(cells["curves"][place])
        _draw_curves(axes, styled, name)
        axes.set(title=LOSSES[name], xlabel="optimiser step")
    first = None
    for place, column in enumerate(panels):
        axes = figure.add_subplot(cells["panels"][place], sharey=first)
        _draw_points(axes, styled, column)
        axes.set_title(DRAWN[column], fontsize=9)
        axes.set_yticks(range(len(groups)), [group.label for group in groups], fontsize=8)
        axes.set_ylim(len(groups) - 0.5, -0.5)
        axes.tick_params(labelleft=first is None, labelsize=8)
        first = first or axes
    if panels and any(len(group.runs) > 1 for group in groups):
        figure.supxlabel("large: mean of the seeds; bar: their standard deviation; small: each seed", fontsize=8)
    return figure


def _draw_curves(axes: Any, styled: Sequence[tuple[dict[str, Any], Group]], name: str) -> None:
    """Every run's curve in its group's style; many points as their running mean over a twentieth of the run."""
    drawn = []
    for style, group in styled:
        for number, run in enumerate([run for run in group.runs if name in run.curves]):
            steps, values = smooth(*run.curves[name])
            drawn.append(values)
            axes.plot(
                steps, values, **style, markersize=4, markevery=max(len(steps) // 8, 1), linewidth=1.1,
                label=group.label if number == 0 else None,
            )  # fmt: skip
    axes.grid(alpha=0.25)
    every = np.concatenate(drawn)
    if (every > 0).all() and every.max() > 4 * every.min():
        axes.set_yscale("log")
        few_log_ticks(axes.yaxis)
    axes.legend(fontsize=8)


def smooth(steps: np.ndarray, values: np.ndarray) -> Curve:
    """The running mean over a twentieth of the points, each at the middle of its steps."""
    width = max(len(values) // 20, 1)
    kernel = np.full(width, 1 / width)
    return np.convolve(steps, kernel, "valid"), np.convolve(values, kernel, "valid")


def _draw_points(axes: Any, styled: Sequence[tuple[dict[str, Any], Group]], column: str) -> None:
    """Mean and standard deviation of each group, and the values of its runs."""
    for row, (style, group) in enumerate(styled):
        mark = {"color": style["color"], "marker": style["marker"]}
        values = group.values(column)
        if not values:
            axes.text(0.02, row, "-", va="center", transform=axes.get_yaxis_transform())
            continue
        deviation = stdev(values) if len(values) > 1 else None
        axes.errorbar(fmean(values), row, xerr=deviation, capsize=3, markersize=6, linestyle="none", **mark)
        if len(values) > 1:
            axes.plot(values, [row] * len(values), "|", color=style["color"], markersize=9, alpha=0.6)
    axes.grid(axis="x", alpha=0.25)
    axes.margins(x=0.15)
    if all(value >= 0 for _, group in styled for value in group.values(column)):
        axes.set_xlim(left=max(axes.get_xlim()[0], 0))
    axes.locator_params(axis="x", nbins=4)
