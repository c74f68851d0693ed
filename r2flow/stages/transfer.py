"""Training of transfer flows on partially hidden scans."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.generators import Generator, TransferFlow
from r2flow.generators.base import IMAGE, KNOWN
from r2flow.generators.surroundings import steps_of
from r2flow.generators.transfer import WEIGHTS
from r2flow.lidar.known import every_row, random_points, random_rows
from r2flow.lidar.space import ModelSpace
from r2flow.registry import Count, Portion, check_options
from r2flow.stages.base import Batch, SingleLoss


@dataclass(frozen=True)
class Tasks:
    """Draws a crop and a mask of known rays for each image of a run.

    Masks: the rows of a sparser sensor (every 2nd to 8th, mostly every 4th or 2nd), a random share of the rows, or a
    random share of the rays (3 to 80 %).

    Args:
        rows: Rows of a crop.
        columns: Columns of a crop.
        halved: Share of crops at half the rows and a quarter of the columns, to train for coarser images.
        silent: Share of crops with unknown reflectance.
        unnumbered: Share of crops without the vectors learned per row, to train for other sensors.
    """

    rows: Count = 32
    columns: Count = 256
    halved: Portion = 0.3
    silent: Portion = 0.05
    unnumbered: Portion = 0.1

    def __call__(self, space: ModelSpace, x_1: Tensor, draws: np.random.Generator) -> Batch:
        """`target`, `image` and `known` of a crop in model space, (C, h, w); `elevations` (h,), `steps` (2,)."""
        halve, silent, unnumbered, top, left = draws.random(5)
        elevations = space.rays[0, :, 0]
        if halve < self.halved and x_1.shape[1] >= 2 * self.rows and x_1.shape[2] >= 4 * self.columns:
            x_1, elevations = coarser(space, x_1), elevations.unflatten(0, (-1, 2)).mean(1)
        rows, columns = min(self.rows, x_1.shape[1]), min(self.columns, x_1.shape[2])
        first = int(top * (x_1.shape[1] - rows + 1))
        chosen = (torch.arange(columns) + int(left * x_1.shape[2])) % x_1.shape[2]
        part = x_1[:, first : first + rows].index_select(2, chosen)
        elevations = elevations[first : first + rows].clone()
        steps = steps_of(elevations[None], 2 * math.pi / x_1.shape[2])[0]
        known = torch.from_numpy(_measured((rows, columns), draws)).expand_as(part).float()
        if silent < self.silent and space.encoding.reflectance:
            known = known.clone()
            known[-1] = 0
        return {
            "target": part, IMAGE: part * known, KNOWN: known, "elevations": elevations,
            "steps": steps, "numbered": torch.tensor(unnumbered >= self.unnumbered),
        }  # fmt: skip


def coarser(space: ModelSpace, x: Tensor) -> Tensor:
    """Downsample a scan in model space, (C, H, W), by 2 rows and 4 columns, keeping the nearest return of a block."""
    image = space.decode(x[None])[0]
    blocks = image.unflatten(1, (-1, 2)).unflatten(3, (-1, 4)).movedim(2, 3).flatten(3)
    r = torch.where(blocks[:1] > 0, blocks[:1], torch.inf)
    return space.encoding.encode(blocks.gather(3, r.argmin(3, keepdim=True).expand(len(blocks), -1, -1, 1))[..., 0])


def _measured(shape: tuple[int, int], draws: np.random.Generator) -> np.ndarray:
    kind, a, b = draws.random(3)
    if kind < 0.6:
        step = (2 if a < 0.25 else 4) if kind < 0.35 else 2 + int(a * 7)
        mask = every_row(step, int(b * step))
    elif kind < 0.7:
        mask = random_rows(0.15 + 0.6 * a)
    else:
        mask = random_points(0.03 * 27**a)
    return mask(shape, draws)


class Transfer(SingleLoss):
    """Train a `TransferFlow` on the negative log-likelihood of hidden rays.

    Half of the images are trained at t = 0, for sampling in one evaluation, the others at uniform t.

    Args:
        tasks: Options of `Tasks`.
    """

    learns: ClassVar[type[Generator]] = TransferFlow
    generator_name = "transfer_flow"
    generator: TransferFlow

    def __init__(self, generator: Generator, tasks: Mapping[str, Any] | None = None, **options: Any) -> None:
        super().__init__(generator, **options)
        check_options("stage.tasks", Tasks, tasks or {})
        self.further = partial(Tasks(**(tasks or {})), generator.space)

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        target = batch["target"]
        noise = batch["x_0"][:, :, : target.shape[2], : target.shape[3]]
        rows = self.generator.rows(batch["elevations"], batch["steps"], batch["numbered"])
        parts = self.generator.loss(
            target, {IMAGE: batch[IMAGE], KNOWN: batch[KNOWN]}, (2 * u - 1).clamp(min=0), noise,
            batch["steps"], rows,
        )  # fmt: skip
        split = "train" if self.training else "val"
        for name, value in parts.items():
            self.log(f"{split}/{name}", value, batch_size=len(target), sync_dist=True)
        return torch.stack([WEIGHTS[name] * value for name, value in parts.items()]).sum()
