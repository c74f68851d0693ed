"""Comparison of runs: settings, losses, bend and cost."""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, NamedTuple

from r2flow.config import flatten, rule
from r2flow.errors import InputError, naming
from r2flow.model.checkpoint import checkpoints_of, step_of
from r2flow.plugins import made_with
from r2flow.reports.backbones import cost
from r2flow.reports.pages import Page
from r2flow.reports.tables import shown, table
from r2flow.reports.training import CURVES, Curve, curves_figure, read_curves
from r2flow.runs.folder import CONFIG, read_config

# Column -> heading: equal for all seeds, and averaged over seeds.
FIXED = {
    "stage": "stage", "data": "data", "backbone": "backbone", "parameters": "parameters", "gmac": "GMAC",
    "steps": "steps", "images": "images",
}  # fmt: skip
MEASURED = {
    "train_loss": "train loss, last tenth", "val_best": "val loss, best", "val_last": "val loss, last",
    "bend": "bend",
}  # fmt: skip

# Keys that are equal for all seeds, though a run may resume with another value: they change a column.
TELLING = {"trainer.precision", "trainer.val_check_interval", "data.root", "data.pairs.of", "data.scans.root",
           "parent.step", "callbacks.curvature.num", "callbacks.curvature.steps"}  # fmt: skip


class ComparedRun(NamedTuple):
    """A run, read from its folder."""

    label: str
    config: dict[str, Any]
    values: dict[str, Any]  # by the columns of `FIXED` and `MEASURED`; None where the folder does not hold one
    curves: dict[str, Curve]  # (steps, values) by logged name


Groups = Mapping[str, Sequence[ComparedRun]]  # by label: runs that differ only in their seed, or a single run


def find_runs(paths: Sequence[Path]) -> list[Path]:
    """Given run folders, and the runs in folders of runs (a chain, a sweep, a sweep of chains).

    Other paths, as in `runs/sweep/*`, are skipped if there is any run.
    """
    runs: list[Path] = []
    for path in paths:
        inside = [run.parent for level in ("", "*/", "*/*/") for run in sorted(path.glob(f"{level}{CONFIG}"))]
        runs += [path] if path in inside else [run for run in inside if not run.name.startswith(".")]
    if wrong := [path for path in paths if not runs or not path.exists()]:
        raise InputError(f"{wrong[0]} is not a run: it has no {CONFIG}. Give folders that train.py has written.")
    return list({run.resolve(): run for run in runs}.values())  # a link and its run are one


def labels(paths: Sequence[Path]) -> list[str]:
    """Names of files or folders, with as many parents as needed to be unique."""
    parts = [Path(os.path.abspath(path)).parts for path in paths]  # links keep the names that the user gave them
    depth = 1
    while depth < max(map(len, parts), default=1) and len({p[-depth:] for p in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(p[-depth:]) for p in parts]


def read_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """Read all runs; build each network once."""
    folders = find_runs(paths)
    costs: dict[str, dict[str, Any]] = {}
    runs = []
    for path, label in zip(folders, labels(folders), strict=True):
        config = read_config(path) or {}
        if not {"stage", "backbone", "data", "sensor", "encoding"} <= config.keys():
            raise InputError(f"{path / CONFIG} is not the config of a run.")
        keys = ("sensor", "encoding", "backbone", "generator")
        architecture = json.dumps([config.get(key) for key in keys], sort_keys=True)
        if architecture not in costs:
            with naming(path), made_with(config, str(path)):
                costs[architecture] = cost(config)
        curves = read_curves(path, tuple(CURVES))
        runs.append(ComparedRun(label, config, {**costs[architecture], **_read_values(path, config, curves)}, curves))
    return runs


def _read_values(path: Path, config: Mapping[str, Any], curves: Mapping[str, Curve]) -> dict[str, Any]:
    """Columns of a run that do not depend on its network."""
    train, validation, bend = (curves[name][1].tolist() if name in curves else [] for name in CURVES)
    checkpoints = checkpoints_of(path)
    logged = [int(steps[-1]) for name, (steps, _) in curves.items() if name.endswith("loss")]
    step = step_of(checkpoints[0]) if checkpoints else max(logged, default=None)
    stage, data = config["stage"], config["data"]
    return {
        "stage": f"{stage['name']} {stage['steps']}" if "steps" in stage else str(stage["name"]),
        "loss": str([stage.get(key) for key in ("loss", "time")]),
        "data": data["name"] if data["name"] == "pairs" else f"{data['name']} {data.get('root') or ''}".strip(),
        "backbone": (config["backbone"] or {}).get("name"),
        "steps": step,
        "images": None if step is None else step * int(data["batch_size"]),
        "train_loss": fmean(train[-max(len(train) // 10, 1) :]) if train else None,
        "val_best": min(validation, key=lambda loss: (math.isnan(loss), loss), default=None),
        "val_last": validation[-1] if validation else None,
        "bend": bend[-1] if bend else None,
    }


def group_runs(runs: Sequence[ComparedRun]) -> Groups:
    """Group runs that differ only in their seed, in the given order."""
    groups: dict[str, list[ComparedRun]] = {}
    for run in runs:
        groups.setdefault(configuration(run.config), []).append(run)
    labelled = [(_common_label(group), text.split("\n"), group) for text, group in groups.items()]
    named: dict[str, list[ComparedRun]] = {}
    for label, settings, group in labelled:  # equal labels are told apart by the settings that differ
        shared = set.intersection(*(set(others) for other, others, _ in labelled if other == label))
        differing = [one for one in settings if one not in shared]
        if any(one.startswith("parent=") for one in differing):  # others have no parent, or one of another stage
            differing = [one for one in differing if not one.startswith("parent.")]
        name = ", ".join([label, *differing])
        named[name if name not in named else f"{name} ({len(named)})"] = group
    return named


def configuration(config: Mapping[str, Any]) -> str:
    """Configuration of a run and its ancestors, without seeds, as text."""
    pairs = config["data"]["name"] == "pairs"
    # The parent's hash in pairs and their folder differ between seeds.
    ignored = {"seed", "data.pairs.parent", "scans", "data.root"} if pairs else {"seed"}
    keys = [
        f"{key}={value}"
        for key, value in sorted(flatten(config))
        if value is not None and key not in ignored
        if key in TELLING or (rule(key).resume != "free" and not key.startswith("parent."))
        if pairs or not key.startswith("data.pairs.")
    ]
    if parent := config.get("parent"):
        before = read_config(Path(parent["path"]).parent.parent)
        keys.append(f"parent={parent.get('stage')}")
        keys += [f"parent.{line}" for line in (configuration(before) if before else parent["weights"]).split("\n")]
    return "\n".join(keys)


def _common_label(runs: Sequence[ComparedRun]) -> str:
    """Common prefix of run names, without the word seed."""
    signs = takewhile(lambda signs: len(set(signs)) == 1, zip(*(run.label for run in runs), strict=False))
    common = "".join(sign for sign, *_ in signs)
    if len(runs) > 1:
        common = re.sub(r"[-_.,/= ]*(seed[-_.= ]*\d*)?[-_.,/= ]*$", "", common)
    return common or f"{runs[0].values['stage']}, {runs[0].values['backbone']}"


def rows_of(groups: Groups) -> list[dict[str, Any]]:
    """One row per group: means, with standard deviation for several runs, and the number of runs that have a value."""
    rows = []
    for label, runs in groups.items():
        row: dict[str, Any] = {"name": label, "n": len(runs)}
        for column in FIXED:
            equal = {run.values[column] for run in runs}
            row[column] = equal.pop() if len(equal) == 1 else None
        for column in MEASURED:
            values = [run.values[column] for run in runs if run.values[column] is not None]
            row[column] = fmean(values) if values else None
            several = len(values) > 1 and all(map(math.isfinite, values))
            row[f"{column}_spread"], row[f"{column}_n"] = stdev(values) if several else None, len(values)
        rows.append(row)
    return rows


def cell(row: Mapping[str, Any], column: str) -> str:
    """Format a value: '0.243 ± 0.004 of 2' over several runs if some lack it, '-' if missing, 'nan' if one diverged."""
    value, deviation = row.get(column), row.get(f"{column}_spread")
    if value is None or value != value:
        return "-" if value is None else "nan"
    text = f"{value:,}" if isinstance(value, int) else shown(value)
    text += "" if deviation is None else f" ± {shown(deviation)}"
    have = row.get(f"{column}_n", row["n"])
    return text if have == row["n"] else f"{text} of {have}"


def tables(groups: Groups) -> dict[str, tuple[list[list[str]], list[str]]]:
    """(cells, headings) by title: settings of the runs, and results."""
    rows = rows_of(groups)
    measured = {key: heading for key, heading in MEASURED.items() if any(row[key] is not None for row in rows)}
    parts = {"Runs": {"n": "n", **FIXED}, "Results": measured}
    return {
        title: ([[row["name"], *(cell(row, key) for key in columns)] for row in rows], ["run", *columns.values()])
        for title, columns in parts.items()
    }


NOTES = (
    "Losses are those that were logged: of validation, with the averaged weights; compare them only between runs with "
    "the same loss and the same data. Bend is the last `curvature/bend`, s(t) over the squared path length; an "
    "untrained flow is straight too. Several seeds: mean ± standard deviation, `of` those with a value."
)


def compare_page(groups: Groups) -> Page:
    members = [(label, run) for label, runs in groups.items() for run in runs]
    seeds = {run.label: int(run.config["seed"]) for _, run in members if "seed" in run.config}
    written = [text for title, parts in tables(groups).items() for text in (f"## {title}", table(*parts))]
    curves = [(label, run.curves) for label, run in members]
    figures = {"compare": curves_figure(curves)} if any(one for _, one in curves) else {}
    rows = [{"group": label, "run": run.label, **run.values} for label, run in members]
    return Page("compare", "Runs compared", [*written, NOTES], rows_of(groups), figures, seeds,
                more={"runs": rows})  # fmt: skip
