"""Completion of masked scans by models and interpolation: errors and cost."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow import noise
from r2flow.errors import InputError
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
from r2flow.reports.pictures import completed_figure
from r2flow.reports.tables import table

TASKS = ("rows:4", "rows:2", "random:0.5", "points:0.1", "sector:-11.25,11.25")
COLUMNS = {
    "method": "method", "evaluations": "evaluations", "seconds": "seconds",
    "mae_common_m": "MAE where all return (m)", **UNITS, "panel": "panel",
    "mae_of_median_m": "MAE of the median (m)", "crps_m": "CRPS (m)", "coverage": "coverage", "nominal": "of nominal",
}  # fmt: skip
INTERPOLATIONS: dict[str, Rule] = {"nearest": "nearest", "linear": "linear", "linear, 1/r": "inverse"}


def measured_by(task: str, sensor: Sensor, number: int) -> np.ndarray:
    """Rays of scan `number` that a mask keeps, (H, W) bool; depends only on both."""
    measured = parse_mask(task)(np.ones(sensor.shape, dtype=bool), noise.generator(0, "condition", number))
    if measured.all() or not measured.any():
        raise InputError(f"the task {task!r} hides {'no' if measured.all() else 'every'} ray; give another mask.")
    return measured


def completion_rows(
    truths: Sequence[np.ndarray],
    sensor: Sensor,
    ways: Mapping[str, tuple[Checkpoint, Sampler]],
    tasks: Sequence[str] = TASKS,
    num: int = 8,
    seed: int = 0,
    batch_size: int = 4,
    progress: Progress = None,
) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """One row per task and method, means over scans and their `num` answers, and the first answer to the first scan.

    Methods are models with samplers, by name in tables, and interpolations, which have one answer.
    """
    reference = panel(np.stack(truths), sensor)
    for task in tasks:
        masks = [measured_by(task, sensor, i) for i in range(len(truths))]
        given = [truth * mask for truth, mask in zip(truths, masks, strict=True)]
        images = torch.from_numpy(np.stack(given))
        state = ray_states(torch.from_numpy(np.stack(truths)), torch.from_numpy(np.stack(masks)))
        answers: dict[str, list[np.ndarray]] = {}
        cost: dict[str, tuple[float, float]] = {}
        for name, rule in INTERPOLATIONS.items():
            answers[name] = [interpolated(image, mask, rule)[None] for image, mask in zip(given, masks, strict=True)]
        for name, (checkpoint, sampler) in ways.items():
            how: Any = {"sampler": sampler, "batch_size": batch_size, "progress": progress}
            results = list(complete(checkpoint, images, state, num, seed, **how))
            answers[name] = [result.images.numpy() for result in results]
            evaluations = float(torch.cat([result.evaluations for result in results]).float().mean())
            cost[name] = evaluations, sum(result.seconds for result in results) / num / len(results)
        firsts = {name: [images[0] for images in of_method] for name, of_method in answers.items()}
        channels = min(len(images[0]) for images in firsts.values())  # the panels are means of the same lines
        cases = zip(truths, zip(*firsts.values(), strict=True), masks, strict=True)
        common = means([dict(zip(answers, common_mae(x, y, ~mask), strict=True)) for x, y, mask in cases])
        for name, of_method in answers.items():
            evaluations, seconds = cost.get(name, (0.0, math.nan))
            row = {"task": task, "method": name, "evaluations": evaluations, "seconds": seconds}
            row["mae_common_m"] = common[name]
            scans = list(zip(truths, of_method, masks, strict=True))
            off = means([means([errors(x, y, ~mask, sensor) for y in images]) for x, images, mask in scans])
            row |= {key: value for key, value in off.items() if not math.isnan(value)}
            row["panel"] = mean_distance(distances(panel(np.stack(firsts[name])[:, :channels], sensor), reference))
            if num > 1 and name in cost:
                row |= means([spread_errors(x, images, ~mask) for x, images, mask in scans])
            yield row, firsts[name][0]


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of each column without NaN; NaN if all are NaN."""
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return {key: float("nan") if np.isnan(x).all() else float(np.nanmean(x)) for key, x in columns.items()}


def completion_page(rows: Sequence[Mapping[str, Any]], figure: Figure, about: str, seed: int, device: str) -> Page:
    """Build the page: a table per task, and the picture."""
    text = [
        f"{about} Figures are of the hidden rays, means over scans and answers, unless their name says otherwise: "
        "`MAE, all pixels` is LiDARGen's and RangeLDM's, IoU and Chamfer are of whole scans with the measured rays "
        "pasted in. The panel is the mean distance of its lines between the completed scans and the true ones; it and "
        "`MAE where all return` are of the first answers. "
        "Coverage is the share of hidden ranges between the least and the greatest answer."
    ]
    for task in dict.fromkeys(row["task"] for row in rows):
        part = [row for row in rows if row["task"] == task]
        columns = {key: heading for key, heading in COLUMNS.items() if any(key in row for row in part)}
        text += [f"## {task}", table(part, columns)]
    return Page("completion", "Completed scans", text, rows, {"completion": figure}, {"noise": seed}, device)


def pictured(truth: np.ndarray, shown: Sequence[tuple[Mapping[str, Any], np.ndarray]], sensor: Sensor) -> Figure:
    """Figure of one scan and the first task: measured rays, answers, truth."""
    task = shown[0][0]["task"]
    measured = measured_by(task, sensor, 0)
    answers = [(row["method"], image) for row, image in shown if row["task"] == task]
    rows = [(f"measured, {task}", truth * measured), *answers]
    return completed_figure(rows, ~measured, sensor.rays(), truth=(truth, np.zeros_like(measured)))
