"""Completion of masked scans by models and interpolation: errors and cost."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy import ndarray

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.base.progress import Bar
from r2flow.data.described import Described, describe
from r2flow.generators import Sampler, TransferFlow
from r2flow.generators.base import Progress
from r2flow.lidar.interpolation import Rule, interpolated
from r2flow.lidar.known import parse_mask, ray_states
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.metrics.completion import UNITS, common_mae, errors, spread_errors
from r2flow.metrics.panel import distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.completion import complete, completing
from r2flow.model.inversion import real_scans
from r2flow.model.shipped import DENSIFY
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table, short_names

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
_RULE = (
    "Figures are of the hidden rays, means over scans and answers, unless their name says "
    "otherwise: `MAE, all pixels` is LiDARGen's and RangeLDM's, IoU and Chamfer are of whole scans "
    "with the measured rays pasted in. The panel is the mean distance of its lines between the "
    "completed scans and the true ones; it and `MAE where all return` are of the first answers. "
    "Coverage is the share of hidden ranges between the least and the greatest answer."
)
INTERPOLATIONS: dict[str, Rule] = {
    "nearest": "nearest",
    "linear": "linear",
    "linear, 1/r": "inverse",
}
_Ways = Mapping[str, tuple[Checkpoint, Sampler]]  # models with samplers by name in tables


def report_completion(
    real: str,
    models: Sequence[str] = (DENSIFY,),
    tasks: Sequence[str] = TASKS,
    num: int = 16,
    answers: int = 1,
    seed: int = 0,
    batch_size: int = 4,
    sensor: str | None = None,
    size: tuple[int, int] | None = None,
    reflectance_scale: float | None = None,
    device: str = "cpu",
    **sampler: Any,
) -> Page:
    """The page of `completion_rows` on at most `num` scans of a set.

    `sampler`: arguments of `completing`. `sensor` and `size` are of models for any sensor; default:
    those of the other models, else of scans that r2flow wrote.

    Raises:
        InputError: models of several sensors, a mask that hides nothing, or scans without a return.
    """
    ways = {}
    named = describe(real)
    for name, model in _models(named, models, sensor, size, device).items():
        way = completing(model.generator, several=answers > 1, **sampler)
        ways[f"{name}, {way}"] = (model, way)
    first = next(iter(ways.values()))[0]
    for task in tasks:
        kept_rays(task, first.sensor, 0)
    _, images = real_scans(first, [named], reflectance_scale, num, need_reflectance=False)
    truths = [image for image in images.numpy() if image[0].any()]
    if not truths:
        raise InputError(f"{real}: no scan has a return, so there is nothing to hide.")
    batches = len(truths) * math.ceil(answers / batch_size) * len(tasks)
    cost = sum(way.evaluations(model.generator) or 0 for model, way in ways.values())
    with Bar("completing", batches * cost, "evaluations") as advance:
        scans = truths, first.sensor
        rows = [*completion_rows(*scans, ways, tasks, answers, seed, batch_size, advance)]
    about = f"{len(truths)} scans of {real} (at most {num}, --num), {answers} completions per scan."
    text: list[Part] = [f"{about} {_RULE}"]
    for task in dict.fromkeys(row["task"] for row in rows):
        part = [row for row in rows if row["task"] == task]
        known = {key for row in part for key in row}
        columns = {key: heading for key, heading in _COLUMNS.items() if key in known}
        text.append(Table(part, columns, task))
    title = "Completed scans"
    return Page("completion", title, text, rows, seeds={"noise": seed}, device=device)


def _models(
    real: Described, models: Sequence[str], sensor: str | None, size: Any, device: str
) -> dict[str, Checkpoint]:
    """Models by name; those of any sensor take the sensor of the others, or of the scans."""
    loaded = {
        name: load_checkpoint(path, device)
        for name, path in zip(short_names(models), models, strict=True)
    }
    fixed = [m.sensor for m in loaded.values() if not isinstance(m.generator, TransferFlow)]
    stored = real.stored
    known = [*fixed, *([stored.sensor] if stored else [])]
    for name, model in loaded.items():
        if isinstance(model.generator, TransferFlow):
            target = named_sensor(sensor or next(iter(known), model.sensor), size)
            loaded[name] = model.through(target)
        elif sensor or size or model.sensor != fixed[0]:
            raise InputError(f"{name} is a model of another sensor or size: report it apart.")
    return loaded


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
    ways: _Ways,
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
    for task in tasks:
        masks = np.stack([kept_rays(task, sensor, number) for number in range(len(real))])
        known = real * masks[:, None]
        state = ray_states(torch.from_numpy(real), torch.from_numpy(masks))
        answers = {}  # (scans, answers, channels, H, W) by method
        costs: dict[str, Row] = {}
        for name, rule in INTERPOLATIONS.items():
            images = [interpolated(*scan, rule) for scan in zip(known, masks, strict=True)]
            answers[name] = np.stack(images)[:, None]
            costs[name] = {"evaluations": 0.0}
        for name, (checkpoint, sampler) in ways.items():
            how: Row = {"sampler": sampler, "batch_size": batch_size, "progress": progress}
            results = [*complete(checkpoint, torch.from_numpy(known), state, num, seed, **how)]
            images = [result.images[:, : real.shape[1]].numpy() for result in results]
            answers[name] = np.stack(images)  # without labels
            costs[name] = {
                "evaluations": float(np.mean([r.evaluations.float().mean() for r in results])),
                "seconds": float(np.mean([r.seconds for r in results])) / num,
            }
        for name, row in _error_rows(real, ~masks, answers, sensor).items():
            yield {"task": task, "method": name, **costs[name], **row}


def _error_rows(
    real: ndarray, hidden: ndarray, answers: Mapping[str, ndarray], sensor: Sensor
) -> dict[str, Row]:
    """Errors of each method, means over scans and answers."""
    reference = panel(real, sensor)
    firsts = [images[:, 0] for images in answers.values()]
    cases = zip(real, zip(*firsts, strict=True), hidden, strict=True)
    common = _mean_row([dict(zip(answers, common_mae(*case), strict=True)) for case in cases])
    channels = min(images.shape[1] for images in firsts)
    rows = {}
    for name, images in answers.items():
        scans = list(zip(real, images, hidden, strict=True))
        completed = panel(images[:, 0, :channels], sensor)
        rows[name] = {
            "mae_common_m": common.get(name, math.nan),
            **_mean_row([errors(x, y, hid, sensor) for x, each, hid in scans for y in each]),
            "panel": mean_distance(distances(completed, reference)),
        }
        if images.shape[1] > 1:
            rows[name] |= _mean_row([spread_errors(*scan) for scan in scans])
    return rows


def _mean_row(rows: Sequence[Row]) -> Row:
    """Mean of each column over the rows that have a number; without columns that have none."""
    columns = {key: [row[key] for row in rows if not math.isnan(row[key])] for key in rows[0]}
    return {key: float(np.mean(values)) for key, values in columns.items() if values}
