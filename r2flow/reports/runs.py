"""Runs read from their folders, for comparison."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from r2flow.base.errors import InputError, check, naming
from r2flow.base.plugins import made_with
from r2flow.data.options import PAIRS
from r2flow.model.config import ModelConfig
from r2flow.model.paths import checkpoints_of, step_of
from r2flow.reports.backbones import cost
from r2flow.reports.tables import Row, short_names
from r2flow.reports.training import CURVES, Curve, read_curves
from r2flow.runs.folder import CONFIG, read_config


class ComparedRun(NamedTuple):
    """A run, read from its folder."""

    label: str
    config: ModelConfig
    values: Row  # by column; None where the folder does not hold one
    curves: dict[str, Curve]  # (steps, values) by logged name


def _find_runs(paths: Sequence[Path]) -> list[Path]:
    """Given run folders, and the runs in folders of runs (a chain, a sweep, a sweep of chains).

    Other paths, as in `runs/sweep/*`, are skipped if there is any run.
    """
    runs: dict[Path, Path] = {}  # a link and its run are one
    for path in paths:
        levels = [""] if (path / CONFIG).exists() else ["*/", "*/*/"]
        inside = [run.parent for level in levels for run in sorted(path.glob(level + CONFIG))]
        runs |= {
            run.resolve(): run for run in inside if run == path or not run.name.startswith(".")
        }
    wrong = [path for path in paths if not runs or not path.exists()]
    if wrong:
        raise InputError(
            f"{wrong[0]} is not a run: it has no {CONFIG}. Give folders that train.py has written."
        )
    return list(runs.values())


def read_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """Read all runs; build each network once."""
    folders = _find_runs(paths)
    costs = {}
    runs = []
    for path, label in zip(folders, short_names(folders), strict=True):
        stored = read_config(path) or {}
        whole = {"stage", "backbone", "data", "sensor", "encoding"} <= stored.keys()
        check(whole and stored["data"], f"{path / CONFIG} is not the config of a run.")
        config = ModelConfig(stored)
        architecture = json.dumps(config.model, sort_keys=True)
        with naming(path), made_with(config.plugins, str(path)):
            if architecture not in costs:
                costs[architecture] = cost(config.model)
        curves = read_curves(path, tuple(CURVES))
        values = costs[architecture] | _read_values(path, config, curves)
        runs.append(ComparedRun(label, config, values, curves))
    return runs


def _read_values(path: Path, config: ModelConfig, curves: Mapping[str, Curve]) -> Row:
    """Columns of a run that do not depend on its network."""
    train, validation, bend = (
        curves[name][1].tolist() if name in curves else [] for name in CURVES
    )
    kept = [step_of(checkpoint) for checkpoint in checkpoints_of(path)[:1]]
    step = max(kept or [int(steps[-1]) for steps, _ in curves.values()], default=None)
    stage = config.stage
    data = config.data
    scans = "" if data.name == PAIRS else data.root or ""
    return {
        "stage": f"{stage.name} {stage.steps or ''}".strip(),
        "loss": str([stage.options.get(key) for key in ("loss", "time")]),
        "data": f"{data.name} {scans}".strip(),
        "backbone": config.backbone,
        "steps": step,
        "images": step and step * data.batch_size,
        "train_loss": fmean(train[-max(len(train) // 10, 1) :]) if train else None,
        "val_best": min(validation, key=lambda loss: (math.isnan(loss), loss), default=None),
        "val_last": validation[-1] if validation else None,
        "bend": bend[-1] if bend else None,
    }
