"""Hand-made features of scans, without training or weights, for any sensor and image size.

The statistics describe differences of neighbouring returns along rows and columns, missing rays, and distributions of
range and reflectance. Each is a mean over half of the rows, invariant to rotation of the scan. Six are also computed
per azimuth sector, which distinguishes rotated and mirrored scans.

Statistics, bands, sectors and scale were chosen on half of a set of corruptions of scans.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import ClassVar, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from r2flow.metrics.extractors.base import Extractor, nan_where_empty
from r2flow.metrics.scans import Scans

BANDS, SECTORS = 2, 8  # bands of rows, sectors of azimuth
PIXELS = 2**16  # pixels per batch, sized for a core's cache
FINE = 0.005  # metres, or relative to full reflectance: lower limit of steps
SAME = 0.0025  # metres: neighbours are equal up to rounding in files
EDGE = 0.5  # metres between neighbours on different objects
RANGES = (0, 5, 10, 20, 40, torch.inf)  # metres
REFLECTANCES = (0, 0.1, 0.25, 0.5, torch.inf)
FEW = 0.01  # share of rays in a cell; statistics of fewer rays shrink to the centre
FAR_OUT = 5.0  # distance from the centre in scales beyond which features grow logarithmically


# Features are (x - centre) / spread, by mean and standard deviation over simulated hdl64e scans.
SPREAD, BEAMS, SECTORED = ", spread", ", beams", ", sectors"
SCALES = {
    "returns": (0.76, 0.029),
    "row changes": (0.026, 0.009),
    "column changes": (0.2, 0.019),
    "single losses": (0.0034, 0.0013),
    "single returns": (0.0018, 0.0011),
    "log-range": (3.3, 0.2),
    "beyond 0 m": (0.11, 0.055),
    "beyond 5 m": (0.36, 0.092),
    "beyond 10 m": (0.19, 0.063),
    "beyond 20 m": (0.077, 0.04),
    "beyond 40 m": (0.029, 0.023),
    "row step": (-5.0, 0.23),
    "row edges": (0.042, 0.011),
    "row slant": (0.0004, 0.0079),
    "row equal": (0.13, 0.025),
    "row step of 8": (-3.1, 0.41),
    "row step of 64": (-0.54, 0.55),
    "row bend": (-4.8, 0.25),
    "row bend sign": (0.022, 0.0048),
    "row smooth": (0.095, 0.067),
    "column step": (-2.6, 0.49),
    "column edges": (0.14, 0.06),
    "column slant": (-0.29, 0.069),
    "column bend": (-3.2, 0.37),
    "column bend sign": (0.018, 0.0093),
    "rows agree": (0.23, 0.062),
    "diagonals": (0.0043, 0.018),
    "reflectance": (0.27, 0.032),
    "reflectance from 0": (0.1, 0.041),
    "reflectance from 0.1": (0.2, 0.049),
    "reflectance from 0.25": (0.42, 0.073),
    "reflectance from 0.5": (0.041, 0.036),
    "reflectance row step": (-4.7, 0.14),
    "reflectance row smooth": (-0.24, 0.011),
    "reflectance row bend": (-3.9, 0.14),
    "reflectance column step": (-4.1, 0.13),
    "reflectance at edges": (0.16, 0.035),
    "reflectance rows agree": (0.012, 0.0061),
    "reflectance with range": (-0.19, 0.063),
    "log-range, spread": (0.54, 0.076),
    "row step, spread": (1.7, 0.15),
    "row bend, spread": (2.0, 0.16),
    "column step, spread": (1.8, 0.15),
    "column bend, spread": (1.9, 0.12),
    "reflectance, spread": (0.14, 0.019),
    "returns, beams": (0.16, 0.033),
    "log-range, beams": (0.076, 0.025),
    "row step, beams": (0.17, 0.061),
    "reflectance, beams": (0.065, 0.015),
    "returns, sectors": (0.76, 0.046),
    "log-range, sectors": (3.4, 0.29),
    "beyond 0 m, sectors": (0.11, 0.098),
    "row edges, sectors": (0.042, 0.018),
    "row step, sectors": (-4.9, 0.33),
    "reflectance, sectors": (0.26, 0.05),
}


def statistics(r: Tensor, q: Tensor | None) -> Iterator[tuple[str, Tensor, Tensor | None]]:
    """Yield names in `SCALES`, values per pixel, and the mask of pixels (None: all), (B, H, W) each.

    r are ranges in metres, (B, H, W), 0 without a return; q reflectances.
    """
    m = (r > 0).to(r)
    right, left, lower = _right(m), _right(m, -1), _lower(m)
    yield "returns", m, None
    yield "row changes", (m - right).abs(), None
    yield "column changes", (m - lower).abs(), None
    yield "single losses", (1 - m) * right * left, None
    yield "single returns", m * (1 - right) * (1 - left), None
    log_range = torch.log2(r + 1)
    yield "log-range", log_range, m
    for low, high in pairwise(RANGES):
        yield f"beyond {low} m", ((r > low) & (r <= high)).to(r), None

    step, both = _right(r) - r, m * right
    edge = (step.abs() > EDGE).to(r) * both
    yield "row step", _size(step), both
    yield "row edges", edge, None
    yield "row slant", torch.tanh(step / EDGE), both
    yield "row equal", (step.abs() < SAME).to(r), both
    for far in (8, 64):
        yield f"row step of {far}", _size(_right(r, far) - r), m * _right(m, far)
    before, three = _right(step, -1), both * left
    yield "row bend", _size(step - before), three
    yield "row bend sign", torch.tanh((step - before) / 0.1), three
    yield "row smooth", _agreement(step, before), three

    down, two = _lower(r) - r, m * lower
    yield "column step", _size(down), two
    yield "column edges", (down.abs() > EDGE).to(r) * two, None
    yield "column slant", torch.tanh(down / EDGE), two
    bend, whole = down - (r - _upper(r)), two * _upper(m)
    yield "column bend", _size(bend), whole
    yield "column bend sign", torch.tanh(bend / EDGE), whole
    four = both * _lower(both)
    yield "rows agree", _agreement(step, _lower(step)), four
    yield "diagonals", _size(_lower(_right(r)) - r) - _size(_right(r) - _lower(r)), four

    if q is None:
        return
    yield "reflectance", q, m
    for low, high in pairwise(REFLECTANCES):
        yield f"reflectance from {low}", ((q >= low) & (q < high)).to(r) * m, None
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
    """2 a b / (a^2 + b^2): 1 for equal steps, -1 for opposite steps, 0 if one is 0 or both are small."""
    return 2 * a * b / (a * a + b * b + FINE**2)


class Handcrafted(Extractor):
    """Features of range and reflectance: means and spreads of `statistics` in 2 bands of rows, some in 8 sectors.

    Names with `SPREAD` are standard deviations within a band; names with `BEAMS` are means over the band of differences
    between the means of neighbouring rows, |x(h - 1) - 2 x(h) + x(h + 1)|.
    """

    name = "handcrafted"
    layer = f"means over {BANDS} bands of rows and {SECTORS} sectors of azimuth"
    weights = "none"
    needs_reflectance: ClassVar[bool] = True
    table: Tensor  # centre and spread of every feature, (D, 2)

    def __init__(self) -> None:
        super().__init__()
        self.scales = {name: s for name, s in SCALES.items() if self.needs_reflectance or "reflectance" not in name}
        cells = [SECTORS if name.endswith(SECTORED) else BANDS for name in self.scales]
        self.dim = sum(cells)
        table = torch.tensor([scale for scale, n in zip(self.scales.values(), cells, strict=True) for _ in range(n)])
        self.register_buffer("table", table, persistent=False)

    @classmethod
    def trained(cls) -> Self:
        return cls()

    @torch.no_grad()
    def features(self, scans: Scans) -> Tensor:
        h, w = scans.sensor.shape
        parts = scans.images.split(max(PIXELS // (h * w), 1))
        return nan_where_empty(torch.cat([self._features(part) for part in parts]), scans)

    def _features(self, images: Tensor) -> Tensor:
        h, w = images.shape[2:]
        every = torch.ones_like(images[:, 0])
        features: dict[str, tuple[Tensor, Tensor]] = {}
        for name, x, where in statistics(images[:, 0], images[:, 1] if self.needs_reflectance else None):
            where = every if where is None else where
            masked, in_rows, in_columns = x * where, where.sum(-1), where.sum(-2)
            in_row = masked.sum(-1)
            features[name] = mean, share = _cells(in_row, in_rows, BANDS, w)
            if name + SPREAD in self.scales:
                square, _ = _cells(torch.linalg.vecdot(masked, x), in_rows, BANDS, w)
                features[name + SPREAD] = (square - mean**2).clamp(min=0).sqrt(), share
            if name + BEAMS in self.scales:
                features[name + BEAMS] = _unevenness(in_row, in_rows)
            if name + SECTORED in self.scales:
                features[name + SECTORED] = _cells(masked.sum(-2), in_columns, SECTORS, h)
        values, shares = (torch.cat([features[name][k] for name in self.scales], 1) for k in (0, 1))
        centre, spread = self.table.T
        x = (values - centre) / spread * (shares / (shares + FEW))
        return FAR_OUT * torch.asinh(x / FAR_OUT)


class HandcraftedRange(Handcrafted):
    """Features of range only, for scans without reflectance; not comparable with `Handcrafted`."""

    name = "handcrafted_range"
    needs_reflectance = False


def _cells(total: Tensor, count: Tensor, cells: int, rays: int) -> tuple[Tensor, Tensor]:
    """Means over equal parts of rows or columns, (B, cells), from sums and counts, (B, n), and the shares counted."""
    n = F.adaptive_avg_pool1d(count, cells)
    return F.adaptive_avg_pool1d(total, cells) / n.clamp(min=1e-6), n / rays


def _unevenness(total: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """|x(h - 1) - 2 x(h) + x(h + 1)| of row means x, as in `_cells`, over rows where all three exist."""
    mean, valid = total / count.clamp(min=1), (count > 0).to(total)
    defined = F.pad(valid[:, 2:] * valid[:, 1:-1] * valid[:, :-2], (1, 1))
    difference = F.pad((mean[:, 2:] - 2 * mean[:, 1:-1] + mean[:, :-2]).abs(), (1, 1))
    return _cells(difference * defined, defined, BANDS, 1)
