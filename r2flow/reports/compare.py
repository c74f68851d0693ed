"""Comparison of runs: settings, losses, bend and cost."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from os.path import commonprefix
from pathlib import Path
from statistics import fmean, stdev

from r2flow.base.config import flatten
from r2flow.data.options import PAIRS
from r2flow.model.config import ModelConfig, learned
from r2flow.reports.pages import Page
from r2flow.reports.runs import ComparedRun, read_runs
from r2flow.reports.tables import Part, Row, Table
from r2flow.reports.training import curves_figure
from r2flow.runs.folder import read_config

# Column -> heading: equal for all seeds, and averaged over seeds.
_SETTINGS = {
    "stage": "stage",
    "data": "data",
    "backbone": "backbone",
    "parameters": "parameters",
    "gmac": "GMAC",
    "steps": "steps",
    "images": "images",
}
_RESULTS = {
    "train_loss": "train loss, last tenth",
    "val_best": "val loss, best",
    "val_last": "val loss, last",
    "bend": "bend",
}

_NOTES = (
    "Losses are those that were logged: of validation, with the averaged weights; compare them "
    "only between runs with the same loss and the same data. Bend is the last `curvature/bend`, "
    "s(t) over the squared path length; an untrained flow is straight too. Several seeds: mean ± "
    "standard deviation."
)


_Groups = Mapping[str, Sequence[ComparedRun]]  # by label: runs that differ only in their seed


def report_runs(folders: Sequence[Path], group: bool = False) -> Page:
    """The page of some runs, or of the runs in folders of runs (a chain, a sweep); `group` joins
    those that differ only in their seed.
    """
    runs = read_runs(folders)
    return compare_page(group_runs(runs) if group else {run.label: [run] for run in runs})


def group_runs(runs: Sequence[ComparedRun]) -> _Groups:
    """Group runs that differ only in their seed, and in the seeds of their ancestors."""
    groups: dict[str, list[ComparedRun]] = {}
    for run in runs:
        groups.setdefault(configuration(run.config), []).append(run)
    named: dict[str, list[ComparedRun]] = {}
    for group in groups.values():
        # Folders of a sweep are named after the swept values and a hash.
        name = group[0].label
        if len(group) > 1:
            seeds = r"[-_.,/= ]*seed[-_.= ]*\d+[-_.,/= ]*|-\w{6}$"
            alike = commonprefix([re.sub(seeds, "", run.label) for run in group])  # noqa: RUF071
            name = alike.rstrip("-_.,/= ") or group[0].values["stage"]
        named[f"{name} ({len(named)})" if name in named else name] = group
    return named


def configuration(config: ModelConfig) -> str:
    """Settings of a run and its ancestors that affect the result, without seeds, as text."""
    ignored = ["seed"]
    if config.data.name == PAIRS:  # their parent differs between seeds
        ignored += ["data.pairs.parent", "scans"]
    settings = {
        key: value
        for key, value in flatten(learned(config.stored))
        if key not in ignored and not key.startswith("stage.parent.")
    }
    values = dict(flatten(config.stored))  # a run may resume with other values of these
    for key in ("trainer.precision", "stage.parent.step", "data.pairs.of"):
        settings[key] = values.get(key)
    if parent := config.stage.parent:
        before = read_config(Path(parent.path).parent.parent)
        settings["parent"] = configuration(ModelConfig(before)) if before else parent.weights
    return json.dumps(settings, sort_keys=True, default=str)


def _group_rows(groups: _Groups) -> list[Row]:
    """One row per group: means of the runs with a value, and the deviation of several."""
    rows = []
    for label, runs in groups.items():
        started = sum(run.values["steps"] is not None for run in runs)
        row: Row = {
            "name": label,
            "n": len(runs) if started == len(runs) else f"{started} of {len(runs)}",
        }
        for column in _SETTINGS:
            equal = {run.values[column] for run in runs}
            row[column] = equal.pop() if len(equal) == 1 else None
        for column in _RESULTS:
            values = [run.values[column] for run in runs if run.values[column] is not None]
            several = len(values) > 1 and all(map(math.isfinite, values))
            row[column] = fmean(values) if values else None
            row[f"{column}_spread"] = stdev(values) if several else None
        rows.append(row)
    return rows


def cell(row: Row, column: str) -> str:
    """Format a value: '0.243 ± 0.004' over several runs, '-' if missing, 'nan' if one diverged."""
    value = row[column]
    if value is None:
        return "-"
    if isinstance(value, str):
        return value
    text = f"{value:,}" if isinstance(value, int) else f"{value:.3g}"
    spread = row.get(f"{column}_spread")
    return text if spread is None else f"{text} ± {spread:.3g}"


def compare_page(groups: _Groups) -> Page:
    """Build the page of a comparison: tables, curves, and which losses cannot be compared."""
    members = [(label, run) for label, runs in groups.items() for run in runs]
    rows = _group_rows(groups)
    cells = [{key: cell(row, key) for key in row} for row in rows]
    measured = {key: _RESULTS[key] for key in _RESULTS if any(row[key] is not None for row in rows)}
    text: list[Part] = [
        Table(cells, {"name": "run", "n": "n", **_SETTINGS}, "Runs"),
        Table(cells, {"name": "run", **measured}, "Results"),
    ]
    compared = ("images", "stage", "loss", "data")
    differ = [key for key in compared if len({str(run.values[key]) for _, run in members}) > 1]
    if differ:
        text.append(
            f"the runs differ in {', '.join(differ)}: compare them at equal steps, or by r2flow "
            "evaluate, not by their losses"
        )
    figures = {}
    if any(run.curves for _, run in members):
        figures["compare"] = curves_figure([(label, run.curves) for label, run in members])
    seeds = {run.label: run.config.seed for _, run in members}
    each = [{"group": label, "run": run.label, **run.values} for label, run in members]
    title = "Runs compared"
    return Page("compare", title, text, rows, figures, seeds, more={"runs": each}, details=[_NOTES])
