"""Things in scans: straight walls, right angles, poles and cars, found by their shape in metres."""

from collections.abc import Mapping
from dataclasses import dataclass
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

# Metres, where no other unit is named; what each is for says the docstring of `Things`.
STEP, SLOPE, REACH, FOOT = 0.1, 0.1, 0.5, 0.5
WALLS, HOLE, PIECE, STRAIGHT, FEWEST = 30.0, 1.0, 4.0, 0.05, 10.0  # the last in square metres
POLES, THIN, CLEAR, LEAN, TALL = 20.0, 0.4, 1.0, 0.6, 1.0
CARS, GAP, SEEN, LENGTH, WIDTH, TOP, FACE, CUT = 20.0, 0.7, 1.2, 5.5, 2.4, (1.0, 2.2), 0.3, 1.5  # the last in degrees
TURNS = np.deg2rad(np.arange(0, 90, 3))
LINES = ("straight walls", "right angles", "poles", "cars")


class Things(SumMetric):
    """What a person would name in a scan: four figures of each set, those of the real one as "NAME, real".

    All lengths are metres, distances are measured from above, and a ring is a row of the image, which closes. The
    ground is followed outwards in each column from below the sensor: a return within 0.1 + 0.1 d of the ground's height
    belongs to it, d being the way from the last ground, which is taken anew every 0.5. All others stand above it.

    - `straight walls`: share of wall that is straight to 0.05. Returns within 30 that stand 0.5 or more above the
      ground are joined along each ring where the next is less than 1 away. A piece begins at any of them and ends at
      the first one 4 away. A return is wall if a piece holds it, and straight if one of these pieces is within 0.05 rms
      (over n - 2) of its line. It counts by the width of its bin at its distance. 0 where there is no wall.
    - `right angles`: mean over scans with 10 square metres of wall or more of |mean of exp(4 i theta)|, theta being the
      direction of the straightest piece through each wall return, which counts as before. 1 where walls are parallel or
      at right angles; n independent directions have about 0.9 / sqrt(n).
    - `poles`, a scan: returns above the ground within 20, each less than 0.4 from the next along a ring and the first
      from the last, are thin if the next return to either side is 1 farther or 1 aside. Such stretches less than 0.4
      and two rings or fewer apart are a pole (or trunk) if together less than 0.6 across and 1 tall, edges of rings.
    - `cars`, a scan: clusters of returns above the ground, each the next of another in its ring or column and less than
      0.7 and a column's width from it in space. A cluster is car-like if it comes within 20, begins less than 0.5 and
      ends 1.0 to 2.2 above the ground, 1.5 degrees or more below the image's upper edge, fills columns of 1.2 or more
      together, and its rectangle from above is up to 5.5 by 2.4. Of 30 directions, the rectangle's is that whose two
      sides towards the sensor are nearest to the returns; half of these are within 0.3. One visible side is enough.
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
                row[:] = counts(Returns.of(xyz, returned, scans.sensor))
        return torch.from_numpy(rows)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        figures = {}
        for end, (straight, wall, square, angled, poles, cars, scans) in (("", generated), (", real", real)):
            parts = (straight, wall), (square, angled), (poles, scans), (cars, scans)
            for name, (part, whole) in zip(LINES, parts, strict=True):
                figures[name + end] = float(part / (whole or 1)) if scans else float("nan")
        return figures


@dataclass(frozen=True)
class Returns:
    """The N returns of a scan in order of rings; `above` is NaN on the ground, `bins` are the bins' widths there."""

    sensor: Sensor
    p: np.ndarray
    row: np.ndarray
    column: np.ndarray
    above: np.ndarray
    far: np.ndarray
    bins: np.ndarray

    @classmethod
    def of(cls, xyz: np.ndarray, returned: np.ndarray, sensor: Sensor) -> "Returns":
        """From points (3, H, W) and which of them returned, (H, W)."""
        row, column = np.nonzero(returned)
        p = xyz[:, row, column].T.astype(np.float64)
        above, far = heights(xyz, returned, sensor.height)[row, column], np.hypot(p[:, 0], p[:, 1])
        return cls(sensor, p, row, column, above, far, far * 2 * np.pi / sensor.columns)


def counts(s: Returns) -> tuple[float, ...]:
    """Straight wall and wall; |mean exp(4 i theta)| and 1, or 0 and 0 in too little wall; poles; cars; 1."""
    at, rms, angle = walls(s)
    width = s.bins[at]
    area = (width * s.far[at] * -np.diff(np.deg2rad(s.sensor.row_edges))[s.row[at]]).sum()
    square = np.abs((width * np.exp(4j * angle)).sum()) / width.sum() if area >= FEWEST else 0
    return width[rms <= STRAIGHT].sum(), width.sum(), square, area >= FEWEST, len(poles(s)), len(cars(s)), 1


def heights(xyz: np.ndarray, returned: np.ndarray, height: float) -> np.ndarray:
    """Height of each pixel above the ground nearer in its column, (H, W); NaN for the ground and without a return."""
    far, z = np.hypot(xyz[0], xyz[1]), xyz[2]
    at, level = np.zeros(z.shape[1]), np.full(z.shape[1], -height)
    above = np.full(z.shape, np.nan)
    for h in reversed(range(len(z))):
        way = far[h] - at
        ground = returned[h] & (np.abs(z[h] - level) <= STEP + SLOPE * np.maximum(way, 0))
        above[h] = np.where(returned[h] & ~ground, z[h] - level, np.nan)
        taken = ground & (way >= REACH)
        at, level = np.where(taken, far[h], at), np.where(taken, z[h], level)
    return above


def walls(s: Returns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The wall returns' places among all, and the straightest piece through each: rms across it, direction."""
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
    while len(a):  # all pieces together, return by return
        better = rms < best[a]
        best[a[better]], direction[a[better]] = rms[better], angle[better]
        on = a != b
        a, b, rms, angle = after[a[on]], b[on], rms[on], angle[on]
    found = np.isfinite(best)
    return kept[found], best[found], direction[found]


def poles(s: Returns) -> np.ndarray:
    """Middles from above, (P, 2)."""
    after, stands = _after(s.row), s.above > 0
    before = np.argsort(after)
    joined = stands & stands[after] & (np.linalg.norm(s.p[after] - s.p, axis=-1) < THIN)
    beside = (s.column[after] - s.column) % s.sensor.columns * np.minimum(s.bins, s.bins[after]) < CLEAR
    free, free_before = ~beside | (s.far[after] > s.far + CLEAR), (~beside | (s.far > s.far[after] + CLEAR))[before]
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
    """Middle from above, length and width of what is seen, and height, (C, 5)."""
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
    apart, off = np.abs(sides - face[label]).min(1), np.zeros((len(number), len(TURNS)))
    np.add.at(off, label, apart / count[label, None])
    turn = off.argmin(1)
    near_face = np.bincount(label, apart[np.arange(len(at)), turn[label]] <= FACE, len(number)) >= count / 2
    low, high = (np.take_along_axis(end, turn[:, None, None], 2)[..., 0] for end in (low, high))
    (width, length), (u, v) = np.sort(high - low, 1).T, (low + high).T / 2
    middle = (u + 1j * v) * np.exp(1j * TURNS[turn])
    boxes = np.column_stack([middle.real, middle.imag, length, width, top[number]])
    columns = np.unique(label * s.sensor.columns + s.column[at]) // s.sensor.columns
    seen = np.bincount(columns, minlength=len(number)) * column[number]
    return boxes[near_face & (seen >= SEEN) & (length <= LENGTH) & (width <= WIDTH)]


def _after(row: np.ndarray) -> np.ndarray:
    """The next return on the ring of each, (N,): after the last of a ring its first."""
    place = np.arange(len(row))
    last = np.append(row[1:] != row[:-1], True)[: len(row)]
    return np.where(last, np.searchsorted(row, row), place + 1)


def _components(count: int, edges: np.ndarray) -> np.ndarray:
    """The number of the component of each of `count` nodes, joined by edges (2, E)."""
    return connected_components(coo_array((np.ones(edges.shape[1], bool), tuple(edges)), (count, count)), False)[1]


def _least(label: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The least of the values (N, ...) of each label from 0 on, (labels, ...)."""
    least = np.full((label.max(initial=-1) + 1, *values.shape[1:]), np.inf)
    np.fmin.at(least, label, values)
    return least
