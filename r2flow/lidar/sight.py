"""Scans of one sensor as partially measured images of another one, in operations that torch
exports: `points_through` of scans whose sensor is named (r2flow.lidar.other_sensors).

Both forms are kept: this one is 2.5 to 9 times slower, and NumPy's cannot be exported.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn

from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import BLIND, WHOLE
from r2flow.lidar.projection import TIE
from r2flow.lidar.scan_files.points import FARTHEST
from r2flow.lidar.sensors import Sensor

_TURN = 2 * math.pi
# What is known of a pixel, the stronger the higher.
_NOTHING, _EMPTY, _NEAR, _RETURN = range(4)
_STATES = (Ray.UNKNOWN, Ray.EMPTY, Ray.UNKNOWN, Ray.RETURN)


class Sight(nn.Module):
    """Points of a scan by `source`, (N, 4), as an image of `target`.

    Points are x, y, z in metres and reflectance of [0, 1]; N is not fixed. Rows that are not
    finite are dropped, those at the origin are rays without a return.
    """

    def __init__(self, source: Sensor, target: Sensor) -> None:
        super().__init__()
        self.source = source
        self.target = target

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Range and reflectance, (2, H, W), `Ray`, (H, W), and points of the returns, (3, H, W)."""
        limits = points.new_tensor([FARTHEST] * 3 + [torch.finfo(torch.float32).max])
        inside = points.abs() <= limits
        # Runtimes differ in what they do with NaN.
        points = torch.where(inside, points, 0.0)
        stored = inside.all(1)
        origin = (points[:, :3] == 0).all(1)
        lost = stored & origin
        few = (~stored).sum() <= points.shape[0] / 100
        sine = points[:, 2] / torch.where(origin, 1.0, _norm(points))
        elevation = torch.rad2deg(sine.clamp(-1, 1).asin())
        beam = _rows(elevation, self.source)
        beams = len(self.source.elevations)
        valid = stored & ~origin & (beam < beams)
        points, elevation, beam, valid = self._at_least_two(points, elevation, beam, valid)
        kept = valid.nonzero()[:, 0]
        torch._check(kept.shape[0] > 1)
        points = points[kept]
        beam = beam[kept]
        azimuth = _azimuth(points)
        row = self._row_of(elevation[kept], beam)
        order = (beam * 8 + azimuth).argsort()
        steps = self._steps(azimuth[order], beam[order])
        rays, of_beam = _rays(azimuth[order], beam[order], beams, steps)
        cut = (few & ~lost.any()) | (stored.shape[0] < WHOLE * beams * steps)
        blind = self._blind(azimuth, steps) & cut
        rows, columns = self.target.shape
        column = self._columns(rays)
        empty = torch.where((row[of_beam] < rows) & ~blind[column], _EMPTY, _NOTHING)
        where = row[of_beam].clamp(max=rows - 1) * columns + column
        pixel = row[beam].clamp(max=rows - 1) * columns + self._columns(azimuth)
        r = _norm(points)
        seen = torch.where(r < self.target.min_range, _NEAR, _RETURN)
        seen = torch.where(r > self.target.max_range, _EMPTY, seen)
        seen = torch.where(row[beam] < rows, seen, _NOTHING)
        known = r.new_zeros(rows * columns, dtype=torch.int64)
        known = known.scatter_reduce(0, torch.cat([where, pixel]), torch.cat([empty, seen]), "amax")
        r = torch.where(seen == _RETURN, r, torch.inf)
        least = r.new_full((rows * columns,), torch.inf).scatter_reduce(0, pixel, r, "amin")
        number = torch.arange(r.shape[0], device=r.device)
        number = torch.where(r == least[pixel], number, r.shape[0] - 1)
        owner = torch.zeros_like(known) + r.shape[0] - 1
        owner = owner.scatter_reduce(0, pixel, number, "amin")
        xyz = points[owner]
        values = torch.cat([least[:, None], xyz[:, 3:].clamp(0, 1), xyz[:, :3]], 1)
        values = torch.where((known == _RETURN)[:, None], values, 0.0).mT.view(5, rows, columns)
        state = known.new_tensor(_STATES)[known].view(rows, columns)
        return values[:2], state, values[2:]

    def _at_least_two(
        self, points: Tensor, elevation: Tensor, beam: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Points with two more at the end, which are valid if fewer than two others are.

        They are copies of the only valid point, which change nothing, or a point of the first beam
        beyond all limits, which is no return.
        """
        angle = math.radians(self.source.elevations[0])
        beyond = points.new_tensor([[math.cos(angle), 0, math.sin(angle), 0]])
        beyond = 2 * max(self.source.max_range, self.target.max_range) * beyond
        points = torch.cat([points, beyond])
        elevation = torch.cat([elevation, elevation.new_full((1,), math.degrees(angle))])
        beam = torch.cat([beam, beam.new_zeros(1)])
        count = valid.sum()
        valid = torch.cat([valid, count[None] < 1])
        only = valid.to(torch.int32).argmax()[None].expand(1)
        points = torch.cat([points, points[only]])
        elevation = torch.cat([elevation, elevation[only]])
        beam = torch.cat([beam, beam[only]])
        return points, elevation, beam, torch.cat([valid, count[None] < 2])

    def _columns(self, azimuth: Tensor) -> Tensor:
        columns = self.target.columns
        place = (1 - azimuth / math.pi) / 2 * columns + TIE
        return place.floor().long() % columns

    def _row_of(self, elevation: Tensor, beam: Tensor) -> Tensor:
        """Row of the image of each beam, (B,), by the median elevation; H outside the view."""
        beams = elevation.new_tensor(self.source.elevations, dtype=torch.float64)
        first, count = _groups(beam, len(beams))
        ordered = elevation[(beam * 1000 + elevation.double()).argsort()]
        last = ordered.shape[0] - 1
        lower = ordered[(first + (count - 1) // 2).clamp(0, last)]
        upper = ordered[(first + count // 2).clamp(0, last)]
        middle = ((lower + upper) / 2).double()
        return _rows(torch.where(count > 0, middle, beams), self.target)

    def _steps(self, azimuth: Tensor, beam: Tensor) -> Tensor:
        """Rays of a turn, as `steps_of_a_turn`, whole."""
        gap = torch.rad2deg(azimuth.diff())
        gap = torch.where(beam.diff() == 0, gap, torch.inf)
        apart = torch.where(gap > 1e-2, gap, torch.inf).sort().values
        count = apart.isfinite().sum()
        place = 0.3 * (count - 1).clamp(min=0).double()
        low = place.floor().long()
        step = torch.lerp(apart[low], apart[(low + 1).clamp(max=apart.shape[0] - 1)], place - low)
        for _ in range(3):
            near = torch.where(gap < 3.5 * step, gap, 0.0)
            step = near.sum() / (near / step).round().sum()
        return torch.where(count > 0, (360 / step).round(), self.source.columns)

    def _blind(self, azimuth: Tensor, steps: Tensor) -> Tensor:
        """Columns of sectors without any return, (W,) bool."""
        columns = self.target.columns
        ordered = azimuth.sort().values
        gaps = torch.cat([ordered[1:], ordered[:1] + _TURN]) - ordered
        most = int(360 / BLIND)
        gaps, at = torch.cat([gaps, gaps.new_zeros(most)]).topk(most)
        start = torch.cat([ordered, gaps])[at]
        wide = gaps > torch.deg2rad((3 * 360 / steps).clamp(min=BLIND))
        number = torch.arange(columns, dtype=torch.float64, device=gaps.device)
        middles = math.pi * (1 - 2 * (number + 0.5) / columns)
        return (((middles - start[:, None]) % _TURN < gaps[:, None]) & wide[:, None]).any(0)


def _norm(points: Tensor) -> Tensor:
    x, y, z = points[:, :3].unbind(1)
    return (x * x + y * y + z * z).double().sqrt().float()  # rounded as NumPy does


def _azimuth(points: Tensor) -> Tensor:
    """float64: of float32, corrected by a step of Newton's method, as runtimes have no other."""
    x, y = points[:, :2].double().unbind(1)
    a = torch.atan2(points[:, 1], points[:, 0]).double()
    cos = (a + math.pi / 2).sin()  # some runtimes lack the cosine of float64
    sin = a.sin()
    return a + (y * cos - x * sin) / (x * cos + y * sin).clamp(min=1e-12)


def _rows(elevation: Tensor, sensor: Sensor) -> Tensor:
    """As `rows_of`; H outside the view."""
    edges = torch.from_numpy(-sensor.row_edges).to(elevation.device)
    row = ((TIE - elevation).double()[:, None] >= edges).sum(1) - 1
    return row % len(edges)


def _groups(group: Tensor, groups: int) -> tuple[Tensor, Tensor]:
    """First index and size of each of the groups in their order."""
    count = group.new_zeros(groups).scatter_add(0, group, torch.ones_like(group))
    return count.cumsum(0) - count, count


def _rays(azimuth: Tensor, beam: Tensor, beams: int, steps: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuths and beams of all rays, from those of returns by beam and azimuth."""
    step = _TURN / steps
    _, count = _groups(beam, beams)
    twice = torch.cat([(azimuth.diff() < step / 100) & (beam.diff() == 0), beam[:1] < 0])
    share = azimuth.new_zeros(beams).scatter_add(0, beam, twice.double()) / count.clamp(min=1)
    kept = (~twice | (share[beam] <= 0.3)).nonzero()[:, 0]
    # of a beam without returns all rays, from azimuth 0
    void = (count == 0).nonzero()[:, 0]
    azimuth = torch.cat([azimuth[kept], void * 0.0])
    beam = torch.cat([beam[kept], void])
    order = (beam * 8 + azimuth).argsort()
    azimuth = azimuth[order]
    beam = beam[order]
    first, count = _groups(beam, beams)
    number = torch.arange(beam.shape[0], device=beam.device)
    last = number - first[beam] == count[beam] - 1
    after = torch.where(last, first[beam], number + 1)
    gap = azimuth[after] - azimuth + _TURN * last
    before = torch.zeros_like(number).scatter(0, after, number)
    three = gap + gap[before] + gap[after]
    missing = torch.minimum((gap / step).round() - 1, (three / step).round() - 3)
    rays = missing.clamp(min=0).long() + 1
    start = rays.cumsum(0) - rays
    total: Any = rays.sum().item()  # in an export a symbol, which int() would fix
    marks = number.new_zeros(total).scatter(0, start, torch.ones_like(start))
    which = marks.cumsum(0) - 1
    k = torch.arange(total, device=beam.device) - start[which]
    return azimuth[which] + (gap / rays)[which] * k, beam[which]
