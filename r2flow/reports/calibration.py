"""Factors of predicted errors for the scans of one sensor, by split conformal prediction."""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray

from r2flow.base.errors import check
from r2flow.base.progress import Bar
from r2flow.generators import TransferFlow
from r2flow.generators.base import Progress
from r2flow.lidar.known import ray_states
from r2flow.lidar.sensors import named_sensor, write_sensor
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import complete
from r2flow.model.inversion import real_scans
from r2flow.model.paths import title_of
from r2flow.reports.completion import kept_rays
from r2flow.samplers import Jump

_LEVELS = (0.68, 0.95)
TASKS = ("rows:2", "rows:4", "points:0.1")
_MEDIAN = Jump(steps=1)
_FEWEST = 1000  # added points that a quantile of 95 % needs at least


class Trust(NamedTuple):
    """Factors for a sensor, and the shares of added points within both errors with those that its
    file had.
    """

    factors: tuple[float, float]
    shares: tuple[float, float]
    points: int


def calibrate(
    model: Checkpoint,
    real: str,
    sensor: str,
    out: Path,
    num: int = 16,
    reflectance_scale: float | None = None,
) -> Trust:
    """Write the sensor of scans, by name or YAML file, with the factors of `trust_of` on at most
    `num` of them, and with the comment of its file.
    """
    plain = named_sensor(sensor)
    flow = model.through(plain)
    _, images = real_scans(flow, [real], reflectance_scale, num, need_reflectance=False)
    with Bar("completing", len(images) * len(TASKS), "evaluations") as advance:
        trust = trust_of(flow, [*images.numpy()], advance)
    file = Path(sensor)
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    said = re.findall(r"^#\s?(?!\s?error_factors)(.*)", text, re.M)[:-1]
    said.append(f"error_factors: r2flow calibrate, {title_of(model.path)}, {len(images)} scans")
    write_sensor(replace(plain, error_factors=trust.factors), out, "\n".join(said))
    return trust


def trust_of(model: Checkpoint, truths: Sequence[ndarray], progress: Progress = None) -> Trust:
    """Hide parts of scans, (2 or 1, H, W) of the model's sensor, and compare with their errors.

    The score of an added point is its true error over the predicted one. The factor of a level q is
    the (n + 1) q-th smallest of n scores (Papadopoulos et al. 2002): of a new scan like these, a
    share q of added points lies within factor times error.

    Raises:
        InputError: A model without predicted errors, or too few points.
    """
    flow = model.generator
    check(isinstance(flow, TransferFlow), f"{model.path} predicts no errors: give densify.")
    plain = model.through(replace(model.sensor, error_factors=None))
    scores = np.concatenate([*_scores(plain, truths, progress)], axis=1)
    count = scores.shape[1]
    check(count >= _FEWEST, f"{count} added points are too few to compare: give more scans.")
    ranks = [min(math.ceil((count + 1) * level), count) - 1 for level in _LEVELS]
    first, second = (
        float(np.partition(one, rank)[rank]) for one, rank in zip(scores, ranks, strict=True)
    )
    had = np.array(model.sensor.error_factors or (1.0, 1.0))[:, None]
    within = (scores / had <= 1).mean(1).tolist()
    return Trust((first, second), (within[0], within[1]), count)


def _scores(model: Checkpoint, truths: Sequence[ndarray], progress: Progress) -> Iterator[ndarray]:
    """True over predicted errors of the added points of a scan and task, (levels, N)."""
    for number, truth in enumerate(truths):
        images = torch.from_numpy(truth)[None]
        for task in TASKS:
            kept = torch.from_numpy(kept_rays(task, model.sensor, number))
            state = ray_states(images, kept[None])
            (completed,) = complete(model, images * kept, state, sampler=_MEDIAN, progress=progress)
            r = completed.images[0, 0]
            right = (r > 0) & (images[0, 0] > 0) & ~kept
            error = (r - images[0, 0]).abs()
            yield (error / completed.error(*_LEVELS)[:, 0])[:, right].numpy()
