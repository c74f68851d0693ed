"""Flows that complete scans: learned with a part of each scan known."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.data.loader import Further
from r2flow.errors import InputError
from r2flow.generators import Condition, ConditionalFlow, Generator, Regression, condition_of
from r2flow.generators.base import DOUBTFUL, IMAGE, KNOWN
from r2flow.lidar.faults import FAULTS
from r2flow.lidar.known import Ray, every_row, random_points, random_rows, ray_states, without_sector
from r2flow.lidar.space import ModelSpace
from r2flow.registry import Portion, check_options
from r2flow.stages.base import Batch, Stage
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Rectify


@dataclass(frozen=True)
class Tasks:
    """What is known of each training scan, drawn for each image of a run.

    Half of the scans of which something is known have one mask, half the rays that two masks leave. Masks: rows of a
    sparser sensor (every 2nd to 8th), a random share of the rows, a random share of the rays (2 to 90 %), all but a
    sector (5 to 180 degrees).

    Args:
        nothing: Share of the scans of which nothing is known, by which the model also draws scans from noise alone.
        faulty: Share of the rest that is measured everywhere and not trusted (`r2flow.lidar.faults`).
        silent: Share of the scans whose reflectance is not known.
    """

    nothing: Portion = 0.3
    faulty: Portion = 0.15
    silent: Portion = 0.1

    def __call__(self, space: ModelSpace, x_1: Tensor, draws: np.random.Generator) -> Batch:
        """What is known of one scan of model space: `condition_of` without its first dimension."""
        which, silent = draws.random(2)
        images = space.decode(x_1[None].float())
        if silent < self.silent:
            images = images[:, :1]
        if which < self.nothing:
            state = torch.zeros_like(images[:, 0], dtype=torch.uint8)
        elif which < self.nothing + (1 - self.nothing) * self.faulty:
            images, state = self._faulty(space, images, draws)
        else:
            measured = _measured(space.sensor.shape, draws)
            state = ray_states(images, torch.from_numpy(measured))
        return {name: value[0] for name, value in condition_of(space, images, state).items()}

    def _faulty(self, space: ModelSpace, images: Tensor, draws: np.random.Generator) -> tuple[Tensor, Tensor]:
        image = images[0].cpu().numpy()
        names = list(FAULTS)
        pair = {names[int(draws.integers(len(names)))]: None for _ in range(2)}  # in the order drawn
        alone = draws.random() < 0.5 or "clean" in pair  # a scan without any loss has no other fault
        for name in list(pair)[: 1 if alone else 2]:
            image = FAULTS[name](image, space.sensor, draws.random(), draws)
        changed = torch.from_numpy(np.ascontiguousarray(image))[None]
        return changed, torch.full_like(changed[:, 0], int(Ray.DOUBTFUL), dtype=torch.uint8)


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
        self.further = _further(generator, tasks)

    def condition(self, batch: Batch) -> Condition:
        return _said(batch)


class LearnConditionalMap(LearnFlowMap):
    """Flow map of scans of which a part is known: u(x_t, t, s | y), on scans, from the paths of a conditional flow.

    Args:
        objective: `solved`; others learn from pairs.
        tasks: Options of `Tasks`.
        options: Those of `LearnFlowMap`.
    """

    generator_name = "conditional_map"

    def __init__(
        self,
        generator: Generator,
        objective: str = "solved",
        tasks: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        if objective != "solved":
            raise InputError(f"this stage learns on scans: give stage.objective=solved, found {objective}.")
        super().__init__(generator, objective, **options)
        self.further = _further(generator, tasks)

    def check_data(self, name: str, data: Mapping[str, Any]) -> None:
        Stage.check_data(self, name, data)
        super().check_data(name, data)
        parent = (self.config.get("parent") or {}).get("stage", "conditional")
        if parent not in ("conditional", name):
            raise InputError(
                f"stage={name} follows a flow that was told a part of each scan: give stage.init=RUN of "
                f"stage=conditional; this one is of stage={parent}."
            )

    def condition(self, batch: Batch) -> Condition:
        return _said(batch)


def _further(generator: Generator, tasks: Mapping[str, Any] | None) -> Further:
    if not isinstance(generator, ConditionalFlow):
        raise InputError(f"this stage learns from what is known, which a {type(generator).__name__} is not told.")
    check_options("stage.tasks", Tasks, tasks or {})
    return partial(Tasks(**(tasks or {})), generator.space)


def _said(batch: Batch) -> Condition:
    return {name: batch[name] for name in (IMAGE, KNOWN, DOUBTFUL)}


class Regress(Conditional):
    """What is not known by one evaluation, with nothing drawn: of the absolute error, the median of each value."""

    generator_name = "regression"

    def __init__(
        self,
        generator: Generator,
        loss: str = "absolute",
        tasks: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        if options.pop("time", None) is not None:
            raise InputError("a regression has no times between noise and scan; leave stage.time out, or null.")
        super().__init__(generator, loss, tasks=tasks, **options)

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        assert isinstance(self.generator, Regression)
        return self.loss(self.generator.estimate(self.condition(batch), batch["x_1"]), batch["x_1"]).mean()
