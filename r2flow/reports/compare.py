"""Comparison of runs: settings, losses, bend and cost."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev

from r2flow.base.config import flatten
from r2flow.model.config import learned
from r2flow.reports.pages import Page
from r2flow.reports.runs import ComparedRun
from r2flow.reports.tables import Row, Table, latex, print_table
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
    "only between runs with "
    "the same loss and the same data. Bend is the last `curvature/bend`, s(t) over the squared "
    "path length; an "
    "untrained flow is straight too. Several seeds: mean ± standard deviation."
)


Groups = Mapping[str, Sequence[ComparedRun]]  # by label: runs that differ only in their seed


def group_runs(runs: Sequence[ComparedRun]) -> Groups:
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
            alike = _shared([re.sub(seeds, "", run.label) for run in group])
            name = alike.rstrip("-_.,/= ") or group[0].values["stage"]
        named[f"{name} ({len(named)})" if name in named else name] = group
    return named


def _shared(names: Sequence[str]) -> str:
    """The longest beginning of some names."""
    first, last = min(names), max(names)
    differ = (n for n, (a, b) in enumerate(zip(first, last, strict=False)) if a != b)
    return first[: next(differ, len(first))]


def configuration(config: Row) -> str:
    """Settings of a run and its ancestors that affect the result, without seeds, as text."""
    settings = dict(flatten(learned(config)))
    ignored = ["seed"]
    if config["data"]["name"] == "pairs":  # their parent differs between seeds
        ignored += ["data.pairs.parent", "scans"]
    kept = {
        key: value
        for key, value in settings.items()
        if key not in ignored and not key.startswith("stage.parent.")
    }
    given = dict(flatten(config))  # a run may resume with other values of these
    for key in ("trainer.precision", "stage.parent.step", "data.pairs.of"):
        kept[key] = given.get(key)
    parent = config["stage"].get("parent")
    if parent:
        before = read_config(Path(parent["path"]).parent.parent)
        kept["parent"] = configuration(before) if before else parent["weights"]
    return json.dumps(kept, sort_keys=True, default=str)


def _group_rows(groups: Groups) -> list[Row]:
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


def _tables(groups: Groups) -> dict[str, tuple[list[Row], dict[str, str]]]:
    """Rows of text and headings by title: settings of the runs, and results."""
    rows = _group_rows(groups)
    text = [{key: cell(row, key) for key in row} for row in rows]
    measured = {
        key: heading
        for key, heading in _RESULTS.items()
        if any(row[key] is not None for row in rows)
    }
    name = {"name": "run"}
    return {"Runs": (text, {**name, "n": "n", **_SETTINGS}), "Results": (text, name | measured)}


def print_comparison(groups: Groups, tex: bool = False) -> None:
    """Print the tables, for a terminal or in LaTeX, and which runs cannot be compared by their
    losses.
    """
    for title, (rows, columns) in _tables(groups).items():
        if tex:
            print(f"% {title}\n{latex(rows, columns)}")
            continue
        print_table(rows, columns, title)
        print()
    if tex:
        return
    runs = [run.values for group in groups.values() for run in group]
    compared = ("images", "stage", "loss", "data")
    differ = [key for key in compared if len({str(run[key]) for run in runs}) > 1]
    if differ:
        print(
            f"the runs differ in {', '.join(differ)}: compare them at equal steps, or by r2flow "
            "evaluate, not by their losses"
        )


def compare_page(groups: Groups) -> Page:
    """Build the page of a comparison: tables and curves."""
    members = [(label, run) for label, runs in groups.items() for run in runs]
    seeds = {run.label: int(run.config["seed"]) for _, run in members if "seed" in run.config}
    text = []
    for title, (rows, columns) in _tables(groups).items():
        text.append(Table(rows, columns, title))
    figures = {}
    if any(run.curves for _, run in members):
        figures["compare"] = curves_figure([(label, run.curves) for label, run in members])
    each = [{"group": label, "run": run.label, **run.values} for label, run in members]
    return Page(
        "compare",
        "Runs compared",
        [*text, _NOTES],
        _group_rows(groups),
        figures,
        seeds,
        more={"runs": each},
    )
