"""Completion of masked scans by models and interpolation: errors and cost."""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy import ndarray

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.generators import Sampler
from r2flow.generators.base import Progress
from r2flow.lidar.interpolation import Rule, interpolated
from r2flow.lidar.known import parse_mask, ray_states
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.completion import UNITS, common_mae, errors, spread_errors
from r2flow.metrics.panel import distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import complete
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table

TASKS = ("rows:4", "rows:2", "random:0.5", "points:0.1", "sector:-11.25,11.25")
_COLUMNS = {
    "method": "method",
    "evaluations": "evaluations",
    "seconds": "seconds",
    "mae_common_m": "MAE where all return (m)",
    **UNITS,
    "panel": "panel",
    "mae_of_median_m": "MAE of the median (m)",
    "crps_m": "CRPS (m)",
    "coverage": "coverage",
    "nominal": "of nominal",
}
INTERPOLATIONS: dict[str, Rule] = {
    "nearest": "nearest",
    "linear": "linear",
    "linear, 1/r": "inverse",
}


def kept_rays(task: str, sensor: Sensor, number: int) -> ndarray:
    """Rays of scan `number` that a mask keeps, (H, W) bool; depends only on both."""
    draws = noise.generator(0, "condition", number)
    kept = parse_mask(task)(np.ones(sensor.shape, dtype=bool), draws)
    if kept.all() or not kept.any():
        raise InputError(f"the task {task!r} hides no ray or every ray; give another mask.")
    return kept


def completion_rows(
    truths: Sequence[ndarray],
    sensor: Sensor,
    ways: Mapping[str, tuple[Checkpoint, Sampler]],
    tasks: Sequence[str] = TASKS,
    num: int = 8,
    seed: int = 0,
    batch_size: int = 4,
    progress: Progress = None,
) -> Iterator[Row]:
    """One row per task and method, means over scans and their `num` answers.

    Methods are models with samplers, by name in tables, and interpolations, which have one answer.
    """
    real = np.stack(truths)
    reference = panel(real, sensor)
    for task in tasks:
        masks = np.stack([kept_rays(task, sensor, number) for number in range(len(real))])
        given = real * masks[:, None]
        state = ray_states(torch.from_numpy(real), torch.from_numpy(masks))
        answers = {  # (scans, answers, channels, H, W) by method
            name: np.stack([interpolated(*pair, rule) for pair in zip(given, masks, strict=True)])[
                :, None
            ]
            for name, rule in INTERPOLATIONS.items()
        }
        cost = {}
        for name, (checkpoint, sampler) in ways.items():
            results = list(
                complete(
                    checkpoint,
                    torch.from_numpy(given),
                    state,
                    num,
                    seed,
                    sampler=sampler,
                    batch_size=batch_size,
                    progress=progress,
                )
            )
            channels = real.shape[1]  # without labels
            answers[name] = np.stack([result.images[:, :channels].numpy() for result in results])
            cost[name] = {
                "evaluations": float(np.mean([r.evaluations.float().mean() for r in results])),
                "seconds": float(np.mean([r.seconds for r in results])) / num,
            }
        firsts = [images[:, 0] for images in answers.values()]
        cases = list(zip(real, zip(*firsts, strict=True), ~masks, strict=True))
        common = _mean_row([dict(zip(answers, common_mae(*case), strict=True)) for case in cases])
        channels = min(images.shape[1] for images in firsts)
        for name, images in answers.items():
            scans = list(zip(real, images, ~masks, strict=True))
            completed = panel(images[:, 0, :channels], sensor)
            row = {"task": task, "method": name, "evaluations": 0.0, **cost.get(name, {})}
            row["mae_common_m"] = common.get(name, math.nan)
            row |= _mean_row([errors(x, y, hid, sensor) for x, each, hid in scans for y in each])
            row["panel"] = mean_distance(distances(completed, reference))
            if num > 1 and name in ways:
                row |= _mean_row([spread_errors(*scan) for scan in scans])
            yield row


def _mean_row(rows: Sequence[Row]) -> Row:
    """Mean of each column over the rows that have a number; without columns that have none."""
    columns = {key: [row[key] for row in rows if not math.isnan(row[key])] for key in rows[0]}
    return {key: float(np.mean(values)) for key, values in columns.items() if values}


def completion_page(rows: Sequence[Row], about: str, seed: int, device: str) -> Page:
    """Build the page: a table per task."""
    text: list[Part] = [
        f"{about} Figures are of the hidden rays, means over scans and answers, unless their name "
        "says otherwise: "
        "`MAE, all pixels` is LiDARGen's and RangeLDM's, IoU and Chamfer are of whole scans with "
        "the measured rays "
        "pasted in. The panel is the mean distance of its lines between the completed scans and "
        "the true ones; it and "
        "`MAE where all return` are of the first answers. "
        "Coverage is the share of hidden ranges between the least and the greatest answer."
    ]
    for task in dict.fromkeys(row["task"] for row in rows):
        part = [row for row in rows if row["task"] == task]
        known = {key for row in part for key in row}
        columns = {key: heading for key, heading in _COLUMNS.items() if key in known}
        text.append(Table(part, columns, task))
    return Page("completion", "Completed scans", text, rows, {}, {"noise": seed}, device)
