"""Hand-made features of scans, without training or weights, for any sensor and image size.

The statistics describe differences of neighbouring returns along rows and columns, missing rays,
and distributions of range and reflectance. Each is a mean over half of the rows, invariant to
rotation of the scan. Six are also computed per azimuth sector, which distinguishes rotated and
mirrored scans.

Statistics, bands, sectors and scale were chosen on half of a set of corruptions of scans.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
import yaml
from torch import Tensor

from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.scans import Scans

BANDS = 2  # of rows
SECTORS = 8  # of azimuth
FINE = 0.005  # metres, or relative to full reflectance: lower limit of steps
_SAME = 0.0025  # metres: neighbours are equal up to rounding in files
EDGE = 0.5  # metres between neighbours on different objects
_RANGES = (0, 5, 10, 20, 40, torch.inf)  # metres
_REFLECTANCES = (0, 0.1, 0.25, 0.5, torch.inf)
FEW = 0.01  # share of rays in a cell; statistics of fewer rays shrink to the centre
FAR_OUT = 5.0  # distance from the centre in scales beyond which features grow logarithmically

# Ends of the names of features: see `Handcrafted`.
_SPREAD = ", spread"
_BEAMS = ", beams"
SECTORED = ", sectors"

# Centre and spread of each statistic, by name.
SCALES: dict[str, list[float]] = yaml.safe_load(
    Path(__file__).with_name("handcrafted.yaml").read_text(encoding="utf-8")
)


def _statistics(r: Tensor, q: Tensor | None) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield names in `SCALES`, values per pixel, and the mask of pixels, (B, H, W) each.

    r are ranges in metres, (B, H, W), 0 without a return; q reflectances.
    """
    m = (r > 0).to(r)
    every = torch.ones_like(r)
    right = _right(m)
    left = _right(m, -1)
    lower = _lower(m)
    yield "returns", m, every
    yield "row changes", (m - right).abs(), every
    yield "column changes", (m - lower).abs(), every
    yield "single losses", (1 - m) * right * left, every
    yield "single returns", m * (1 - right) * (1 - left), every
    log_range = torch.log2(r + 1)
    yield "log-range", log_range, m
    for low, high in pairwise(_RANGES):
        yield f"beyond {low} m", ((r > low) & (r <= high)).to(r), every
    step = _right(r) - r
    both = m * right
    edge = (step.abs() > EDGE).to(r) * both
    yield "row step", _size(step), both
    yield "row edges", edge, every
    yield "row slant", torch.tanh(step / EDGE), both
    yield "row equal", (step.abs() < _SAME).to(r), both
    for far in (8, 64):
        yield f"row step of {far}", _size(_right(r, far) - r), m * _right(m, far)
    before = _right(step, -1)
    three = both * left
    yield "row bend", _size(step - before), three
    yield "row bend sign", torch.tanh((step - before) / 0.1), three
    yield "row smooth", _agreement(step, before), three
    down = _lower(r) - r
    two = m * lower
    yield "column step", _size(down), two
    yield "column edges", (down.abs() > EDGE).to(r) * two, every
    yield "column slant", torch.tanh(down / EDGE), two
    bend = down - _upper(down)
    whole = two * _upper(m)
    yield "column bend", _size(bend), whole
    yield "column bend sign", torch.tanh(bend / EDGE), whole
    four = both * _lower(both)
    yield "rows agree", _agreement(step, _lower(step)), four
    yield "diagonals", _size(_lower(_right(r)) - r) - _size(_right(r) - _lower(r)), four
    if q is None:
        return
    yield "reflectance", q, m
    for low, high in pairwise(_REFLECTANCES):
        yield f"reflectance from {low}", ((q >= low) & (q < high)).to(r) * m, every
    step = _right(q) - q
    before = _right(step, -1)
    yield "reflectance row step", _size(step), both
    yield "reflectance row smooth", _agreement(step, before), three
    yield "reflectance row bend", _size(step - before), three
    yield "reflectance column step", _size(_lower(q) - q), two
    yield "reflectance at edges", step.abs(), edge
    yield "reflectance rows agree", _agreement(step, _lower(step)), four
    yield "reflectance with range", q * (log_range - 4), m


def _right(x: Tensor, by: int = 1) -> Tensor:
    """Value of the pixel to the right; rows are periodic."""
    return x.roll(-by, -1)


def _lower(x: Tensor) -> Tensor:
    """Value of the pixel below; 0 below the last row."""
    return F.pad(x[:, 1:], (0, 0, 0, 1))


def _upper(x: Tensor) -> Tensor:
    return F.pad(x[:, :-1], (0, 0, 1, 0))


def _size(x: Tensor) -> Tensor:
    return torch.log2(x.abs() + FINE)


def _agreement(a: Tensor, b: Tensor) -> Tensor:
    """2 a b / (a^2 + b^2): 1 for equal steps, -1 for opposite ones, 0 if one is 0 or both small."""
    return 2 * a * b / (a * a + b * b + FINE**2)


class Handcrafted(Extractor):
    """Features of range and reflectance: means and spreads of `_statistics` in 2 bands of rows.

    Some are means in 8 sectors. Names with `_SPREAD` are standard deviations within a band; names
    with `_BEAMS` are means over the band of differences between the means of neighbouring rows,
    |x(h - 1) - 2 x(h) + x(h + 1)|.
    """

    name = "handcrafted"
    layer = f"means over {BANDS} bands of rows and {SECTORS} sectors of azimuth"
    weights = "none"
    needs_reflectance = True
    table: Tensor  # centre and spread of every feature, (D, 2)

    def __init__(self) -> None:
        super().__init__()
        both = self.needs_reflectance
        self.scales = {name: s for name, s in SCALES.items() if both or "reflectance" not in name}
        table = []
        for name, scale in self.scales.items():
            table += [scale] * (SECTORS if name.endswith(SECTORED) else BANDS)
        self.dim = len(table)
        self.register_buffer("table", torch.tensor(table), persistent=False)

    @classmethod
    def trained(cls) -> Self:
        return cls()

    @torch.no_grad()
    def features(self, scans: Scans) -> Tensor:
        # One by one, for a core's cache.
        parts = [self._features(image) for image in scans.images.split(1)]
        return scans.nan_where_empty(torch.cat(parts))

    def _features(self, images: Tensor) -> Tensor:
        h, w = images.shape[2:]
        found = {}
        q = images[:, 1] if self.needs_reflectance else None
        for name, x, where in _statistics(images[:, 0], q):
            masked = x * where
            sums = masked.sum(-1)
            counts = where.sum(-1)
            mean, share = found[name] = _cells(sums, counts, BANDS, w)
            if name + _SPREAD in self.scales:
                square, _ = _cells(torch.linalg.vecdot(masked, x), counts, BANDS, w)
                spread = (square - mean**2).clamp(min=0).sqrt()
                found[name + _SPREAD] = torch.stack([spread, share])
            if name + _BEAMS in self.scales:
                found[name + _BEAMS] = _unevenness(sums, counts)
            if name + SECTORED in self.scales:
                found[name + SECTORED] = _cells(masked.sum(-2), where.sum(-2), SECTORS, h)
        values, shares = torch.cat([found[name] for name in self.scales], 2)
        centre, spread = self.table.T
        x = (values - centre) / spread * (shares / (shares + FEW))
        return FAR_OUT * torch.asinh(x / FAR_OUT)


class HandcraftedRange(Handcrafted):
    """Features of range only, for scans without reflectance; not comparable with `Handcrafted`."""

    name = "handcrafted_range"
    needs_reflectance = False


def _cells(total: Tensor, count: Tensor, cells: int, rays: int) -> Tensor:
    """Means over equal parts of rows or columns, and the shares counted, (2, B, cells).

    From sums and counts, (B, n).
    """
    n = F.adaptive_avg_pool1d(count, cells)
    return torch.stack([F.adaptive_avg_pool1d(total, cells) / n.clamp(min=1e-6), n / rays])


def _unevenness(total: Tensor, count: Tensor) -> Tensor:
    """|x(h - 1) - 2 x(h) + x(h + 1)| of row means x, as in `_cells`, where all three exist."""
    mean = total / count.clamp(min=1)
    valid = (count > 0).to(total)
    defined = (F.avg_pool1d(valid, 3, 1, 1) == 1).to(total)
    difference = F.pad((mean[:, 2:] - 2 * mean[:, 1:-1] + mean[:, :-2]).abs(), (1, 1))
    return _cells(difference * defined, defined, BANDS, 1)
