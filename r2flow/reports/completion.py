"""Scans of which a part is hidden, completed by models and by interpolation: how near to the truth, at what cost."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow import noise
from r2flow.errors import InputError
from r2flow.generators import Regression, Sampler
from r2flow.generators.base import Progress
from r2flow.lidar.faults import FAULTS
from r2flow.lidar.interpolation import OPPONENTS
from r2flow.lidar.known import Ray, parse_mask, ray_states
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.completion import UNITS, errors, spread_errors
from r2flow.metrics.fidelity import PANEL, distances, panel
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import complete, completing
from r2flow.reports.pages import Page
from r2flow.reports.pictures import completed_figure
from r2flow.reports.tables import table

AS_IT_IS = "as it is"
TASKS = ("rows:4", "rows:2", "random:0.5", "points:0.1", "sector:-11.25,11.25")
SHOWN = {
    "method": "method", "evaluations": "evaluations", "seconds": "seconds", **UNITS, "panel": "panel",
    "mae_of_median_m": "MAE of the median (m)", "crps_m": "CRPS (m)", "coverage": "coverage", "nominal": "of nominal",
}  # fmt: skip


@dataclass(frozen=True)
class Way:
    """A model and how it is run.

    Attributes:
        model: Its name in tables.
        checkpoint: The model.
        changes: Settings of its sampler that are not the usual ones.
    """

    model: str
    checkpoint: Checkpoint
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sampler(self) -> Sampler:
        """How it is run."""
        return completing(self.checkpoint.generator, **self.changes)

    @property
    def name(self) -> str:
        how = self.sampler
        return f"{self.model}, {how.method} {how.steps}"


def ways_of(checkpoint: Checkpoint, name: str, solvers: Sequence[str] = (), steps: Sequence[int] = ()) -> list[Way]:
    """A model by its usual way of completing, or by each of the solvers and numbers of steps that are named.

    Args:
        solvers: Each with a number of steps of its own behind a slash, or without: `flowdps/32`.

    Raises:
        InputError: a model that cannot complete, or not so.
    """
    ways = []
    for solver in solvers or (None,):
        method, _, own = (solver or "").partition("/")
        if own and not own.isdecimal():
            raise InputError(f"a solver's steps are a whole number behind a slash, as flowdps/32; found {solver!r}.")
        for count in (int(own),) if own else steps or (None,):
            named = {"method": method or None, "steps": count}
            ways.append(Way(name, checkpoint, {key: value for key, value in named.items() if value is not None}))
            _ = ways[-1].sampler  # one that cannot be is refused now
    return ways


class Given(NamedTuple):
    """What a task gives of a scan.

    Attributes:
        image: Range in metres and reflectance, (2 or 1, H, W).
        state: `r2flow.lidar.known.Ray` of each ray, (H, W).
        asked: The rays that are to be found, (H, W) bool: hidden ones, or all that are not trusted.
    """

    image: np.ndarray
    state: Tensor
    asked: np.ndarray


def given_by(task: str, truth: np.ndarray, sensor: Sensor, number: int) -> Given:
    """What a task gives of scan `number`, a function of both alone: rays that a mask leaves, or a faulty measurement.

    Raises:
        InputError: no such task, or one that hides nothing or all.
    """
    draws = noise.generator(0, "condition", number)
    if task in FAULTS:
        image = np.ascontiguousarray(FAULTS[task](truth, sensor, 0.5, draws))
        return Given(image, torch.full(image.shape[1:], int(Ray.DOUBTFUL), dtype=torch.uint8), image[0] >= 0)
    measured = parse_mask(task)(sensor.shape, draws)
    if measured.all() or not measured.any():
        what = "no" if measured.all() else "every"
        raise InputError(
            f"the task {task!r} hides {what} ray; give one that leaves some, or one of {', '.join(FAULTS)}."
        )
    state = ray_states(torch.from_numpy(truth)[None], torch.from_numpy(measured))[0]
    return Given(truth * measured, state, ~measured)


def opponents(given: Given, faulty: bool) -> Iterator[tuple[str, np.ndarray]]:
    """What needs no model: interpolations; of a faulty measurement, itself."""
    if faulty:
        yield AS_IT_IS, given.image
        return
    for name, fill in OPPONENTS.items():
        yield name, fill(given.image, ~given.asked)


def completion_rows(
    truths: Sequence[np.ndarray],
    sensor: Sensor,
    ways: Sequence[Way],
    tasks: Sequence[str] = TASKS,
    answers: int = 8,
    seed: int = 0,
    batch_size: int = 4,
    on_surfaces: bool | None = None,
    progress: Progress = None,
) -> Iterator[tuple[dict[str, Any], list[np.ndarray]]]:
    """A row for each task and method, means over scans and answers, and the first answer to each scan.

    Args:
        truths: Range images, (2 or 1, H, W).
        answers: To each scan; interpolations have one.
        batch_size: Answers at once.
        on_surfaces: As in `r2flow.model.completion.complete`.
    """
    whole = panel(np.stack(truths), sensor)
    for task in tasks:
        given = [given_by(task, x, sensor, i) for i, x in enumerate(truths)]
        asked = [one.asked for one in given]
        plain: dict[str, list[np.ndarray]] = {}
        for one in given:
            for name, image in opponents(one, task in FAULTS):
                plain.setdefault(name, []).append(image[None])
        for name, found in plain.items():
            row = _row(task, name, truths, found, asked, sensor, whole)
            yield {**row, "evaluations": 0, "seconds": float("nan")}, [images[0] for images in found]
        for way in ways:
            found, seconds, evaluations = _answers(way, given, answers, seed, batch_size, on_surfaces, progress)
            row = _row(task, way.name, truths, found, asked, sensor, whole)
            yield {**row, "evaluations": evaluations, "seconds": seconds}, [images[0] for images in found]


def _answers(
    way: Way,
    given: Sequence[Given],
    answers: int,
    seed: int,
    batch_size: int,
    on_surfaces: bool | None,
    progress: Progress,
) -> tuple[list[np.ndarray], float, float]:
    images = torch.from_numpy(np.stack([one.image for one in given]))
    state = torch.stack([one.state for one in given])
    alike = isinstance(way.checkpoint.generator, Regression)
    faulty = bool((state == Ray.DOUBTFUL).any())
    options: dict[str, Any] = {
        "sampler": way.sampler, "batch_size": batch_size, "on_surfaces": on_surfaces, "progress": progress,
    }  # fmt: skip
    keep = "mend" if faulty else "exact"
    made = list(complete(way.checkpoint, images, state, 1 if alike else answers, seed, keep=keep, **options))
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
    kept = [one for one in chosen if one[0] not in (*OPPONENTS, AS_IT_IS) or one[0] in ("nearest", "linear, 1/r")]
    given = given_by(task, truth, sensor, 0)
    rows = [(f"measured, {task}", given.image), *kept, ("truth", truth)]
    return completed_figure(rows, (given.state == Ray.UNKNOWN).numpy(), sensor.rays())
