"""Objects in scans: straight walls, right angles, poles and cars, detected by metric shape."""

import numpy as np
import torch
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.base import Figures, SumMetric
from r2flow.metrics.scans import Scans

_WALL_LENGTH = 4.0  # metres, as all lengths here; see the docstring of `Things` for all limits
_POLE_WIDTH = 0.4
_POLE_CLEARANCE = 1.0
_REACH = 20.0  # of poles and cars
_TURNS = np.deg2rad(np.arange(0, 90, 3))
LINES = ("straight walls", "right angles", "poles", "cars")


class Things(SumMetric):
    """Statistics of objects: four values per set; those of the real set are named "NAME, real".

    Lengths are in metres and distances horizontal; a ring is a row of the image, which is periodic.
    The ground is tracked outwards in each column from below the sensor: a return within 0.1 + 0.1 d
    of the last ground height is ground, with d the distance to the last ground return, updated
    every 0.5. All other returns are above the ground.

    - `straight walls`: share of wall that is straight to 0.05. Returns within 30 and at least 0.5
      above the ground are linked along each ring if less than 1 apart. A segment starts at any of
      them and ends at the first return at a distance of 4. A return is wall if it lies in a
      segment, and straight if one of these segments has an rms (over n - 2) of up to 0.05 about its
      line. Returns are weighted by the width of their bin. 0 without walls.
    - `right angles`: mean of |mean of exp(4 i theta)| over scans with at least 10 square metres of
      wall, with theta the direction of the straightest segment through each wall return, weighted
      as before. 1 for parallel and perpendicular walls; about 0.9 / sqrt(n) for n independent
      directions.
    - `poles` per scan: returns above the ground within 20, each less than 0.4 in space from the
      next along a ring, ends less than 0.4 apart, are thin if the next return on either side is 1
      farther or 1 aside. Such runs, less than 0.4 and up to two rings apart, form a pole if less
      than 0.6 wide and at least 1 tall, from the edges of rings.
    - `cars` per scan: clusters of returns above the ground, linked to the next return in ring or
      column if less than 0.7 plus a column's width apart in space. A cluster is car-like if its
      nearest return is within 20, it starts less than 0.5 and ends 1.0 to 2.2 above the ground, at
      least 1.5 degrees below the image's upper edge, its columns are at least 1.2 wide in total,
      and its bounding rectangle from above is up to 5.5 by 2.4. The rectangle's direction, of 30,
      is that whose two sides towards the sensor are closest to the returns; half of the returns
      must be within 0.3. One visible side is enough.
    """

    name = "things"
    representation = "points in rings"
    width = 7

    def rows(self, scans: Scans) -> Tensor:
        rows = np.full((len(scans), self.width), np.nan)
        returned = scans.returned[:, 0].cpu().numpy()
        for row, xyz, mask in zip(rows, scans.xyz.cpu().numpy(), returned, strict=True):
            if mask.any():
                row[:] = _counts(Returns(xyz, mask, scans.sensor))
        return torch.from_numpy(rows)

    def figures_of(self, real: ndarray, generated: ndarray) -> Figures:
        figures = {}
        for side, sums in (("", generated), (", real", real)):
            wholes = sums[[1, 3, 6, 6]]
            parts = sums[[0, 2, 4, 5]] / np.where(wholes > 0, wholes, 1)
            for name, part in zip(LINES, parts, strict=True):
                figures[name + side] = float(part) if sums[6] else float("nan")
        return figures


class Returns:
    """N returns of a scan, ring by ring, from points (3, H, W) and a mask of returns, (H, W)."""

    def __init__(self, xyz: ndarray, returned: ndarray, sensor: Sensor) -> None:
        self.sensor = sensor
        self.row, self.column = np.nonzero(returned)
        self.p = xyz[:, self.row, self.column].T.astype(np.float64)  #: points, (N, 3)
        self.z = self.p[:, 0] + 1j * self.p[:, 1]  #: the same from above
        self.far = np.abs(self.z)
        self.bins = self.far * 2 * np.pi / sensor.columns  #: widths of bins
        #: Heights above the ground; NaN on it.
        self.above = _heights(xyz, returned, sensor.height)[self.row, self.column]
        self.stands = self.above > 0
        self.after = _after(self.row)


def _counts(s: Returns) -> tuple[float, ...]:
    """Straight wall, wall; |mean exp(4 i theta)| and 1, or 0 and 0; poles; cars; 1."""
    at, rms, angle = _walls(s)
    width = s.bins[at]
    tall = -np.diff(np.deg2rad(s.sensor.row_edges))[s.row[at]]
    enough = (width * s.far[at] * tall).sum() >= 10  # square metres
    square = np.abs((width * np.exp(4j * angle)).sum()) / width.sum() if enough else 0
    straight = width[rms <= 0.05].sum()
    return straight, width.sum(), square, enough, len(poles(s)), len(cars(s)), 1


def _heights(xyz: ndarray, returned: ndarray, height: float) -> ndarray:
    """Height of each pixel above the last ground in its column, (H, W).

    NaN for ground and missing returns.
    """
    far = np.hypot(xyz[0], xyz[1])
    z = xyz[2]
    at = np.zeros(z.shape[1])
    level = np.full(z.shape[1], -height)
    above = np.full(z.shape, np.nan)
    for h in reversed(range(len(z))):
        way = far[h] - at
        is_ground = np.abs(z[h] - level) <= 0.1 + 0.1 * np.maximum(way, 0)
        above[h] = np.where(returned[h] & ~is_ground, z[h] - level, np.nan)
        update = returned[h] & is_ground & (way >= 0.5)
        at = np.where(update, far[h], at)
        level = np.where(update, z[h], level)
    return above


def _walls(s: Returns) -> tuple[ndarray, ndarray, ndarray]:
    """Indices of wall returns, and rms and direction of the straightest segment through each."""
    kept = np.flatnonzero((s.above >= 0.5) & (s.far <= 30))
    z = s.z[kept]
    row = s.row[kept]
    after = _after(row)
    joined = np.abs(z[after] - z) < 1
    end = np.full(len(z), -1)  # of the segment from each return
    first = np.flatnonzero(joined)
    last = after[first]
    while len(first):
        full = np.abs(z[last] - z[first]) >= _WALL_LENGTH
        end[first[full]] = last[full]
        on = ~full & joined[last] & (after[last] != first)
        first = first[on]
        last = after[last[on]]
    first = np.flatnonzero(end >= 0)
    last = end[first]
    # Sums of 1, z, z^2 and |z|^2 over a segment have its scatter: z^2 = x^2 - y^2 + 2 i x y.
    sums = np.cumsum([np.ones_like(z), z, z * z, np.abs(z) ** 2], axis=1)
    sums = np.pad(sums, ((0, 0), (1, 0)))
    ring_start = np.searchsorted(row, row[first])
    ring_end = np.searchsorted(row, row[first], "right")
    ring = np.where(last < first, sums[:, ring_end] - sums[:, ring_start], 0)
    n, total, squares, sizes = sums[:, last + 1] - sums[:, first] + ring
    along = squares - total**2 / n
    across = (sizes - np.abs(total) ** 2 / n).real - np.abs(along)  # twice the smaller eigenvalue
    rms = np.sqrt(np.maximum(across / 2, 0) / (n.real - 2))
    # Number of the straightest segment of each return; all segments are walked in parallel.
    order = np.argsort(rms)
    segment = np.arange(len(order))
    best = np.full(len(z), len(order))
    at = first[order]
    while len(at):
        best[at] = np.minimum(best[at], segment)
        on = at != last[order[segment]]
        at = after[at[on]]
        segment = segment[on]
    wall = np.flatnonzero(best < len(order))
    straightest = order[best[wall]]
    return kept[wall], rms[straightest], np.angle(along[straightest]) / 2


def poles(s: Returns) -> ndarray:
    """Horizontal positions, (P, 2)."""
    # Ends of runs of near returns, and the starts of the next runs; a closed ring has none.
    last = np.flatnonzero(~_near(s, s.after, _POLE_WIDTH))
    first = s.after[last]
    gap = (s.column[first] - s.column[last]) % s.sensor.columns
    aside = gap * np.minimum(s.bins[first], s.bins[last]) >= _POLE_CLEARANCE
    free_after = aside | (s.far[first] > s.far[last] + _POLE_CLEARANCE)
    thin = aside | (s.far[last] > s.far[first] + _POLE_CLEARANCE)
    following = _after(s.row[last])
    last = last[following]
    thin &= s.stands[first] & free_after[following] & (s.far[first] <= _REACH)
    thin &= np.abs(s.z[last] - s.z[first]) < _POLE_WIDTH
    first = first[thin]
    last = last[thin]
    ends = s.p[[first, last], :2]
    row = s.row[first]
    pairs = cKDTree(ends.mean(0)).query_pairs(_POLE_WIDTH, output_type="ndarray")
    a, b = pairs[np.abs(np.diff(row[pairs])[:, 0]) <= 2].T
    label = _components(len(row), a, b)
    near, _ = _extremes(label, s.far[first])
    highest, lowest = _extremes(label, row)
    corner, opposite = _extremes(np.append(label, label), ends.reshape(-1, 2))
    edges = np.tan(np.deg2rad(s.sensor.row_edges))
    tall = near * (edges[highest.astype(int)] - edges[lowest.astype(int) + 1])
    slim = np.linalg.norm(opposite - corner, axis=1) < 0.6
    return ((corner + opposite) / 2)[slim & (tall >= 1)]


def cars(s: Returns) -> ndarray:
    """Horizontal centre, length and width of the visible part, and height, (C, 5)."""
    down = np.lexsort((s.row, s.column))
    below = np.empty_like(down)  # the next return in each column, or itself
    below[down] = np.append(down[1:], down[-1:])
    below = np.where(s.column[below] == s.column, below, np.arange(len(below)))
    along = _near(s, s.after, 0.7 + s.bins)
    across = _near(s, below, 0.7 + s.bins)
    a = np.append(np.flatnonzero(along), np.flatnonzero(across))
    label = _components(len(s.p), a, np.append(s.after[along], below[across]))
    foot, top = _extremes(label, s.above)
    least, _ = _extremes(label, np.column_stack([s.far, s.row, s.bins]))
    near, row, column = least.T
    held = (near <= _REACH) & (foot < 0.5) & (top >= 1) & (top <= 2.2)
    elevation = np.array(s.sensor.elevations)[row.astype(int)]
    held &= elevation <= s.sensor.row_edges[0] - 1.5
    at = np.flatnonzero(s.stands & held[label])
    number, label, count = np.unique(label[at], return_inverse=True, return_counts=True)
    turned = s.z[at, None] * np.exp(-1j * _TURNS)
    sides = np.stack([turned.real, turned.imag], 1)
    low, high = _extremes(label, sides)  # (C, 2, turns) each
    face = np.where(np.abs(low) < np.abs(high), low, high)  # the two sides towards the sensor
    distance = np.abs(sides - face[label]).min(1)
    mean = np.zeros((len(number), len(_TURNS)))
    np.add.at(mean, label, distance / count[label, None])
    turn = mean.argmin(1)
    on_face = distance[np.arange(len(at)), turn[label]] <= 0.3
    each = np.arange(len(number))
    low = low[each, :, turn]
    high = high[each, :, turn]
    width, length = np.sort(high - low, 1).T
    middle = (low + high) @ [0.5, 0.5j] * np.exp(1j * _TURNS[turn])
    columns = np.unique(label * s.sensor.columns + s.column[at]) // s.sensor.columns
    seen = np.bincount(columns, minlength=len(number)) * column[number]
    fits = (seen >= 1.2) & (length <= 5.5) & (width <= 2.4)
    fits &= np.bincount(label, on_face, len(number)) >= count / 2
    return np.column_stack([middle.real, middle.imag, length, width, top[number]])[fits]


def _near(s: Returns, other: ndarray, limit: float | ndarray) -> ndarray:
    """Whether each return and another one are above the ground and less than a limit apart."""
    return s.stands & s.stands[other] & (np.linalg.norm(s.p[other] - s.p, axis=1) < limit)


def _after(row: ndarray) -> ndarray:
    """Index of the next return on the ring of each return, (N,); the last wraps to the first."""
    after = np.arange(1, len(row) + 1)
    last = np.searchsorted(row, row, "right")
    return np.where(after < last, after, np.searchsorted(row, row))


def _components(count: int, a: ndarray, b: ndarray) -> ndarray:
    """Component index of each of `count` nodes, for edges from a to b, (E,) each."""
    graph = coo_array((np.ones(len(a), bool), (a, b)), (count, count))
    return connected_components(graph, directed=False)[1]


def _extremes(label: ndarray, values: ndarray) -> ndarray:
    """Minimum and maximum of values (N, ...) per label 0, 1, ..., (2, labels, ...)."""
    least, most = np.full((2, label.max(initial=-1) + 1, *values.shape[1:]), np.inf)
    np.fmin.at(least, label, values)
    np.fmin.at(most, label, -values)
    return np.stack([least, -most])
