"""Candidates and features for every ray, from the nearest measured returns."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from r2flow.generators.base import IMAGE, KNOWN, Condition
from r2flow.lidar.encoding import ModelSpace

NEIGHBOURS = 4
FEATURES = 5 * NEIGHBOURS + 11  # of `Surroundings`
ROW, STEEP = 8, 3.0  # size of the vector learned for each row, and gain of the elevation that follows it
SAME = 2e-4  # radians: tolerance for rows of the same elevation
LEARNED = math.radians(-32), math.radians(24)  # elevations of the training's simulated sensors, at any size


class Surroundings(NamedTuple):
    """Six candidates for every ray, and features of them.

    These are the nearest returns above, below, left and right, then the vertical and the horizontal interpolation
    between them, linear in 1 / r. The best is the vertical interpolation, else the horizontal one, else a neighbour,
    else 10 m.
    """

    features: Tensor  # (B, `FEATURES`, H, W); all but one are invariant to scaling all ranges
    ranges: Tensor  # log r of the candidates, (B, 6, H, W)
    strengths: Tensor  # reflectance of the candidates, (B, 6, H, W); zeros for a model of range alone
    there: Tensor  # which candidates exist, (B, 6, H, W) bool
    guess: Tensor  # log r of the best candidate, (B, 1, H, W)
    start: Tensor  # measured rays, and the best candidate for the others, in model space, (B, C, H, W)
    sure: Tensor  # 1 for a measured return, -1 for a ray measured as empty, 0 for a hidden ray, (B, 1, H, W)

    @classmethod
    def of(cls, space: ModelSpace, condition: Condition, ring: bool, steps: Tensor) -> "Surroundings":
        """Candidates and features from a condition (`condition_of`).

        `ring`: the columns are a full turn; `steps`: angles between rows and between columns in radians, (B, 2).
        """
        image, known = condition[IMAGE].float(), condition[KNOWN].float()
        measured = known[:, :1]
        metres = space.decode(image) * measured
        r = metres[:, :1]
        strength = metres[:, 1:2] * known[:, -1:] if space.encoding.reflectance else torch.zeros_like(r)
        returned = r > 0
        log_r = torch.where(returned, r, 1.0).log()
        offsets = nearest_returns(returned[:, 0], steps, ring).transpose(0, 2)  # (B, 2, 4, H, W)
        present = offsets[:, 0].isfinite()
        down, across = (torch.where(present, offset, 0) for offset in offsets.unbind(1))
        near, reflectance_near = (_moved(value, down, across) * present for value in (log_r, strength))
        axes = (0, down.abs()[:, :2]), (2, across.abs()[:, 2:])
        between = [_between(near[:, i : i + 2], reflectance_near[:, i : i + 2], distance) for i, distance in axes]
        ranges = torch.cat([near, *(log_range for log_range, _ in between)], 1)
        strengths = torch.cat([reflectance_near, *(reflectance for _, reflectance in between)], 1)
        present = torch.cat([present, present.unflatten(1, (2, 2)).all(2)], 1)
        order = torch.tensor([4, 5, 0, 1, 2, 3], device=r.device)
        best = order[present[:, order].int().argmax(1, keepdim=True)]
        any_present = present.any(1, keepdim=True)
        guess = torch.where(any_present, ranges.gather(1, best), math.log(10))
        guess_metres = guess.exp().clamp(space.sensor.min_range, space.sensor.max_range)
        start = encoded(space, guess_metres, strengths.gather(1, best) * any_present)
        relative = (ranges - guess) * present
        features = torch.cat(
            [
                present[:, :4], relative[:, :4].clamp(-3, 3), strengths[:, :4], down.asinh() / 2, across.asinh() / 2,
                present[:, 4:], relative[:, 4:].clamp(-3, 3), measured, returned, known[:, -1:],
                ((log_r - guess) * returned).clamp(-3, 3), strength, ~any_present, guess / 3 - 1,
            ], 1
        )  # fmt: skip
        sure = measured * torch.where(returned, 1, -1)
        return cls(features, ranges, strengths, present, guess, torch.where(measured > 0, image, start), sure)


class RowFeatures(nn.Embedding):
    """Features of each row: a learned vector, the elevation, and the angles between rows and between columns.

    Rows beyond the elevations of training have the nearest of these: the network would extrapolate ray-drop. There
    is one learned vector per row of the training sensor (`elevations` in radians, (H,)) and per pair of rows; other
    sensors share one vector.
    """

    FEATURES = ROW + 3

    def __init__(self, elevations: Tensor) -> None:
        pairs = elevations.unflatten(0, (-1, 2)).mean(1) if len(elevations) % 2 == 0 else elevations[:0]
        rows = torch.cat([elevations, pairs])
        super().__init__(1 + len(rows), ROW)
        self.elevations = rows  # not a buffer: derived from the sensor
        self.limits = min(LEARNED[0], float(rows.min())), max(LEARNED[1], float(rows.max()))

    def forward(self, elevations: Tensor, steps: Tensor, numbered: Tensor) -> Tensor:  # type: ignore[override]
        """Row features, (B, `FEATURES`, H, 1), from elevations in radians, (B, H), and `steps` of `Surroundings.of`.

        `numbered`, (B,) bool, tells which scans use the vectors learned per row, if all of their rows have one.
        """
        distance = (elevations[..., None] - self.elevations.to(elevations)).abs()
        numbered = numbered & (distance.amin(-1) < SAME).all(1)
        number = (distance.argmin(-1) + 1) * numbered[:, None]
        sizes = (steps / 0.007).log()[:, None].expand(*elevations.shape, 2)
        each = torch.cat([super().forward(number), STEEP * elevations[..., None].clamp(*self.limits), sizes], -1)
        return each.movedim(-1, 1)[..., None]


def steps_of(elevations: Tensor, column: float) -> Tensor:
    """Mean angle between rows of elevations (B, H), and angle between columns, (B, 2)."""
    row = (elevations[:, 0] - elevations[:, -1]).abs() / max(elevations.shape[1] - 1, 1)
    return torch.stack([row.clamp(min=1e-4), torch.full_like(row, column)], 1)


def encoded(space: ModelSpace, r: Tensor, strength: Tensor) -> Tensor:
    """Encode range in metres and reflectance, (B, 1, H, W) each, into model space, (B, C, H, W)."""
    return space.encoding.encode(torch.cat([r, strength.clamp(0, 1)], 1) if space.encoding.reflectance else r)


def _moved(values: Tensor, down: Tensor, across: Tensor) -> Tensor:
    """Values of an image (B, 1, H, W) at an offset in rows and columns from each pixel, (B, N, H, W)."""
    rows, columns = values.shape[2:]
    row = torch.arange(rows, device=values.device)[:, None] + down.long()
    column = (torch.arange(columns, device=values.device) + across.long()) % columns
    return values.flatten(1).gather(1, (row * columns + column).flatten(1)).view_as(down)


def _between(log_r: Tensor, strength: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate log r and reflectance of two returns, (B, 2, H, W) each, linearly in 1 / r, (B, 1, H, W)."""
    share = (distance / distance.sum(1, keepdim=True).clamp(min=1)).flip(1)  # the nearer return has the larger weight
    return -((-log_r).exp() * share).sum(1, keepdim=True).clamp(min=1e-6).log(), (strength * share).sum(1, keepdim=True)


def nearest_returns(returned: Tensor, steps: Tensor, ring: bool) -> Tensor:
    """Rows and columns from each ray to the nearest returns above, below, left and right, (4, 2, B, H, W) float32.

    `Above` is the quadrant of previous rows whose distance in columns is at most the distance in rows; the others are
    alike. Of the returns, (B, H, W) bool, the nearest has the smallest angle, by the angles between two rows and
    between two columns, (B, 2). Offsets are infinite without a return. `ring`: the columns are a full turn.
    """
    twice = steps.repeat(2, 1).mT[..., None]  # (2, 2 B, 1)
    upright = torch.stack([returned, returned.flip(1)]).flatten(0, 1)
    above, below = _before(upright, twice, ring).unflatten(1, (2, -1)).unbind(1)
    level = torch.stack([returned, returned.flip(2)]).flatten(0, 1).mT
    turn = level.shape[1]
    if ring:  # two turns: the last columns precede the first
        level = torch.cat([level, level], dim=1)
    left, right = _before(level, twice.flip(0), False)[:, :, -turn:].mT.flip(0).unflatten(1, (2, -1)).unbind(1)
    upward = steps.new_tensor([-1, 1])[:, None, None, None]  # the opposite direction of rows
    return torch.stack([above, below.flip(2) * upward, left, right.flip(3) * -upward])


def _before(returned: Tensor, steps: Tensor, ring: bool) -> Tensor:
    """Offsets to the nearest return in the quadrant of previous rows, (2, B, H, W), row by row."""
    batch, rows, columns = returned.shape
    missing = torch.full((2, batch, columns), math.inf, device=returned.device)
    move = torch.tensor([[-1.0, -1.0], [-1.0, 0.0], [-1.0, 1.0]], device=returned.device)[..., None, None]
    offsets, state = [missing], torch.where(returned[:, 0], 0.0, missing)
    for row in range(1, rows):
        wide = torch.cat(
            [state[..., -1:], state, state[..., :1]] if ring else [missing[..., :1], state, missing[..., :1]], -1
        )
        candidates = wide.unfold(-1, columns, 1).permute(2, 0, 1, 3) + move
        best = (candidates * steps).square().sum(1).argmin(0)
        nearest = candidates.gather(0, best.expand(1, 2, *best.shape))[0]
        offsets.append(nearest)
        state = torch.where(returned[:, row], 0.0, nearest)
    return torch.stack(offsets, dim=2)
