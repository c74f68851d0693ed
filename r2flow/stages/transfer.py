"""Training of transfer flows on partially hidden scans."""

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Unpack

import numpy as np
import torch
from torch import Tensor

from r2flow.base.registry import Count, Natural, NonNegative, Options, Portion, construct
from r2flow.data.loader import ItemFormat
from r2flow.generators import Generator, TransferFlow
from r2flow.generators.base import IMAGE, KNOWN
from r2flow.generators.surroundings import gain_of, scaled, steps_of
from r2flow.generators.transfer import WEIGHTS
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.known import Ray, every_row, random_points, random_rows
from r2flow.lidar.sensors import Sensor
from r2flow.model.completion import complete
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    Betas,
    ModelArguments,
    SensorLike,
    SingleLoss,
)


@dataclass(frozen=True)
class Tasks:
    """Draws a crop and a mask of known rays for each image of a run.

    Masks: the rows of a sparser sensor (every 2nd to 8th, mostly every 4th or 2nd), a random share
    of the rows, or a random share of the rays (3 to 80 %).
    """

    rows: Count = 32  # of a crop, at most those of the run's sensor
    columns: Count = 256  # likewise
    # share of crops at half the rows and a quarter of the columns, for coarser images
    halved: Portion = 0.3
    silent: Portion = 0.05  # share of crops with unknown reflectance
    # share of crops without the vectors learned per row, for other sensors
    unnumbered: Portion = 0.1
    # of a model with labels: share of crops where only the labels are hidden, and where only they
    # are known; of others, half know the labels of known rays
    labelling: Portion = 0.5
    drawing: Portion = 0.15

    def size(self, space: ModelSpace) -> tuple[int, int]:
        """Rows and columns of a crop, for the space of the run's sensor."""
        return min(self.rows, space.shape[1]), min(self.columns, space.shape[2])

    def __call__(
        self, own: ModelSpace, x_1: Tensor, sensor: Sensor, draws: np.random.Generator
    ) -> Batch:
        """`x_1`, `image` and `known` of a crop in model space, (C, h, w); `elevations` (h,),
        `steps` (2,).

        `own`, the generator's space, determines the size of the crops; x_1 is a scan of `sensor`.
        """
        space = own if sensor == own.sensor else own.through(sensor)
        # as in use: intensities of sensors differ
        if sensor.name != own.sensor.name and space.encoding.reflectance:
            x_1 = scaled(x_1[None], gain_of(space, x_1[None], torch.ones_like(x_1[None])))[0]
        halve, silent, unnumbered, top, left = draws.random(5)
        elevations = space.rays[0, :, 0]
        large = x_1.shape[1] >= 2 * self.rows and x_1.shape[2] >= 4 * self.columns
        if halve < self.halved and large and x_1.shape[1] % 2 == x_1.shape[2] % 4 == 0:
            x_1 = coarser(space, x_1)
            elevations = elevations.unflatten(0, (-1, 2)).mean(1)
        rows, columns = self.size(own)
        first = int(top * (x_1.shape[1] - rows + 1))
        turned = (torch.arange(columns) + int(left * x_1.shape[2])) % x_1.shape[2]
        part = x_1[:, first : first + rows].index_select(2, turned)
        elevations = elevations[first : first + rows].clone()
        steps = steps_of(elevations[None], 2 * math.pi / x_1.shape[2])[0]
        known = torch.from_numpy(_measured((rows, columns), draws)).expand_as(part).float()
        known = known.clone()
        if space.encoding.labels:
            self._hide(known, part, space, draws)
        if silent < self.silent and space.encoding.reflectance:
            known[1] = 0
        return {
            "x_1": part, IMAGE: part * known, KNOWN: known, "elevations": elevations,
            "steps": steps, "numbered": torch.tensor(bool(unnumbered >= self.unnumbered)),
        }  # fmt: skip

    def _hide(
        self, known: Tensor, part: Tensor, space: ModelSpace, draws: np.random.Generator
    ) -> None:
        """Hide or give whole channels of a crop, (C, h, w), in place."""
        kind = draws.random()
        planes = space.encoding.slices["label"]
        labels = (part[planes] > 0).any(0)
        if kind < self.labelling:
            known[:] = 1
            known[planes] = 0
        elif kind < self.labelling + self.drawing:
            known[:] = 0
            known[planes] = labels
        elif draws.random() < 0.5:
            known[planes] *= labels
        else:
            known[planes] = 0


def coarser(space: ModelSpace, x: Tensor) -> Tensor:
    """Downsample a scan in model space, (C, H, W), by 2 rows and 4 columns, keeping the nearest
    return of a block.
    """
    blocks = (
        space.decode(x[None])[0]
        .unflatten(1, (-1, 2))
        .unflatten(3, (-1, 4))
        .movedim(2, 3)
        .flatten(3)
    )
    r = torch.where(blocks[:1] > 0, blocks[:1], torch.inf)
    return space.encoding.encode(
        blocks.gather(3, r.argmin(3, keepdim=True).expand(len(blocks), -1, -1, 1))[..., 0]
    )


def _measured(shape: tuple[int, int], draws: np.random.Generator) -> np.ndarray:
    kind, a, b = draws.random(3)
    if kind < 0.6:
        step = (2 if a < 0.25 else 4) if kind < 0.35 else 2 + int(a * 7)
        mask = every_row(step, int(b * step))
    elif kind < 0.7:
        mask = random_rows(0.15 + 0.6 * a)
    else:
        mask = random_points(0.03 * 27**a)
    return mask(np.ones(shape, dtype=bool), draws)


class Transfer(SingleLoss):
    """Train a `TransferFlow` on the negative log-likelihood of hidden rays.

    Half of the images are trained at t = 0, for sampling in one evaluation, the others at uniform
    t.

    Args:
        tasks: Options of `Tasks`.
    """

    learns: ClassVar[type[Generator]] = TransferFlow
    several_sensors = True
    generator_name = "transfer_flow"
    generator: TransferFlow

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        tasks: Options | None = None,
        learning_rate: NonNegative = 2e-3,
        betas: Betas = (0.9, 0.99),
        weight_decay: NonNegative = 0.0,
        muon: NonNegative | None = None,
        warmup_images: Natural = 800,
        **options: Unpack[ModelArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            learning_rate=learning_rate,
            betas=betas,
            weight_decay=weight_decay,
            muon=muon,
            warmup_images=warmup_images,
            **options,
        )
        self.tasks = construct("stage.tasks", Tasks, tasks)

    @property
    def item_format(self) -> ItemFormat:
        smallest = self.tasks.size(self.generator.space)
        return super().item_format._replace(
            further=partial(self.tasks, self.generator.space), smallest=smallest
        )

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> Tensor:
        """Scans completed from every fourth row: range in metres and reflectance, (B, 2 or 1, H,
        W).
        """
        images = self.space.decode(batch["x_1"]).cpu()
        state = torch.where(images[:, 0] > 0, int(Ray.RETURN), int(Ray.EMPTY))
        state[:, torch.arange(images.shape[2]) % 4 != 0] = int(Ray.UNKNOWN)
        images = images * (state != Ray.UNKNOWN)[:, None]
        answers = complete(self.generator, images, state, seed=self.seed)
        return torch.cat([answer.images for answer in answers])

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        x_1 = batch["x_1"]
        noise = batch["x_0"][:, :, : x_1.shape[2], : x_1.shape[3]]
        rows = self.generator.rows(batch["elevations"], batch["steps"], batch["numbered"])
        parts = self.generator.loss(
            x_1, {IMAGE: batch[IMAGE], KNOWN: batch[KNOWN]}, (2 * u - 1).clamp(min=0), noise,
            batch["steps"], rows,
        )  # fmt: skip
        split = "train" if self.training else "val"
        for name, value in parts.items():
            self.log_mean(f"{split}/{name}", value, batch)
        return torch.stack([WEIGHTS[name] * value for name, value in parts.items()]).sum()
