"""Objects in scans: straight walls, right angles, poles and cars, detected by metric shape."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric

# Metres unless noted; see the docstring of `Things`.
STEP, SLOPE, REACH, FOOT = 0.1, 0.1, 0.5, 0.5
WALLS, HOLE, PIECE, STRAIGHT, FEWEST = 30.0, 1.0, 4.0, 0.05, 10.0  # FEWEST in square metres
POLES, THIN, CLEAR, LEAN, TALL = 20.0, 0.4, 1.0, 0.6, 1.0
CARS, GAP, SEEN, LENGTH, WIDTH, TOP, FACE, CUT = 20.0, 0.7, 1.2, 5.5, 2.4, (1.0, 2.2), 0.3, 1.5  # CUT in degrees
TURNS = np.deg2rad(np.arange(0, 90, 3))
LINES = ("straight walls", "right angles", "poles", "cars")


class Things(SumMetric):
    """Statistics of objects: four values per set; those of the real set are named "NAME, real".

    Lengths are in metres and distances horizontal; a ring is a row of the image, which is periodic. The ground is
    tracked outwards in each column from below the sensor: a return within 0.1 + 0.1 d of the last ground height is
    ground, with d the distance to the last ground return, updated every 0.5. All other returns are above the ground.

    - `straight walls`: share of wall that is straight to 0.05. Returns within 30 and at least 0.5 above the ground are
      linked along each ring if less than 1 apart. A segment starts at any of them and ends at the first return at a
      distance of 4. A return is wall if it lies in a segment, and straight if one of these segments has an rms (over
      n - 2) of up to 0.05 about its line. Returns are weighted by the width of their bin. 0 without walls.
    - `right angles`: mean of |mean of exp(4 i theta)| over scans with at least 10 square metres of wall, with theta the
      direction of the straightest segment through each wall return, weighted as before. 1 for parallel and
      perpendicular walls; about 0.9 / sqrt(n) for n independent directions.
    - `poles` per scan: returns above the ground within 20, each less than 0.4 in space from the next along a ring, ends
      less than 0.4 apart, are thin if the next return on either side is 1 farther or 1 aside. Such runs, less than 0.4
      and up to two rings apart, form a pole if less than 0.6 wide and at least 1 tall, from the edges of rings.
    - `cars` per scan: clusters of returns above the ground, linked to the next return in ring or column if less than
      0.7 plus a column's width apart in space. A cluster is car-like if its nearest return is within 20, it starts less
      than 0.5 and ends 1.0 to 2.2 above the ground, at least 1.5 degrees below the image's upper edge, its columns are
      at least 1.2 wide in total, and its bounding rectangle from above is up to 5.5 by 2.4. The rectangle's direction,
      of 30, is that whose two sides towards the sensor are closest to the returns; half of the returns must be within
      0.3. One visible side is enough.
    """

    name = "things"
    representation = "points in rings"
    settings: ClassVar[Mapping[str, Any]] = {
        "ground": [STEP, SLOPE, REACH, FOOT], "walls": [WALLS, HOLE, PIECE, STRAIGHT, FEWEST],
        "poles": [POLES, THIN, CLEAR, LEAN, TALL], "cars": [CARS, GAP, SEEN, LENGTH, WIDTH, *TOP, FACE, CUT],
    }  # fmt: skip
    width = 7

    def rows(self, scans: Scans) -> Tensor:
        rows = np.full((len(scans), self.width), np.nan)
        for row, xyz, returned in zip(rows, scans.xyz.cpu().numpy(), scans.returned[:, 0].cpu().numpy(), strict=True):
            if returned.any():
                row[:] = counts(Returns(xyz, returned, scans.sensor))
        return torch.from_numpy(rows)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        figures = {}
        for end, (straight, wall, square, angled, poles, cars, scans) in (("", generated), (", real", real)):
            parts = (straight, wall), (square, angled), (poles, scans), (cars, scans)
            for name, (part, whole) in zip(LINES, parts, strict=True):
                figures[name + end] = float(part / (whole or 1)) if scans else float("nan")
        return figures


class Returns:
    """N returns of a scan, ring by ring, from points (3, H, W) and a mask of returns, (H, W).

    `p` are the points, (N, 3), `far` horizontal distances and `bins` widths of bins; `above` is NaN on the ground.
    """

    def __init__(self, xyz: np.ndarray, returned: np.ndarray, sensor: Sensor) -> None:
        self.sensor = sensor
        self.row, self.column = np.nonzero(returned)
        self.p = xyz[:, self.row, self.column].T.astype(np.float64)
        self.above = heights(xyz, returned, sensor.height)[self.row, self.column]
        self.far = np.hypot(self.p[:, 0], self.p[:, 1])
        self.bins = self.far * 2 * np.pi / sensor.columns


def counts(s: Returns) -> tuple[float, ...]:
    """Straight wall, wall; |mean exp(4 i theta)| and 1, or 0 and 0 with too little wall; poles; cars; 1."""
    at, rms, angle = walls(s)
    width = s.bins[at]
    area = (width * s.far[at] * -np.diff(np.deg2rad(s.sensor.row_edges))[s.row[at]]).sum()
    square = np.abs((width * np.exp(4j * angle)).sum()) / width.sum() if area >= FEWEST else 0
    return width[rms <= STRAIGHT].sum(), width.sum(), square, area >= FEWEST, len(poles(s)), len(cars(s)), 1


def heights(xyz: np.ndarray, returned: np.ndarray, height: float) -> np.ndarray:
    """Height of each pixel above the last ground in its column, (H, W); NaN for ground and missing returns."""
    far, z = np.hypot(xyz[0], xyz[1]), xyz[2]
    at, level = np.zeros(z.shape[1]), np.full(z.shape[1], -height)
    above = np.full(z.shape, np.nan)
    for h in reversed(range(len(z))):
        way = far[h] - at
        ground = returned[h] & (np.abs(z[h] - level) <= STEP + SLOPE * np.maximum(way, 0))
        above[h] = np.where(returned[h] & ~ground, z[h] - level, np.nan)
        update = ground & (way >= REACH)
        at, level = np.where(update, far[h], at), np.where(update, z[h], level)
    return above


def walls(s: Returns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of wall returns, and rms and direction of the straightest segment through each."""
    kept = np.flatnonzero((s.above >= FOOT) & (s.far <= WALLS))
    p, row = s.p[kept, :2], s.row[kept]
    after = _after(row)
    joined = np.linalg.norm(p[after] - p, axis=-1) < HOLE
    a = np.flatnonzero(joined)
    b, pieces = after[a], [np.zeros((2, 0), int)]
    while len(a):
        full = np.linalg.norm(p[b] - p[a], axis=-1) >= PIECE
        pieces.append(np.stack([a, b])[:, full])
        on = ~full & joined[b] & (after[b] != a)
        a, b = a[on], after[b[on]]
    (a, b), (x, y) = np.concatenate(pieces, 1), p.T
    sums = np.pad(np.cumsum([np.ones(len(p)), x, y, x * x, x * y, y * y], axis=1), ((0, 0), (1, 0)))
    ring = sums[:, np.searchsorted(row, row[a], "right")] - sums[:, np.searchsorted(row, row[a])]
    n, x, y, xx, xy, yy = sums[:, b + 1] - sums[:, a] + ring * (b < a)
    xx, xy, yy = xx - x * x / n, xy - x * y / n, yy - y * y / n
    across = (xx + yy - np.hypot(xx - yy, 2 * xy)) / 2  # smaller eigenvalue of the scatter
    rms, angle = np.sqrt(np.maximum(across, 0) / (n - 2)), np.arctan2(2 * xy, xx - yy) / 2
    best, direction = np.full(len(p), np.inf), np.zeros(len(p))
    while len(a):  # walk along all segments in parallel
        better = rms < best[a]
        best[a[better]], direction[a[better]] = rms[better], angle[better]
        on = a != b
        a, b, rms, angle = after[a[on]], b[on], rms[on], angle[on]
    wall = np.isfinite(best)
    return kept[wall], best[wall], direction[wall]


def poles(s: Returns) -> np.ndarray:
    """Horizontal positions, (P, 2)."""
    after, stands = _after(s.row), s.above > 0
    before = np.argsort(after)
    joined = stands & stands[after] & (np.linalg.norm(s.p[after] - s.p, axis=-1) < THIN)
    adjacent = (s.column[after] - s.column) % s.sensor.columns * np.minimum(s.bins, s.bins[after]) < CLEAR
    free, free_before = ~adjacent | (s.far[after] > s.far + CLEAR), (~adjacent | (s.far > s.far[after] + CLEAR))[before]
    first, last = np.flatnonzero(~joined[before]), np.flatnonzero(~joined)
    stretch = _components(len(s.p), np.stack([np.flatnonzero(joined), after[joined]]))
    first, last = first[np.argsort(stretch[first])], last[np.argsort(stretch[last])]
    thin = stands[first] & free_before[first] & free[last] & (s.far[first] <= POLES)
    thin &= np.linalg.norm(s.p[last, :2] - s.p[first, :2], axis=-1) < THIN
    ends = np.stack([first, last])[:, thin]
    middle, row = s.p[ends, :2].mean(0), s.row[ends[0]]
    pairs = cKDTree(middle).query_pairs(THIN, output_type="ndarray")
    label = _components(len(row), pairs[np.abs(np.diff(row[pairs], axis=1)[:, 0]) <= 2].T)
    low = _least(label, np.column_stack([s.p[ends, :2].min(0), row, s.far[ends[0]]]))
    high = -_least(label, -np.column_stack([s.p[ends, :2].max(0), row]))
    edges = np.tan(np.deg2rad(s.sensor.row_edges))
    tall = low[:, 3] * (edges[low[:, 2].astype(int)] - edges[high[:, 2].astype(int) + 1])
    held = (np.linalg.norm(high[:, :2] - low[:, :2], axis=-1) < LEAN) & (tall >= TALL)
    return (low[held, :2] + high[held, :2]) / 2


def cars(s: Returns) -> np.ndarray:
    """Horizontal centre, length and width of the visible part, and height, (C, 5)."""
    stands, down = s.above > 0, np.lexsort((s.row, s.column))
    a, b = np.append(np.arange(len(s.p)), down[:-1]), np.append(_after(s.row), down[1:])
    joined = stands[a] & stands[b] & ((s.row[a] == s.row[b]) | (s.column[a] == s.column[b]))
    joined &= np.linalg.norm(s.p[a] - s.p[b], axis=-1) < GAP + s.bins[a]
    label = _components(len(s.p), np.stack([a, b])[:, joined])
    low = _least(label, np.column_stack([s.above, s.far, s.row, -s.above, s.bins]))
    foot, near, row, top, column = low.T * [[1], [1], [1], [-1], [1]]
    held = (near <= CARS) & (foot < FOOT) & (top >= TOP[0]) & (top <= TOP[1])
    held &= np.array(s.sensor.elevations)[row.astype(int)] <= s.sensor.row_edges[0] - CUT
    at = np.flatnonzero(stands & held[label])
    number, label, count = np.unique(label[at], return_inverse=True, return_counts=True)
    x, y = s.p[at, :2].T[..., None]
    sides = np.stack([x * np.cos(TURNS) + y * np.sin(TURNS), y * np.cos(TURNS) - x * np.sin(TURNS)], 1)
    low, high = _least(label, sides), -_least(label, -sides)  # (C, 2, turns)
    face = np.where(np.abs(low) < np.abs(high), low, high)  # the two sides towards the sensor
    distance, off = np.abs(sides - face[label]).min(1), np.zeros((len(number), len(TURNS)))
    np.add.at(off, label, distance / count[label, None])
    turn = off.argmin(1)
    near_face = np.bincount(label, distance[np.arange(len(at)), turn[label]] <= FACE, len(number)) >= count / 2
    low, high = (np.take_along_axis(end, turn[:, None, None], 2)[..., 0] for end in (low, high))
    (width, length), (u, v) = np.sort(high - low, 1).T, (low + high).T / 2
    middle = (u + 1j * v) * np.exp(1j * TURNS[turn])
    boxes = np.column_stack([middle.real, middle.imag, length, width, top[number]])
    columns = np.unique(label * s.sensor.columns + s.column[at]) // s.sensor.columns
    seen = np.bincount(columns, minlength=len(number)) * column[number]
    return boxes[near_face & (seen >= SEEN) & (length <= LENGTH) & (width <= WIDTH)]


def _after(row: np.ndarray) -> np.ndarray:
    """Index of the next return on the ring of each return, (N,); the last wraps to the first."""
    place = np.arange(len(row))
    last = np.append(row[1:] != row[:-1], True)[: len(row)]
    return np.where(last, np.searchsorted(row, row), place + 1)


def _components(count: int, edges: np.ndarray) -> np.ndarray:
    """Component index of each of `count` nodes, for edges (2, E)."""
    return connected_components(coo_array((np.ones(edges.shape[1], bool), tuple(edges)), (count, count)), False)[1]


def _least(label: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Minimum of values (N, ...) per label 0, 1, ..., (labels, ...)."""
    least = np.full((label.max(initial=-1) + 1, *values.shape[1:]), np.inf)
    np.fmin.at(least, label, values)
    return least
