"""Flows that complete scans: learned with a part of each scan known."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.generators import Condition, ConditionalFlow, Generator, condition_of
from r2flow.generators.base import IMAGE, KNOWN
from r2flow.lidar.known import every_row, random_points, random_rows, ray_states, without_sector
from r2flow.lidar.space import ModelSpace
from r2flow.registry import Portion, check_options
from r2flow.stages.base import Batch
from r2flow.stages.rectify import Rectify


@dataclass(frozen=True)
class Tasks:
    """What is known of each training scan, drawn for each image of a run.

    Half of the scans of which something is known have one mask, half the rays that two masks leave. Masks: rows of a
    sparser sensor (every 2nd to 8th), a random share of the rows, a random share of the rays (2 to 90 %), all but a
    sector (5 to 180 degrees).

    Args:
        nothing: Share of the scans of which nothing is known, by which the model also draws scans from noise alone.
        silent: Share of the scans whose reflectance is not known.
    """

    nothing: Portion = 0.3
    silent: Portion = 0.1

    def __call__(self, space: ModelSpace, x_1: Tensor, draws: np.random.Generator) -> Batch:
        """What is known of one scan of model space: `condition_of` without its first dimension."""
        which, silent = draws.random(2)
        images = space.decode(x_1[None].float())
        if silent < self.silent:
            images = images[:, :1]
        if which < self.nothing:
            state = torch.zeros_like(images[:, 0], dtype=torch.uint8)
        else:
            state = ray_states(images, torch.from_numpy(_measured(space.sensor.shape, draws)))
        return {name: value[0] for name, value in condition_of(space, images, state).items()}


def _measured(shape: tuple[int, int], draws: np.random.Generator) -> np.ndarray:
    measured = np.ones(shape, dtype=bool)
    for _ in range(1 + int(draws.random() < 0.5)):
        kind, a, b = draws.random(3)
        if kind < 0.4:
            step = 2 + int(a * 7)
            mask = every_row(step, int(b * step))
        elif kind < 0.55:
            mask = random_rows(0.1 + 0.8 * a)
        elif kind < 0.8:
            mask = random_points(0.02 * 45**a)
        else:
            width = 5 * 36**a
            mask = without_sector(360 * b - 180, (360 * b + width + 180) % 360 - 180)
        measured &= mask(shape, draws)
    return measured


class Conditional(Rectify):
    """1-RF of scans of which a part is known: regress v(t, x_t | y) onto x_1 - x_0, for any mask (`Tasks`).

    Args:
        tasks: Options of `Tasks`.
    """

    learns = ConditionalFlow
    generator_name = "conditional_flow"

    def __init__(
        self,
        generator: Generator,
        loss: str = "mse",
        time: Mapping[str, Any] | None = None,
        tasks: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(generator, loss, time, **options)
        check_options("stage.tasks", Tasks, tasks or {})
        self.further = partial(Tasks(**(tasks or {})), generator.space)

    def condition(self, batch: Batch) -> Condition:
        return {name: batch[name] for name in (IMAGE, KNOWN)}
