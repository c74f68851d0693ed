"""Shapes: tables of solids, and their intersections with rays.

`fragments` returns the intersections of rays and solids, `normal` the surface normals there.
Coordinates are in metres in the scene's frame: x ahead and y left of the sensor's axis, z up. The
length of a solid is along (cos yaw, sin yaw).
"""

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from r2flow.simulator.draws import cosine, exponential_quantiles, hypotenuse, rotate, scramble, sine
from r2flow.simulator.lasers import Arrays, Rays, column_windows, row_windows

# A field of all solids of a table, (P,) float32; a number for a single solid.
_Column = Any

_NEAR = 0.05  # metres: minimum distance of intersections
_LEAF = 3  # columns over which leaves pass all pulses or none
_EDGE = 1e-6  # radians: margin of windows around objects, against rounding in arctan and arcsin


class Fragments(NamedTuple):
    """Intersections of rays and solids: pixel b W + w, horizontal distance s in metres, solid k;
    (F,) each.
    """

    pixel: ndarray
    distance: ndarray
    solid: ndarray


class Normal(NamedTuple):
    """The outward unit normals of surfaces at intersections; every field (N,)."""

    x: ndarray
    y: ndarray
    z: ndarray
    along: _Column = 0.0  # metres along the face from its centre; 0 without faces
    end: _Column = False  # whether the face is the front or back of a box
    flat: _Column = False  # whether the surface is a plane


class Frusta(
    namedtuple("Frusta", "x y yaw length width bottom top front back sides", defaults=(0, 0, 0))
):
    """Boxes whose sides lean inwards by metres (>= 0) per metre of height; every field a column."""

    def _leans(self) -> ndarray:
        """Lean of the sides ahead, behind, left and right, (4, P)."""
        return np.stack([self.front, self.back, self.sides, self.sides])

    def fragments(self, rays: Rays, rng: Generator) -> Fragments:
        """Each ray in a solid's bounding box is clipped by the solid's leaning sides, top and
        bottom.

        A side is the half-space a u + b v + lean (z - bottom) <= reach, (a, b) its normal seen from
        above.
        """
        solids = row_windows(rays, _box_spans(self, rays), self.bottom, self.top)
        pixel, slope, height, k, _, near, far, u, v, du, dv = solids
        rise = height - self.bottom[k]
        lean = self._leans()[:, k]
        direction = _outwards(du, dv) + lean * slope
        room = _reach(self)[:, k] - _outwards(u, v) - lean * rise
        below = self.top[k] - self.bottom[k] - rise
        near, far = _clip(near, far, [*direction, slope, -slope], [*room, below, rise])
        return take(Fragments(pixel, near, k), near < far)

    def normal(self, k: ndarray, x: ndarray, y: ndarray, z: ndarray) -> Normal:
        u, v, c, s = _into(self, k, x, y)
        lean = self._leans()[:, k]
        outside = _outwards(u, v) + lean * (z - self.bottom[k]) - _reach(self)[:, k]
        face = np.stack([*outside, z - self.top[k], self.bottom[k] - z]).argmax(0)
        up = np.ones(len(k), np.float32)
        lean = np.choose(face, [*lean, up, -up])
        nu, nv = _SIDES[:, face]
        norm = np.sqrt(nu * nu + nv * nv + lean**2)
        nx, ny = rotate(nu / norm, nv / norm, c, -s)
        return Normal(nx, ny, lean / norm, np.where(face < 2, v, u), face < 2, face < 4)


class Boxes(Frusta):
    """Upright boxes: without leans; every field a column."""

    def fragments(self, rays: Rays, rng: Generator) -> Fragments:
        return _upright(self, rays, _box_spans(self, rays))


class Cylinders(namedtuple("Cylinders", "x y radius bottom top")):
    """Upright cylinders; every field a column."""

    def fragments(self, rays: Rays, rng: Generator) -> Fragments:
        return _upright(self, rays, _chords(self, rays))

    def normal(self, k: ndarray, x: ndarray, y: ndarray, z: ndarray) -> Normal:
        at = take(self, k)
        u = x - at.x
        v = y - at.y
        away = hypotenuse(u, v)
        over = z - at.top
        under = at.bottom - z
        on_lid = np.maximum(over, under) > away - at.radius
        side = np.where(on_lid, 0, 1 / np.maximum(away, 1e-6))
        return Normal(u * side, v * side, np.where(on_lid, np.sign(over - under), 0))


class Blobs(namedtuple("Blobs", "x y z radius height path")):
    """Upright ellipsoids of revolution; every field a column.

    `path` is the mean free path of a pulse inside, in metres; 0 is solid. A pulse returns from a
    depth drawn from Exp(path), or passes if it leaves the ellipsoid before, as through a tree.
    """

    def fragments(self, rays: Rays, rng: Generator) -> Fragments:
        """Roots of |p(s) - c|^2 = 1 in units of the semi-axes; the near root moves inwards by the
        free path.
        """
        solids = row_windows(rays, _chords(self, rays), self.z - self.height, self.z + self.height)
        pixel, slope, height, k, _, _, _, middle, half = solids
        at = take(self, k)
        level = 1 / at.radius**2  # (s - middle)^2 level + (z + s T - c)^2 upright = half^2 level
        upright = 1 / at.height**2
        rise = height - at.z
        a = level + slope**2 * upright
        h = middle * level - slope * rise * upright
        d = h * h - a * ((middle**2 - half**2) * level + rise**2 * upright)
        root = np.sqrt(np.maximum(d, 0))
        surface = (h - root) / a
        distance = surface + at.path * _depths(k, *np.divmod(pixel, rays.columns), rng) / np.sqrt(
            1 + slope**2
        )
        inside = (at.path == 0) | (distance < (h + root) / a)
        hit = (d > 0) & (surface > _NEAR) & inside
        return take(Fragments(pixel, distance, k), hit)

    def normal(self, k: ndarray, x: ndarray, y: ndarray, z: ndarray) -> Normal:
        at = take(self, k)
        u = (x - at.x) / at.radius**2
        v = (y - at.y) / at.radius**2
        t = (z - at.z) / at.height**2
        norm = 1 / np.maximum(np.sqrt(u * u + v * v + t * t), 1e-6)
        return Normal(u * norm, v * norm, t * norm)


Shape = Boxes | Frusta | Cylinders | Blobs
"""A table of solids of one kind."""


def take(table: Any, rows: ndarray) -> Any:
    """The rows of a NamedTuple of columns, by their indices or a mask."""
    return table._make(column[rows] for column in table)


# (a, b) of the sides ahead, behind, left and right, and of top and bottom, (2, 6).
_SIDES = np.array([[1, -1, 0, 0, 0, 0], [0, 0, 1, -1, 0, 0]], np.float32)


def _outwards(u: ndarray, v: ndarray) -> ndarray:
    """a u + b v for the sides ahead, behind, left and right, (4, N)."""
    return np.stack([u, -u, v, -v])


def _reach(solids: Frusta) -> ndarray:
    """Distance of the sides ahead, behind, left and right from the middle, (4, P)."""
    return np.stack([solids.length, solids.length, solids.width, solids.width]) / 2


def _depths(k: ndarray, b: ndarray, w: ndarray, rng: Generator) -> ndarray:
    """Draws from Exp(1), one per solid and _LEAF neighbouring columns of a laser, as leaves are
    clustered.
    """
    cell = (w + b * 7) // _LEAF
    quantiles = exponential_quantiles()
    return quantiles[(scramble(k, cell, b, int(rng.integers(1 << 31))) >> 8) % len(quantiles)]


def _into(solids: Frusta, k: ndarray, x: _Column, y: _Column) -> Arrays:
    """Points in the frames of the solids, and cos and sin of their yaw: (u, v, c, s), (N,) each."""
    c = cosine(solids.yaw)[k]
    s = sine(solids.yaw)[k]
    return *rotate(x - solids.x[k], y - solids.y[k], c, s), c, s


def _box_spans(solids: Frusta, rays: Rays) -> Arrays:
    """Columns w in footprints of solids k: k, w, near < far in metres; origin and direction in the
    solid's frame.
    """
    k, w = _crossed(solids, hypotenuse(solids.length, solids.width) / 2, rays)
    u, v, c, s = _into(solids, k, 0.0, 0.0)
    du, dv = rotate(rays.cos[w], rays.sin[w], c, s)
    direction = np.stack([du, dv])
    direction[np.abs(direction) < 1e-7] = 1e-7
    near, far = _clip(_NEAR, np.inf, _outwards(*direction), _reach(solids)[:, k] - _outwards(u, v))
    met = near < far
    return tuple(q[met] for q in (k, w, near, far, u, v, du, dv))


def _crossed(solids: Shape, radius: ndarray, rays: Rays) -> tuple[ndarray, ndarray]:
    """Pairs of a solid k and a column w that may cross the circle of a radius around the solid."""
    distance = hypotenuse(solids.x, solids.y)
    angle = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-6), 1))
    angle = np.where(distance <= radius, np.pi, angle).astype(np.float64)
    azimuth = np.arctan2(solids.y, solids.x).astype(np.float64)
    return column_windows(azimuth, angle + _EDGE, rays.columns)


def _chords(solids: Cylinders | Blobs, rays: Rays) -> Arrays:
    """Chords ahead in circular footprints: k, w, near, far, midpoint and half length."""
    k, w = _crossed(solids, solids.radius, rays)
    middle, across = rotate(solids.x[k], solids.y[k], rays.cos[w], rays.sin[w])
    square = solids.radius[k] ** 2 - across**2
    half = np.sqrt(np.maximum(square, 0))
    far = middle + half
    met = (square > 0) & (far > _NEAR)
    return tuple(q[met] for q in (k, w, np.maximum(middle - half, _NEAR), far, middle, half))


def _upright(solids: Boxes | Cylinders, rays: Rays, spans: Arrays) -> Fragments:
    """First intersection of rays with upright solids in spans, including both lids."""
    rows = row_windows(rays, spans, solids.bottom, solids.top)
    pixel, slope, height, k, _, near, far, *_ = rows
    bottom = solids.bottom[k]
    top = solids.top[k]
    z = height + near * slope
    with np.errstate(divide="ignore", invalid="ignore"):
        # Distance at which a ray above or below the wall reaches the lid.
        over = (np.where(z > top, top, bottom) - height) / slope
    on_wall = (z <= top) & (z >= bottom)
    hit = on_wall | ((over > near) & (over < far))
    return take(Fragments(pixel, np.where(on_wall, near, over), k), hit)


def _clip(near: _Column, far: _Column, direction: Any, room: Any) -> tuple[ndarray, ndarray]:
    """The part of [near, far] with direction_i s <= room_i for all i; near >= far for none."""
    direction = np.stack(direction)
    room = np.stack(room)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / direction
    near = np.maximum(near, np.where(direction < 0, at, -np.inf).max(0))
    far = np.minimum(far, np.where(direction > 0, at, np.inf).min(0))
    outside = ((direction == 0) & (room < 0)).any(0)
    return near, np.where(outside, -np.inf, far)
