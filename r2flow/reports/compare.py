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
from r2flow.checkpoints import checkpoints_of, step_of
from r2flow.config import flatten
from r2flow.errors import InputError
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.reports.backbones import latency
from r2flow.reports.pages import STYLES, Page, blank_figure, few_log_ticks
from r2flow.reports.tables import print_table, shown, table
from r2flow.reports.training import Curve, read_curves
from r2flow.runs import CONFIG, contradictions, read_config

log = logging.getLogger(__name__)

LOSSES = ("train/loss", "val/loss")
CURVATURE = ("curvature/s_normalised", "curvature/s")

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


@dataclass(frozen=True)
class Run:
    """A run, read from its folder.

    Attributes:
        label: Its name in tables and figures.
        path: Its folder.
        config: The config that it was started with.
        values: By the columns of `FIXED` and `MEASURED`; None where the folder does not hold one.
        curves: (steps, values) by logged name.
        fidelity: Distance to the real scans by member of the panel, if `r2flow report fidelity` wrote it there.
    """

    label: str
    path: Path
    config: dict[str, Any]
    values: dict[str, Any]
    curves: dict[str, Curve]
    fidelity: dict[str, float]


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """Run folders: those given, and for a folder of runs (a chain's, a sweep's, a sweep's of chains) those in it.

    Paths that are neither are skipped where there are others, as in `runs/sweep/*`; folders with a warning.

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
        if path.is_dir():
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


def read_runs(paths: Sequence[Path], repeats: int = 0, device: str = "cpu") -> list[Run]:
    """Every run, each backbone built once.

    Args:
        repeats: Timed evaluations of each backbone; 0 leaves the latency out.
    """
    folders = find_runs(paths)
    costs: dict[str, dict[str, Any]] = {}
    return [
        _read_run(path, label, costs, repeats, device) for path, label in zip(folders, labels(folders), strict=True)
    ]


def labels(folders: Sequence[Path]) -> list[str]:
    """Each folder's name, with as many parents as it takes to tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    depth = 1
    while depth < max(map(len, parts)) and len({p[-depth:] for p in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(p[-depth:]) for p in parts]


def _read_run(path: Path, label: str, costs: dict[str, dict[str, Any]], repeats: int, device: str) -> Run:
    try:
        config = read_config(path)
    except yaml.YAMLError:
        raise InputError(f"{path / CONFIG} cannot be read as YAML; is it whole?") from None
    if not isinstance(config, dict) or not {"stage", "backbone", "data"} <= config.keys():
        raise InputError(f"{path / CONFIG} is no config of a run.")
    architecture = json.dumps([config.get(key) for key in ("sensor", "encoding", "backbone")], sort_keys=True)
    if architecture not in costs:
        costs[architecture] = cost(config, repeats, device)
    curves = read_curves(path, (*LOSSES, *CURVATURE))
    train, validation = (curves[name][1] if name in curves else np.empty(0) for name in LOSSES)
    straightness = curves[CURVATURE[0]][1] if CURVATURE[0] in curves else np.empty(0)
    checkpoints = checkpoints_of(path)
    logged = [int(steps[-1]) for name, (steps, _) in curves.items() if name in LOSSES]
    step = step_of(checkpoints[0]) if checkpoints else max(logged, default=None)
    values = {
        "stage": stage_name(config),
        "backbone": config["backbone"]["name"],
        **costs[architecture],
        "steps": step,
        "images": None if step is None else step * int(config["data"]["batch_size"]),
        "train_loss": _number(train[-max(len(train) // 10, 1) :].mean()) if len(train) else None,
        "val_best": _number(validation.min()) if len(validation) else None,
        "val_last": _number(validation[-1]) if len(validation) else None,
        "straightness": _number(straightness[-1]) if len(straightness) else None,
        "seconds": training_seconds(path),
    }
    return Run(label, path, config, values, curves, read_fidelity(path))


def _number(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def stage_name(config: Mapping[str, Any]) -> str:
    """'rectify', 'reflow', or 'distill 2' for two steps."""
    stage = config["stage"]
    return f"{stage['name']} {stage['steps']}" if "steps" in stage else str(stage["name"])


def cost(config: Mapping[str, Any], repeats: int, device: str) -> dict[str, Any]:
    """Parameters, GMAC and, on request, milliseconds of one evaluation for one image of a config's backbone."""
    generator = build_generator(config)
    if not isinstance(generator, RectifiedFlow):
        return {"parameters": count_parameters(generator)}
    model = generator.backbone.eval()
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
    files = sorted([*path.glob("fidelity.json"), *path.glob("*/fidelity.json")])
    if not files:
        return {}
    newest = max(files, key=lambda file: file.stat().st_mtime)
    try:
        return {line: float(value) for line, value in json.loads(newest.read_text("utf-8"))["sets"]["other"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{newest} is no result of 'r2flow report fidelity'; remove it or make it again.") from None


@dataclass(frozen=True)
class Group:
    """Runs that differ in nothing but their seed; a run alone where they were not to be grouped."""

    label: str
    runs: tuple[Run, ...]

    def spread(self, column: str) -> tuple[float, float | None] | None:
        """Mean and standard deviation over the runs that have the value; None where none has it."""
        found = [run.values[column] for run in self.runs if run.values.get(column) is not None]
        return _spread(found)

    def fidelity(self, line: str) -> tuple[float, float | None] | None:
        return _spread([run.fidelity[line] for run in self.runs if line in run.fidelity])


def _spread(values: Sequence[float]) -> tuple[float, float | None] | None:
    if not values:
        return None
    return fmean(values), stdev(values) if len(values) > 1 else None


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Runs of one configuration and several seeds together, in the order given."""
    groups: list[list[Run]] = []
    for run in runs:
        same = next((g for g in groups if same_but_seed(g[0].config, run.config)), None)
        if same is None:
            groups.append([run])
        else:
            same.append(run)
    return [Group(group_label(group), tuple(group)) for group in groups]


def same_but_seed(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Whether two configs train the same thing, from another seed or from parents that do so."""
    # Pairs carry their parent's hash, which is another one for another seed.
    on_pairs = first["data"]["name"] == "pairs"
    ignored = {"seed", "data.pairs.parent", "scans"} if on_pairs else {"seed"}
    trimmed = [
        {key: value for key, value in flatten(config) if key not in ignored and not key.startswith("parent.")}
        for config in (first, second)
    ]
    return not contradictions(*trimmed) and _same_parents(first, second)


def _same_parents(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    one, other = first.get("parent"), second.get("parent")
    if not one or not other or one["weights"] == other["weights"]:
        return bool(one) == bool(other)
    configs = [read_config(Path(parent["path"]).parent.parent) for parent in (one, other)]
    # Without a parent's folder its config is not known, and the runs stay apart.
    return bool(configs[0] and configs[1] and same_but_seed(configs[0], configs[1]))


def group_label(runs: Sequence[Run]) -> str:
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
        for column in MEASURED:
            row |= _columns(column, group.spread(column))
        for line in panel_lines(groups):
            row |= _columns(line, group.fidelity(line))
        rows.append(row)
    return rows


def _columns(name: str, spread: tuple[float, float | None] | None) -> dict[str, float | None]:
    mean, deviation = spread or (None, None)
    return {name: mean, f"{name}_spread": deviation}


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
    results = {key: heading for key, heading in MEASURED.items() if key != "latency_ms"}
    timed = any(row["latency_ms"] is not None for row in rows)
    latencies = {"latency_ms": MEASURED["latency_ms"]} if timed else {}
    lines = panel_lines(groups)
    columns: dict[str, dict[str, str]] = {
        "Runs": {**FIXED, **latencies},
        "Results": results,
        **({"Distance to real scans": {line: line for line in lines}} if lines else {}),
    }
    return [
        (title, [[row["name"], *(cell(row, key) for key in [*several, *own])] for row in rows],
         ["run", *several.values(), *own.values()])
        for title, own in columns.items()
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
    spread = ["Several seeds: mean ± standard deviation over n runs."] if any(len(g.runs) > 1 for g in groups) else []
    seeds = {run.label: int(run.config["seed"]) for group in groups for run in group.runs if "seed" in run.config}
    written = [part for title, cells, headings in tables(groups) for part in (f"## {title}", table(cells, headings))]
    members = [{"group": g.label, "run": run.label, **run.values, **run.fidelity} for g in groups for run in g.runs]
    return Page(
        name="compare",
        title="Runs compared",
        text=[*written, "## How to read it", NOTES, *spread],
        rows=rows_of(groups),
        figures={"compare": compare_figure(groups)},
        command=command,
        seeds=seeds,
        device=device,
        more={"runs": members},
    )


def compare_figure(groups: Sequence[Group]) -> Figure:
    """Learning curves above, a panel of points for each figure below."""
    panels = [c for c in ("train_loss", "val_best", "straightness", "gmac", "seconds") if _has(groups, c)]
    height = 3.6 + 0.9 + 0.26 * len(groups)
    figure = blank_figure(11, height)
    grid = figure.add_gridspec(2, 1, height_ratios=(3.6, 0.9 + 0.26 * len(groups)))
    above = grid[0].subgridspec(1, 2)
    for index, (name, title) in enumerate(zip(LOSSES, ("training loss", "validation loss"), strict=True)):
        axes = figure.add_subplot(above[0, index])
        _draw_curves(axes, groups, name)
        axes.set(title=title, xlabel="optimiser step")
    below = grid[1].subgridspec(1, max(len(panels), 1))
    first = None
    for index, column in enumerate(panels):
        axes = figure.add_subplot(below[0, index], sharey=first)
        _draw_points(axes, groups, column)
        axes.set_title({**MEASURED, **FIXED}[column], fontsize=9)
        axes.set_yticks(range(len(groups)), [group.label for group in groups], fontsize=8)
        axes.tick_params(labelleft=index == 0, labelsize=8)
        first = first or axes
    if first is not None:
        first.set_ylim(len(groups) - 0.5, -0.5)
    return figure


def _has(groups: Sequence[Group], column: str) -> bool:
    return any(run.values.get(column) is not None for group in groups for run in group.runs)


def _draw_curves(axes: Any, groups: Sequence[Group], name: str) -> None:
    """Every run's curve in its group's style; many points as their running mean over a twentieth of the run."""
    drawn = []
    for style, group in zip(_styles(len(groups)), groups, strict=True):
        for number, run in enumerate(group.runs):
            if name not in run.curves:
                continue
            steps, values = smooth(*run.curves[name])
            drawn.append(values)
            axes.plot(
                steps, values, **style, markersize=4, markevery=max(len(steps) // 8, 1), linewidth=1.1,
                label=group.label if number == 0 else None,
            )  # fmt: skip
    if not drawn:
        axes.text(0.5, 0.5, "not logged", ha="center", va="center", transform=axes.transAxes)
        return
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


def _draw_points(axes: Any, groups: Sequence[Group], column: str) -> None:
    for row, (style, group) in enumerate(zip(_styles(len(groups)), groups, strict=True)):
        values = [float(run.values[column]) for run in group.runs if run.values.get(column) is not None]
        found = _spread(values)
        if found is None:
            axes.text(0.02, row, "-", va="center", transform=axes.get_yaxis_transform())
            continue
        mean, deviation = found
        mark = {"color": style["color"], "marker": style["marker"]}
        axes.errorbar(mean, row, xerr=deviation or None, capsize=3, markersize=6, linestyle="none", **mark)
        if len(values) > 1:
            axes.plot(values, [row] * len(values), "|", color=style["color"], markersize=9, alpha=0.6)
    axes.grid(axis="x", alpha=0.25)
    axes.margins(x=0.15)
    axes.locator_params(axis="x", nbins=4)


def _styles(count: int) -> list[dict[str, Any]]:
    return [STYLES[index % len(STYLES)] for index in range(count)]
