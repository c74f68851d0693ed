"""Shapes: tables of solids, and their intersections with rays.

`fragments` returns the intersections of rays and solids, `normal` the surface normals there. Coordinates are in metres
in the scene's frame: x ahead and y left of the sensor's axis, z up. The length of a solid is along (cos yaw, sin yaw).
"""

from typing import Any, NamedTuple

import numpy as np

from r2flow.simulator.draws import cosine, exponential_quantiles, hypotenuse, sine
from r2flow.simulator.lasers import Rays, column_windows, row_windows

# A field of all solids of a table, (P,) float32; a number for a single solid.
Column = Any

NEAR = 0.05  # metres: minimum distance of intersections
LEAF = 3  # columns over which leaves pass all pulses or none
EDGE = 1e-6  # radians: margin of windows around objects, against rounding in arctan and arcsin


class Fragments(NamedTuple):
    """Intersections of rays and solids: pixel b W + w, horizontal distance s in metres, solid k; (F,) each."""

    pixel: np.ndarray
    distance: np.ndarray
    solid: np.ndarray


class Normal(NamedTuple):
    """The outward unit normals of surfaces at intersections; every field (N,)."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    along: np.ndarray  # metres along the face from its centre; 0 without faces
    end: np.ndarray  # whether the face is the front or back of a box
    flat: np.ndarray  # whether the surface is a plane


class Boxes(NamedTuple):
    """Upright boxes; every field a column."""

    x: Column
    y: Column
    yaw: Column
    length: Column
    width: Column
    bottom: Column
    top: Column

    def fragments(self, rays: Rays, rng: np.random.Generator) -> Fragments:
        return _upright(self, rays, *_box_spans(self, rays)[:4])

    def normal(self, k: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Normal:
        return Frusta(*self, *[np.zeros_like(self.x)] * 3).normal(k, x, y, z)  # upright


class Frusta(NamedTuple):
    """Boxes whose four sides lean inwards by metres (>= 0) per metre of height; every field a column."""

    x: Column
    y: Column
    yaw: Column
    length: Column
    width: Column
    bottom: Column
    top: Column
    front: Column
    back: Column
    sides: Column

    def _planes(self, k: np.ndarray) -> list[tuple[float, float, np.ndarray, np.ndarray]]:
        """(a, b, lean, reach) of the half-spaces a u + b v + lean (z - bottom) <= reach."""
        half_length, half_width = self.length[k] / 2, self.width[k] / 2
        return [
            (1.0, 0.0, self.front[k], half_length),
            (-1.0, 0.0, self.back[k], half_length),
            (0.0, 1.0, self.sides[k], half_width),
            (0.0, -1.0, self.sides[k], half_width),
        ]

    def fragments(self, rays: Rays, rng: np.random.Generator) -> Fragments:
        """Each ray in a solid's bounding box is clipped by the solid's leaning sides, top and bottom."""
        k, _, near, far, *_ = spans = _box_spans(self, rays)
        n, b = row_windows(rays, near, far, self.bottom[k], self.top[k])
        k, w, near, far, u, v, du, dv = (q[n] for q in spans)
        slope, rise = rays.slope[b], rays.height[b] - self.bottom[k]
        for a, bb, lean, reach in self._planes(k):
            near, far = _clip(near, far, a * du + bb * dv + lean * slope, reach - a * u - bb * v - lean * rise)
        near, far = _clip(near, far, slope, self.top[k] - self.bottom[k] - rise)
        near, far = _clip(near, far, -slope, rise)
        hit = near < far
        return Fragments((b * rays.columns + w)[hit], near[hit], k[hit])

    def normal(self, k: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Normal:
        u, v, c, s = _into(self, k, x, y)
        rise = z - self.bottom[k]
        planes = self._planes(k)
        outside = [a * u + b * v + lean * rise - reach for a, b, lean, reach in planes]
        face = np.stack([*outside, z - self.top[k], self.bottom[k] - z]).argmax(0)
        nu, nv, nz = (np.zeros(len(k), np.float32) for _ in range(3))
        for index, (a, b, lean, _) in enumerate(planes):
            on = face == index
            norm = np.sqrt(1 + lean[on] ** 2)
            nu[on], nv[on], nz[on] = a / norm, b / norm, lean[on] / norm
        nz[face == 4], nz[face == 5] = 1, -1
        return Normal(nu * c - nv * s, nu * s + nv * c, nz, np.where(face < 2, v, u), face < 2, face < 4)


class Cylinders(NamedTuple):
    """Upright cylinders; every field a column."""

    x: Column
    y: Column
    radius: Column
    bottom: Column
    top: Column

    def fragments(self, rays: Rays, rng: np.random.Generator) -> Fragments:
        k, w, middle, half = _chords(self, rays)
        return _upright(self, rays, k, w, np.maximum(middle - half, NEAR), middle + half)

    def normal(self, k: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Normal:
        u, v = x - self.x[k], y - self.y[k]
        away = hypotenuse(u, v)
        over, under = z - self.top[k], self.bottom[k] - z
        on_lid = np.maximum(over, under) > away - self.radius[k]
        side = np.where(on_lid, 0, 1 / np.maximum(away, 1e-6))
        return _round(u * side, v * side, np.where(on_lid, np.sign(over - under), 0))


class Blobs(NamedTuple):
    """Upright ellipsoids of revolution; every field a column.

    `path` is the mean free path of a pulse inside, in metres; 0 is solid. A pulse returns from a depth drawn from
    Exp(path), or passes if it leaves the ellipsoid before, as through a tree.
    """

    x: Column
    y: Column
    z: Column
    radius: Column
    height: Column
    path: Column

    def fragments(self, rays: Rays, rng: np.random.Generator) -> Fragments:
        """Roots of |p(s) - c|^2 = 1 in units of the semi-axes; the near root moves inwards by the free path."""
        k, w, middle, half = _chords(self, rays)
        near = np.maximum(middle - half, NEAR)
        n, b = row_windows(rays, near, middle + half, self.z[k] - self.height[k], self.z[k] + self.height[k])
        k, w, middle, half = k[n], w[n], middle[n], half[n]
        level = (1 / self.radius**2)[k]  # (s - middle)^2 level + (z + s T - c)^2 upright = half^2 level
        upright = (1 / self.height**2)[k]
        slope, rise = rays.slope[b], rays.height[b] - self.z[k]
        a = level + slope**2 * upright
        h = middle * level - slope * rise * upright
        d = h * h - a * ((middle**2 - half**2) * level + rise**2 * upright)
        root = np.sqrt(np.maximum(d, 0))
        distance = (h - root) / a
        path, ahead = self.path[k], distance > NEAR
        distance += path * _depths(k, b, w, rng) / np.sqrt(1 + slope**2)
        hit = (d > 0) & ahead & ((path == 0) | (distance < (h + root) / a))
        return Fragments((b * rays.columns + w)[hit], distance[hit], k[hit])

    def normal(self, k: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Normal:
        u, v = (x - self.x[k]) / self.radius[k] ** 2, (y - self.y[k]) / self.radius[k] ** 2
        t = (z - self.z[k]) / self.height[k] ** 2
        norm = 1 / np.maximum(np.sqrt(u * u + v * v + t * t), 1e-6)
        return _round(u * norm, v * norm, t * norm)


Shape = Boxes | Frusta | Cylinders | Blobs
"""A table of solids of one kind."""


def _depths(k: np.ndarray, b: np.ndarray, w: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws from Exp(1), one per solid and LEAF neighbouring columns of a laser, as leaves are clustered."""
    cell = (w + b * 7) // LEAF
    mixed = k * np.int64(73856093) ^ b * np.int64(19349663) ^ cell * np.int64(83492791)
    mixed = (mixed + int(rng.integers(1 << 31))) * 2654435761 & 0xFFFFFFFF
    quantiles = exponential_quantiles()
    return quantiles[(mixed >> 8) % len(quantiles)]


def _round(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Normal:
    """Normals of a surface without faces."""
    return Normal(x, y, z, np.zeros_like(x), np.zeros(len(x), bool), np.zeros(len(x), bool))


def _into(solids: "Boxes | Frusta", k: np.ndarray, x: Column, y: Column) -> tuple[np.ndarray, ...]:
    """Points in the frames of the solids, and cos and sin of their yaw: (u, v, c, s), (N,) each."""
    c, s = cosine(solids.yaw)[k], sine(solids.yaw)[k]
    dx, dy = x - solids.x[k], y - solids.y[k]
    return dx * c + dy * s, dy * c - dx * s, c, s


def _box_spans(solids: "Boxes | Frusta", rays: Rays) -> tuple[np.ndarray, ...]:
    """Columns w in footprints of solids k: k, w, near < far in metres; origin and direction in the solid's frame."""
    k, w = _crossed(solids, hypotenuse(solids.length, solids.width) / 2, rays)
    u, v, c, s = _into(solids, k, np.float32(0), np.float32(0))
    a, b = solids.length[k] / 2, solids.width[k] / 2
    du, dv = rays.cos[w] * c + rays.sin[w] * s, rays.sin[w] * c - rays.cos[w] * s
    near, far = np.full(len(k), NEAR, np.float32), np.full(len(k), np.inf, np.float32)
    for position, direction, reach in ((u, du, a), (v, dv, b)):
        direction = np.where(np.abs(direction) < 1e-7, np.float32(1e-7), direction)
        low, high = (-reach - position) / direction, (reach - position) / direction
        near, far = np.maximum(near, np.minimum(low, high)), np.minimum(far, np.maximum(low, high))
    met = near < far
    return tuple(q[met] for q in (k, w, near, far, u, v, du, dv))


def _crossed(solids: Shape, radius: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a solid k and a column w that may cross the circle of a radius around the solid."""
    x, y, distance = solids.x, solids.y, hypotenuse(solids.x, solids.y)
    angle = np.where(distance <= radius, np.pi, np.arcsin(np.minimum(radius / np.maximum(distance, 1e-6), 1)))
    return column_windows(np.arctan2(y, x).astype(np.float64), angle.astype(np.float64) + EDGE, rays.columns)


def _chords(solids: "Cylinders | Blobs", rays: Rays) -> tuple[np.ndarray, ...]:
    """Chords ahead in the circular footprints of solids: solid k, column w, midpoint and half length."""
    x, y, radius = solids.x, solids.y, solids.radius
    k, w = _crossed(solids, radius, rays)
    middle = x[k] * rays.cos[w] + y[k] * rays.sin[w]
    across = y[k] * rays.cos[w] - x[k] * rays.sin[w]
    square = radius[k] ** 2 - across**2
    half = np.sqrt(np.maximum(square, 0))
    met = (square > 0) & (middle + half > NEAR)
    return k[met], w[met], middle[met], half[met]


def _upright(
    solids: "Boxes | Cylinders", rays: Rays, k: np.ndarray, w: np.ndarray, near: np.ndarray, far: np.ndarray
) -> Fragments:
    """First intersection of columns w with upright solids k between near and far, including both lids."""
    n, b = row_windows(rays, near, far, solids.bottom[k], solids.top[k])
    k, w, near, far = (q[n] for q in (k, w, near, far))
    bottom, top, slope, height = solids.bottom[k], solids.top[k], rays.slope[b], rays.height[b]
    z = height + near * slope
    lid = np.where(z > top, top, bottom)
    with np.errstate(divide="ignore", invalid="ignore"):
        over = (lid - height) / slope  # distance at which a ray above or below the wall reaches the lid
    on_wall = (z <= top) & (z >= bottom)
    distance = np.where(on_wall, near, over)
    hit = on_wall | ((over > near) & (over < far))
    return Fragments((b * rays.columns + w)[hit], distance[hit], k[hit])


def _clip(near: np.ndarray, far: np.ndarray, direction: np.ndarray, room: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of [near, far] with direction s <= room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = room / direction
    near = np.where(direction < 0, np.maximum(near, at), near)
    far = np.where(direction > 0, np.minimum(far, at), far)
    return near, np.where((direction == 0) & (room < 0), -np.inf, far)
