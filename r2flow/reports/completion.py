"""Scans of which a part is hidden, completed by models and by interpolation: how near to the truth, at what cost."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow import noise
from r2flow.checkpoints import Checkpoint
from r2flow.completion import complete, completing
from r2flow.errors import InputError
from r2flow.generators import Sampler
from r2flow.generators.base import Progress
from r2flow.lidar.interpolation import OPPONENTS, interpolated
from r2flow.lidar.known import parse_mask, ray_states
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.completion import UNITS, errors, spread_errors
from r2flow.metrics.fidelity import PANEL, distances, panel
from r2flow.reports.pages import Page
from r2flow.reports.pictures import dark_figure, draw_perspective, draw_range
from r2flow.reports.tables import table

TASKS = ("rows:4", "rows:2", "random:0.5", "points:0.1", "sector:-11.25,11.25")
SHOWN = {
    "method": "method", "evaluations": "evaluations", "seconds": "seconds", **UNITS, "panel": "panel",
    "mae_of_median_m": "MAE of the median (m)", "crps_m": "CRPS (m)", "coverage": "coverage", "nominal": "of nominal",
}  # fmt: skip


@dataclass(frozen=True)
class Way:
    """A model and how it is run.

    Attributes:
        name: In tables.
        checkpoint: The model.
        sampler: How it is run.
    """

    name: str
    checkpoint: Checkpoint
    sampler: Sampler


def ways_of(checkpoint: Checkpoint, name: str, solvers: Sequence[str] = (), steps: Sequence[int] = ()) -> list[Way]:
    """A model by its usual way of completing, or by each of the solvers and numbers of steps that are named.

    Raises:
        InputError: a model that cannot complete, or not so.
    """
    ways = []
    for solver in solvers or (None,):
        for count in steps or (None,):
            how = completing(checkpoint.generator, method=solver, steps=count)
            ways.append(Way(f"{name}, {how.method} {how.steps}", checkpoint, how))
    return ways


def hidden_by(task: str, shape: tuple[int, int], number: int) -> np.ndarray:
    """The rays that a task hides of scan `number`, (H, W) bool: a function of both alone."""
    hidden = ~parse_mask(task)(shape, noise.generator(0, "condition", number))
    if not hidden.any() or hidden.all():
        raise InputError(f"the task {task!r} hides {'every' if hidden.all() else 'no'} ray; give one that leaves some.")
    return hidden


def completion_rows(
    truths: Sequence[np.ndarray],
    sensor: Sensor,
    ways: Sequence[Way],
    tasks: Sequence[str] = TASKS,
    answers: int = 8,
    seed: int = 0,
    batch_size: int = 4,
    progress: Progress = None,
) -> Iterator[tuple[dict[str, Any], list[np.ndarray]]]:
    """A row for each task and method, means over scans and answers, and the first answer to each scan.

    Args:
        truths: Range images, (2 or 1, H, W).
        answers: To each scan; interpolations have one.
        batch_size: Answers at once.
    """
    whole = panel(np.stack(truths), sensor)
    for task in tasks:
        hidden = [hidden_by(task, sensor.shape, i) for i in range(len(truths))]
        for name, (rule, inverse) in OPPONENTS.items():
            found = [interpolated(x, ~h, rule, inverse)[None] for x, h in zip(truths, hidden, strict=True)]
            row = _row(task, name, truths, found, hidden, sensor, whole)
            yield {**row, "evaluations": 0, "seconds": float("nan")}, [images[0] for images in found]
        for way in ways:
            found, seconds, evaluations = _answers(way, truths, hidden, answers, seed, batch_size, progress)
            row = _row(task, way.name, truths, found, hidden, sensor, whole)
            yield {**row, "evaluations": evaluations, "seconds": seconds}, [images[0] for images in found]


def _answers(
    way: Way,
    truths: Sequence[np.ndarray],
    hidden: Sequence[np.ndarray],
    answers: int,
    seed: int,
    batch_size: int,
    progress: Progress,
) -> tuple[list[np.ndarray], float, float]:
    images = torch.from_numpy(np.stack(truths))
    state = ray_states(images, ~torch.from_numpy(np.stack(hidden)))
    one = way.checkpoint.generator.evaluations_of(way.sampler) == 1 and way.sampler.fixed
    made = list(
        complete(
            way.checkpoint, images, state, 1 if one else answers, seed, sampler=way.sampler, batch_size=batch_size,
            progress=progress,
        )
    )  # fmt: skip
    count = sum(len(each.images) for each in made)
    evaluations = sum(float(each.evaluations.sum()) for each in made) / count
    return [each.images.numpy() for each in made], sum(each.seconds for each in made) / count, evaluations


def _row(
    task: str,
    name: str,
    truths: Sequence[np.ndarray],
    found: Sequence[np.ndarray],
    hidden: Sequence[np.ndarray],
    sensor: Sensor,
    whole: Mapping[str, np.ndarray],
) -> dict[str, Any]:
    each = [
        {key: np.nanmean(values) if np.isfinite(values).any() else np.nan for key, values in scan.items()}
        for scan in (
            _joined([errors(truth, image, h, sensor) for image in images])
            for truth, images, h in zip(truths, found, hidden, strict=True)
        )
    ]
    row: dict[str, Any] = {"task": task, "method": name}
    row |= {key: float(np.nanmean([one[key] for one in each])) for key in UNITS if _any(each, key)}
    apart = distances(panel(np.stack([images[0] for images in found]), sensor), whole)
    row["panel"] = float(np.mean([apart[line] for line in PANEL if line in apart]))
    if len(found[0]) > 1:
        spread = [spread_errors(*scan) for scan in zip(truths, found, hidden, strict=True)]
        row |= {key: float(np.nanmean([one[key] for one in spread])) for key in spread[0]}
    return row


def _joined(dicts: Sequence[Mapping[str, float]]) -> dict[str, np.ndarray]:
    return {key: np.array([one[key] for one in dicts]) for key in dicts[0]}


def _any(rows: Sequence[Mapping[str, float]], key: str) -> bool:
    return bool(np.isfinite([row[key] for row in rows]).any())


def completion_page(
    rows: Sequence[Mapping[str, Any]],
    figure: Figure,
    about: str,
    seed: int,
    command: str,
    device: str,
) -> Page:
    """The page: a table for each task, and the picture."""
    text = [
        f"{about} Figures are of the hidden rays, means over scans and answers, unless their name says otherwise: "
        "`MAE, all pixels` is LiDARGen's and RangeLDM's, IoU and Chamfer are of whole scans with the measured rays "
        "pasted in. The panel is the mean distance of its lines (`r2flow report fidelity`) between the completed "
        "scans and the true ones. Coverage is the share of hidden ranges between the least and the greatest answer."
    ]
    for task in dict.fromkeys(row["task"] for row in rows):
        own = [row for row in rows if row["task"] == task]
        columns = {key: heading for key, heading in SHOWN.items() if any(key in row for row in own)}
        text += [f"## {task}", table([{key: row.get(key) for key in columns} for row in own], columns)]
    return Page("completion", "Completed scans", text, rows, {"completion": figure}, command, {"noise": seed}, device)


def pictured(truth: np.ndarray, shown: Sequence[tuple[Mapping[str, Any], np.ndarray]], sensor: Sensor) -> Figure:
    """Of one scan and the first task: what is measured, each interpolation's and model's answer, the truth."""
    task = shown[0][0]["task"]
    chosen = [(row["method"], image) for row, image in shown if row["task"] == task]
    kept = [one for one in chosen if one[0] not in OPPONENTS or one[0] in ("nearest", "linear, 1/r")]
    panels = [(f"measured, {task}", truth * ~hidden_by(task, sensor.shape, 0)), *kept, ("truth", truth)]
    figure = dark_figure(15, 2.3 * len(panels))
    grid = figure.add_gridspec(
        len(panels), 2, width_ratios=[2.2, 1.3], hspace=0.14, wspace=0.03, left=0.01, right=0.99, top=0.985, bottom=0.01
    )
    for number, (name, image) in enumerate(panels):
        axes = figure.add_subplot(grid[number, 0])
        draw_range(axes, image, label=number == 0)
        box = {"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 2}
        axes.text(0.004, 0.94, name, transform=axes.transAxes, va="top", fontsize=9, color="white", bbox=box)
        draw_perspective(figure.add_subplot(grid[number, 1]), image_to_points(image, sensor.rays())[0])
    return figure
