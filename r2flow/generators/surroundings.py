"""What the known rays of a scan say of every ray: candidates for its answer, and features of them for a network."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from r2flow.generators.base import IMAGE, KNOWN, Condition
from r2flow.lidar.neighbours import nearest_returns
from r2flow.lidar.space import ModelSpace

NEIGHBOURS = 4
FEATURES = 5 * NEIGHBOURS + 11  # of `Surroundings`
ROW = 8  # numbers learned of each row
SAME = 2e-4  # radians: rows of the same elevation


class Surroundings(NamedTuple):
    """What the known rays say of every ray.

    Attributes:
        features: (B, `FEATURES`, H, W), of which none changes when all ranges are scaled, but one.
        ranges: log r of the candidates, (B, 6, H, W): the nearest returns above, below, left and right, and the values
            between the first and the last two, linear in 1 / r.
        strengths: Their reflectance, (B, 6, H, W); zeros of a model of range alone.
        there: Which candidates there are, (B, 6, H, W) bool.
        guess: log r of the best candidate, (B, 1, H, W): a value between two, the upright one first, before a
            neighbour; 10 m where there is none.
        start: It and its reflectance in model space, and measured rays as they are, (B, C, H, W).
        sure: 1 of a measured return, -1 of a ray that was measured empty, 0 of a hidden one, (B, 1, H, W).
    """

    features: Tensor
    ranges: Tensor
    strengths: Tensor
    there: Tensor
    guess: Tensor
    start: Tensor
    sure: Tensor

    @classmethod
    def of(cls, space: ModelSpace, condition: Condition, ring: bool, steps: Tensor) -> "Surroundings":
        """The surroundings of every ray.

        Args:
            condition: `image` and `known` of `r2flow.generators.condition_of`; guesses in it are not read.
            ring: Whether the columns are a full turn.
            steps: Angle between rows and between columns in radians, (B, 2).
        """
        image, known = condition[IMAGE].float(), condition[KNOWN].float()
        measured = known[:, :1]
        metres = space.decode(image) * measured
        r = metres[:, :1]
        strength = metres[:, 1:2] * known[:, -1:] if space.encoding.reflectance else torch.zeros_like(r)
        returned = r > 0
        log_r = torch.where(returned, r, 1.0).log()
        offsets = nearest_returns(returned[:, 0], steps, ring).transpose(0, 2)  # (B, 2, 4, H, W)
        there = offsets[:, 0].isfinite()
        down, aside = (torch.where(there, offset, 0) for offset in offsets.unbind(1))
        near, of = (_moved(value, down, aside) * there for value in (log_r, strength))
        pairs = (0, down.abs()[:, :2]), (2, aside.abs()[:, 2:])
        between = [_between(near[:, i : i + 2], of[:, i : i + 2], apart) for i, apart in pairs]
        ranges = torch.cat([near, *(one for one, _ in between)], 1)
        strengths = torch.cat([of, *(one for _, one in between)], 1)
        there = torch.cat([there, there.unflatten(1, (2, 2)).all(2)], 1)
        order = torch.tensor([4, 5, 0, 1, 2, 3], device=r.device)
        best = order[there[:, order].int().argmax(1, keepdim=True)]
        some = there.any(1, keepdim=True)
        guess = torch.where(some, ranges.gather(1, best), math.log(10))
        metres_guessed = guess.exp().clamp(space.sensor.min_range, space.sensor.max_range)
        start = encoded(space, metres_guessed, strengths.gather(1, best) * some)
        relative = (ranges - guess) * there
        features = torch.cat(
            [
                there[:, :4], relative[:, :4].clamp(-3, 3), strengths[:, :4], down.asinh() / 2, aside.asinh() / 2,
                there[:, 4:], relative[:, 4:].clamp(-3, 3), measured, returned, known[:, -1:],
                ((log_r - guess) * returned).clamp(-3, 3), strength, ~some, guess / 3 - 1,
            ], 1
        )  # fmt: skip
        sure = measured * torch.where(returned, 1, -1)
        return cls(features, ranges, strengths, there, guess, torch.where(measured > 0, image, start), sure)


class RowFeatures(nn.Embedding):
    """What a network is given of each row: a learned vector, elevation, angles between rows and between columns.

    The vector is that of a row of the trained images, or of two together; rows of any other sensor have one for all.

    Args:
        elevations: Of the trained rows in radians, (H,).
    """

    FEATURES = ROW + 3

    def __init__(self, elevations: Tensor) -> None:
        pairs = elevations.unflatten(0, (-1, 2)).mean(1) if len(elevations) % 2 == 0 else elevations[:0]
        rows = torch.cat([elevations, pairs])
        super().__init__(1 + len(rows), ROW)
        self.elevations = rows  # no buffer: they follow from the sensor

    def forward(  # type: ignore[override]
        self, elevations: Tensor, steps: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """(B, `FEATURES`, H, 1).

        Args:
            elevations: Of the rows in radians, (B, H).
            steps: Angle between rows and between columns, (B, 2).
            known: Whether the learned vectors are given, (B,) bool; None for yes.
        """
        off = (elevations[..., None] - self.elevations.to(elevations)).abs()
        same = (off.amin(-1) < SAME).all(1)
        number = (off.argmin(-1) + 1) * (same if known is None else same & known)[:, None]
        sizes = (steps / 0.007).log()[:, None].expand(*elevations.shape, 2)
        each = torch.cat([super().forward(number), 3 * elevations[..., None], sizes], -1)
        return each.movedim(-1, 1)[..., None]


def steps_of(elevations: Tensor, column: float) -> Tensor:
    """Mean angle between rows, of elevations (B, H), and that between columns, (B, 2)."""
    row = (elevations[:, 0] - elevations[:, -1]).abs() / max(elevations.shape[1] - 1, 1)
    return torch.stack([row.clamp(min=1e-4), torch.full_like(row, column)], 1)


def encoded(space: ModelSpace, r: Tensor, strength: Tensor) -> Tensor:
    """Metres and reflectance, (B, 1, H, W) each, in model space, (B, C, H, W)."""
    return space.encoding.encode(torch.cat([r, strength.clamp(0, 1)], 1) if space.encoding.reflectance else r)


def _moved(values: Tensor, down: Tensor, aside: Tensor) -> Tensor:
    """Of an image (B, 1, H, W) the values so many rows and columns from each pixel, (B, N, H, W)."""
    rows, columns = values.shape[2:]
    row = torch.arange(rows, device=values.device)[:, None] + down.long()
    column = (torch.arange(columns, device=values.device) + aside.long()) % columns
    return values.flatten(1).gather(1, (row * columns + column).flatten(1)).view_as(down)


def _between(near: Tensor, of: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """log r and reflectance between two returns at distances, (B, 2, H, W) each: linear in 1 / r, (B, 1, H, W)."""
    share = (distance / distance.sum(1, keepdim=True).clamp(min=1)).flip(1)  # the nearer counts more
    return -((-near).exp() * share).sum(1, keepdim=True).clamp(min=1e-6).log(), (of * share).sum(1, keepdim=True)
