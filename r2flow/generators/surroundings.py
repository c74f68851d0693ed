"""Candidates and features for every ray, from the nearest measured returns."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.generators.base import IMAGE, KNOWN, Condition
from r2flow.lidar.encoding import ModelSpace

FEATURES = 31  # of `Surroundings`
ROW = 8  # size of the vector learned for each row
STEEP = 3.0  # gain of the elevation that follows it
_FEW = 128  # rows that are searched one after the other
_SAME = 2e-4  # radians: tolerance for rows of the same elevation
# Mean reflectance of returns, of simulated scans, to which scans of other sensors are scaled.
_REFLECTANCE = 0.265
# Elevations of the training's simulated sensors, at any size.
_LOWEST = math.radians(-32)
_HIGHEST = math.radians(24)


class Surroundings(NamedTuple):
    """Six candidates for every ray, and features of them.

    These are the nearest returns above, below, left and right, then the vertical and the horizontal
    interpolation between them, linear in 1 / r. The best is the vertical interpolation, else the
    horizontal one, else a neighbour, else 10 m.
    """

    features: Tensor  # (B, `FEATURES`, H, W); all but one are invariant to scaling all ranges
    ranges: Tensor  # log r of the candidates, (B, 6, H, W)
    strengths: Tensor  # reflectance times gain, (B, 6, H, W); 0 for a model of range alone
    there: Tensor  # which candidates exist, (B, 6, H, W) bool
    guess: Tensor  # log r of the best candidate, (B, 1, H, W)
    start: Tensor  # measured rays, else the best candidate, in model space, (B, C, H, W)
    labelled: Tensor  # which rays have a known label, (B, 1, H, W); of no channel without labels
    sure: Tensor  # 1: a measured return, -1: measured as empty, 0: a hidden ray, (B, 1, H, W)

    @classmethod
    def of(
        cls,
        space: ModelSpace,
        condition: Condition,
        ring: bool,
        steps: Tensor,
        gain: Tensor | float = 1.0,
    ) -> "Surroundings":
        """Candidates and features from a condition (`condition_of`).

        Args:
            ring: Whether the columns are a full turn.
            steps: Angles between rows and between columns in radians, (B, 2).
            gain: Factor of reflectance; features above 1 are clipped, candidates are not.
        """
        image = condition[IMAGE].float()
        known = condition[KNOWN].float()
        measured = known[:, :1]
        metres = space.decode(image) * measured
        r = metres[:, :1]
        channels = space.encoding.slices
        loud = known[:, channels.get("reflectance", channels["range"])]
        strength = torch.zeros_like(r)
        if space.encoding.reflectance:
            strength = metres[:, 1:2] * loud * gain
        planes = channels.get("label", slice(0, 0))
        labelled = known[:, planes][:, :1]
        returned = r > 0
        log_r = torch.where(returned, r, 1.0).log()
        offsets = nearest_returns(returned[:, 0], steps, ring).transpose(0, 2)  # (B, 2, 4, H, W)
        near = offsets[:, 0].isfinite()
        down, across = torch.where(near[:, None], offsets, 0).unbind(1)
        ranges, strengths = _moved(torch.stack([log_r, strength]), down, across) * near
        candidates = [
            torch.stack([ranges, strengths]),
            _between(ranges[:, :2], strengths[:, :2], down.abs()[:, :2]),
            _between(ranges[:, 2:], strengths[:, 2:], across.abs()[:, 2:]),
        ]
        both = torch.cat(candidates, 2)
        present = torch.cat([near, near.unflatten(1, (2, 2)).all(2)], 1)
        any_present = near.any(1, keepdim=True)
        nothing = both.new_tensor([math.log(10), 0])[:, None, None, None, None]
        guess, mean = first_present(both, present, (4, 5, 0, 1, 2, 3), nothing)
        ranges, strengths = both
        metres = guess.exp().clamp(space.sensor.min_range, space.sensor.max_range)
        start = encoded(space, metres, mean / gain)
        relative = ((ranges - guess) * present).clamp(-3, 3)
        features = [
            near,
            relative[:, :4],
            strengths[:, :4].clamp(max=1),
            _shrunk(down),
            _shrunk(across),
            present[:, 4:],
            relative[:, 4:],
            measured,
            returned,
            loud,
            ((log_r - guess) * returned).clamp(-3, 3),
            strength.clamp(max=1),
            ~any_present,
            guess / 3 - 1,
        ]
        start = torch.where(measured > 0, image[:, : start.shape[1]], start)
        if space.encoding.labels:
            angle = torch.hypot(down * steps[:, :1, None, None], across * steps[:, 1:, None, None])
            share = near / angle.clamp(min=1e-6)
            labels = _interpolated(image[:, planes], labelled, share, down, across)
            start = torch.cat([start, labels], 1)
        sure = measured * torch.where(returned, 1, -1)
        together = torch.cat(features, 1)
        return cls(together, ranges, strengths, present, guess, start, labelled, sure)


class RowFeatures(nn.Embedding):
    """Features of each row: a learned vector, the elevation, and the angles between rows, columns.

    Rows beyond the elevations of training have the nearest of these: the network would extrapolate
    ray-drop. There is one learned vector per row of the training sensor (`elevations` in radians,
    (H,)) and per pair of rows; other sensors share one vector.
    """

    FEATURES = ROW + 3

    def __init__(self, elevations: Tensor) -> None:
        rows = elevations
        if len(rows) % 2 == 0:
            rows = torch.cat([rows, rows.unflatten(0, (-1, 2)).mean(1)])
        super().__init__(1 + len(rows), ROW)
        self.elevations = rows  # not a buffer: derived from the sensor
        self.limits = (min(_LOWEST, float(rows.min())), max(_HIGHEST, float(rows.max())))

    def forward(self, elevations: Tensor, steps: Tensor, numbered: Tensor) -> Tensor:  # type: ignore[override]
        """Row features, (B, `FEATURES`, H, 1), from elevations in radians, (B, H).

        Args:
            steps: See `Surroundings.of`.
            numbered: Which scans use the vectors learned per row, if all of their rows have one,
                (B,) bool.
        """
        nearest = (elevations[..., None] - self.elevations.to(elevations)).abs().min(-1)
        numbered = numbered & (nearest.values < _SAME).all(1)
        vectors = super().forward((nearest.indices + 1) * numbered[:, None])
        steep = STEEP * elevations[..., None].clamp(*self.limits)
        sizes = (steps / 0.007).log()[:, None].expand(*elevations.shape, 2)
        return torch.cat([vectors, steep, sizes], -1).movedim(-1, 1)[..., None]


def steps_of(elevations: Tensor, column: float) -> Tensor:
    """Mean angle between rows of elevations (B, H), and angle between columns, (B, 2)."""
    row = (elevations[:, 0] - elevations[:, -1]).abs() / max(elevations.shape[1] - 1, 1)
    return torch.stack([row.clamp(min=1e-4), torch.full_like(row, column)], 1)


def encoded(space: ModelSpace, r: Tensor, strength: Tensor) -> Tensor:
    """Range in metres and reflectance, (B, 1, H, W) each, in model space, (B, 2 or 1, H, W)."""
    if space.encoding.reflectance:
        r = torch.cat([r, strength.clamp(0, 1)], 1)
    return space.encoding.encode_returns(r)


def gain_of(space: ModelSpace, image: Tensor, known: Tensor) -> Tensor:
    """Factor to a scan's mean reflectance of `_REFLECTANCE`, (B, 1, 1, 1); 1 if none is known."""
    metres = space.decode(image)
    returned = (known[:, 1:2] > 0) & (metres[:, :1] > 0)
    total = (metres[:, 1:2] * returned).sum((1, 2, 3), keepdim=True)
    count = returned.sum((1, 2, 3), keepdim=True)
    return torch.where(total > 0, _REFLECTANCE * count / total, 1.0)


def scaled(image: Tensor, gain: Tensor) -> Tensor:
    """An image in model space, (B, C, H, W), with its reflectance multiplied, at most 1."""
    strength = ((image[:, 1:2] + 1) * gain).clamp(max=2) - 1
    return torch.cat([image[:, :1], strength, image[:, 2:]], 1)


def within_reach(known: Tensor) -> Tensor:
    """Rows, (B, 1, H, 1), between measured rows or within their largest gap beyond them.

    `known` is (B, 1, H, W).
    """
    measured = known[:, 0].any(2)
    rows = measured.shape[1]
    number = torch.arange(rows, device=known.device)
    first = torch.where(measured, number, 2 * rows).amin(1, True)
    last = torch.where(measured, number, -rows).amax(1, True)
    earlier = measured[:, None] & (number < number[:, None])
    before = torch.where(earlier, number, -1).amax(2)
    gap = torch.where(measured & (before >= 0), number - before, 0).amax(1, True)
    gap = torch.where(gap > 0, gap, rows)
    reach = (number > first - gap) & (number < last + gap)
    return reach[:, None, :, None]


def every_second(known: Tensor) -> Tensor:
    """The second, fourth, ... of the measured rows, (B, 1, H, 1), of (B, 1, H, W)."""
    measured = known.any(3, keepdim=True)
    return measured & (measured.cumsum(2) % 2 == 0)


def first_present(values: Tensor, present: Tensor, order: Sequence[int], default: Tensor) -> Tensor:
    """The first candidate in an order that is present, (..., B, 1, H, W), else `default`.

    Values are (..., B, N, H, W), `present` is (B, N, H, W).
    """
    for k in reversed(order):
        default = torch.where(present[:, k : k + 1], values[..., k : k + 1, :, :], default)
    return default


def _moved(values: Tensor, down: Tensor, across: Tensor) -> Tensor:
    """Values of images (C, B, 1, H, W) at offsets in rows and columns, (C, B, N, H, W)."""
    rows, columns = values.shape[3:]
    row = torch.arange(rows, device=values.device)[:, None] + down
    column = torch.arange(columns, device=values.device) + across
    column = column - columns * (column / columns).floor()  # `%` is ten times as slow
    pixel = (row * columns + column).long().flatten(1).expand(len(values), -1, -1)
    return values.flatten(2).gather(2, pixel).view(len(values), *down.shape)


def _shrunk(offset: Tensor) -> Tensor:
    """asinh(n) / 2 of whole numbers, from a table: asinh is slow on a CPU."""
    most = sum(offset.shape[2:])  # a turn, and as many columns as there are rows
    table = torch.arange(-most, most + 1, dtype=offset.dtype, device=offset.device).asinh() / 2
    return table.index_select(0, (offset.long() + most).flatten()).view(offset.shape)


def _interpolated(
    planes: Tensor, known: Tensor, share: Tensor, down: Tensor, across: Tensor
) -> Tensor:
    """Planes of labels, (B, K, H, W): where not known 2 p - 1, with the shares p of the classes
    among the nearest returns, (B, 4, H, W); all are equally likely where these have no label.
    """
    classes = torch.arange(1, planes.shape[1] + 1, device=planes.device)
    numbers = _moved(((planes.argmax(1, keepdim=True) + 1) * known)[None], down, across)[0]
    p = torch.stack([(share * (numbers == number)).sum(1) for number in classes], 1)
    total = p.sum(1, keepdim=True)
    p = torch.where(total > 0, p / total.clamp(min=1e-12), 1 / len(classes))
    return torch.where(known > 0, planes, 2 * p - 1)


def _between(log_r: Tensor, strength: Tensor, distance: Tensor) -> Tensor:
    """Interpolate log r and reflectance of two returns, (B, 2, H, W), linearly in 1 / r.

    The nearer return has the larger weight; (2, B, 1, H, W).
    """
    share = (distance / distance.sum(1, keepdim=True).clamp(min=1)).flip(1)
    inverse, reflectance = (torch.stack([(-log_r).exp(), strength]) * share).sum(2, keepdim=True)
    return torch.stack([-inverse.clamp(min=1e-6).log(), reflectance])


def nearest_returns(returned: Tensor, steps: Tensor, ring: bool) -> Tensor:
    """Rows and columns from each ray to the nearest returns above, below, left and right.

    `Above` is the quadrant of previous rows whose distance in columns is at most the distance in
    rows; the others are alike. The nearest has the smallest angle. Offsets, (4, 2, B, H, W)
    float32, are infinite without a return.

    Args:
        returned: Whether a ray has a return, (B, H, W) bool.
        steps: See `Surroundings.of`.
        ring: Whether the columns are a full turn.
    """
    twice = steps.repeat(2, 1).mT[..., None, None]  # (2, 2 B, 1, 1)
    pairs = torch.cat([returned, returned.flip(1)])
    above, below = _before(pairs, twice, turning=False, ring=ring).chunk(2, 1)
    pairs = torch.cat([returned, returned.flip(2)]).mT
    left, right = _before(pairs, twice.flip(0), turning=ring, ring=False).mT.flip(0).chunk(2, 1)
    upward = steps.new_tensor([-1, 1])[:, None, None, None]  # the opposite direction of rows
    return torch.stack([above, below.flip(2) * upward, left, right.flip(3) * -upward])


def _before(returned: Tensor, steps: Tensor, turning: bool, ring: bool) -> Tensor:
    """Offsets to the nearest return in the quadrant of previous rows, (2, B, H, W).

    The rows are searched in blocks side by side. Each block begins again from what the previous one
    found, until nothing changes: two or three times on scans, instead of one after the other.

    Args:
        turning: Whether the first row follows the last.
        ring: Whether the first column follows the last.
    """
    rows = returned.shape[1]
    blocks = 1
    if rows > _FEW:
        blocks = math.isqrt(rows)
        if turning:  # no row can be added to a turn
            blocks = max(n for n in range(1, blocks + 1) if rows % n == 0)
    returned = F.pad(returned, (0, 0, 0, -rows % blocks))
    blocked = returned.unflatten(1, (blocks, -1)).movedim(2, 0)  # (L, B, blocks, W)
    if torch.compiler.is_exporting():  # its steps would be a graph of thousands of nodes
        shape = (len(blocked), 2, *blocked.shape[1:])
        found = torch.onnx.ops.symbolic(
            "r2flow::Before",
            (blocked, steps),
            {"turning": [int(turning)], "ring": [int(ring)]},
            dtype=steps.dtype,
            shape=shape,
        )
    else:
        found = _swept(blocked, steps, turning, ring)
    return found.movedim(0, 3).flatten(2, 3)[:, :, :rows]


def _swept(returned: Tensor, steps: Tensor, turning: bool, ring: bool) -> Tensor:
    """`_before` of rows in blocks, (L, B, blocks, W): offsets, (L, 2, B, blocks, W).

    Those of a row are the nearest of three of the previous row. All steps write to the same memory,
    for which a CPU would need more time than for the arithmetic.
    """
    length, *shape = returned.shape
    columns = shape[-1]
    rows = returned.logical_not().unbind()
    offsets = steps.new_full((length + 1, 2, *shape), math.inf)
    states = offsets.unbind()
    wide = steps.new_full((2, *shape[:-1], columns + 2), math.inf)  # with a column on each side
    previous = wide.unfold(-1, columns, 1).movedim(-2, 0)  # (3, 2, B, blocks, W)
    moves = steps.new_tensor([[-1, -1], [-1, 0], [-1, 1]]).view(3, 2, *[1] * len(shape))
    moved = torch.empty_like(previous, memory_format=torch.contiguous_format)
    angles = torch.empty_like(moved)
    squares = torch.empty_like(moved[:, 0])
    best = torch.empty_like(moved[0])
    nearer = torch.empty_like(squares[0], dtype=torch.bool)
    # Views are made once: made for each row, they are a quarter of the search.
    inner = previous[1]
    before, same, after = moved
    square_before, square_same, square_after = squares
    down, across = angles.unbind(1)
    zero = steps.new_zeros(())
    left, first, last, right = (wide[..., k] for k in (0, 1, -2, -1))
    start = states[0].clone()
    for _ in range(2 * shape[1]):  # at most two turns
        states[0].copy_(start)
        for empty, state, following in zip(rows, states[:-1], states[1:], strict=True):
            torch.where(empty, state, zero, out=inner)
            if ring:
                left.copy_(last)
                right.copy_(first)
            torch.add(previous, moves, out=moved)
            torch.mul(moved, steps, out=angles)
            angles.square_()
            torch.add(down, across, out=squares)
            torch.lt(square_same, square_before, out=nearer)
            torch.where(nearer, same, before, out=best)
            torch.minimum(square_before, square_same, out=square_before)
            torch.lt(square_after, square_before, out=nearer)
            torch.where(nearer, after, best, out=following)
        start = states[-1].roll(1, 2)
        if not turning:
            start[:, :, 0] = math.inf
        if torch.equal(start, states[0]):
            break
    return offsets[:-1]
