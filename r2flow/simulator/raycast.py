"""Ray casting: the first intersection of each ray of a scan with a scene.

Solids give fragments (pixel, distance), of which each pixel keeps the nearest. Normals, materials
and details such as windows are computed for the nearest fragments only.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from r2flow.simulator.draws import cosine, rotate, scramble, sine
from r2flow.simulator.lasers import Rays
from r2flow.simulator.materials import ALBEDO, INDEX
from r2flow.simulator.scene import BODY, CABIN, FACADE, Scene, Surface
from r2flow.simulator.shapes import Fragments, Normal, Shape, take

_STOREY = 2.9  # metres
_BAY = 1.6  # metres: width of the recessed or projecting parts of a wall
_DRIFT = 0.03  # of half a bin: shift of the firings from one bin to the next


class Hits(NamedTuple):
    """First intersection of each ray; (B, W) each. Rays without intersection have distance inf and
    label 0.
    """

    distance: ndarray  # horizontal distance s from the sensor's axis in metres
    cosine: ndarray  # cosine of the angle between ray and surface normal
    label: ndarray  # SemanticKITTI id
    material: ndarray  # index into `materials.MATERIALS`
    albedo: ndarray  # reflectance at perpendicular incidence


def cast(scene: Scene, rays: Rays, rng: Generator) -> Hits:
    """The nearest intersection of every ray; `rng` draws which pass through leaves and slats."""
    hits = _on_ground(scene, rays)
    visible = [_visible(*table, rays, hits.distance, rng) for table in scene.tables]
    for fragments in visible:
        np.minimum.at(hits.distance, fragments.pixel, fragments.distance)
    # All nearest fragments are found before any is written, since writing moves some slightly
    # behind their surface.
    nearest = [
        take(fragments, fragments.distance == hits.distance[fragments.pixel])
        for fragments in visible
    ]
    for fragments, table in zip(nearest, scene.tables, strict=True):
        _on_solid(hits, rays, *table, fragments)
    return Hits(*(q.reshape(rays.shape) for q in hits))


def _on_ground(scene: Scene, rays: Rays) -> Hits:
    """Hits on the ground without solids, (B W,) each."""
    distance, cosine = scene.ground.meet(rays)
    met = np.isfinite(distance)
    s = np.where(met, distance, 0)
    label, material, albedo = scene.ground.surface(s * rays.cos, s * rays.sin)
    return Hits(*(q.ravel() for q in (distance, cosine, label * met, material, albedo)))


def _visible(
    shape: Shape, surface: Surface, rays: Rays, limit: ndarray, rng: Generator
) -> Fragments:
    """Fragments nearer than the ground, without rays that pass between slats."""
    fragments = shape.fragments(rays, rng)
    fragments = take(fragments, fragments.distance < limit[fragments.pixel])
    if (surface.closed == 1).all():
        return fragments
    # Slats are upright: a column passes or is stopped at all heights.
    lots = rng.random(1 << 16, dtype=np.float32)
    slat = (fragments.pixel % rays.columns + fragments.solid.astype(np.int64) * 7919) & 0xFFFF
    return take(fragments, lots[slat] < surface.closed[fragments.solid])


def _on_solid(
    hits: Hits, rays: Rays, shape: Shape, surfaces: Surface, fragments: Fragments
) -> None:
    """Write the nearest fragments of a table into the hits."""
    pixel, s, k = fragments
    b, w = np.divmod(pixel, rays.columns)
    cos = rays.cos[w]
    sin = rays.sin[w]
    slope = rays.slope[b]
    z = rays.height[b] + s * slope
    normal = shape.normal(k, s * cos, s * sin, z)
    along, across = rotate(normal.x, normal.y, cos, sin)
    ahead = along + normal.z * slope
    surface = take(surfaces, k)
    depth = _divide(surface, normal, z - surface.base)
    hits.cosine[pixel] = np.abs(ahead) / np.sqrt(1 + slope**2)
    hits.label[pixel] = surface.label
    hits.material[pixel] = surface.material
    hits.albedo[pixel] = surface.albedo
    moved = s + depth / np.maximum(np.abs(ahead), 0.5)
    if not rays.lasers.straight:
        firing = (rays.lasers.phase[b] + _DRIFT * w) % 1
        moved = moved * _between_columns(firing, np.pi / rays.columns, normal.flat, ahead, across)
    hits.distance[pixel] = moved


def _divide(surface: Surface, normal: Normal, rise: ndarray) -> ndarray:
    """Set material and albedo of windows in facades, panes in cabins and plates on cars.

    Returns the depth of walls behind the plane of their front, in metres, (N,): bays, doors, a
    plinth.
    """
    upright = np.abs(normal.z) < 0.9
    pane = (surface.pattern == CABIN) & upright & (rise > 0.94) & (rise < 1.38)
    pane &= np.mod(normal.along + 9.0, 1.0) > 0.1  # pillars
    plate = (surface.pattern == BODY) & normal.end & (rise > 0.42) & (rise < 0.54)
    plate &= np.abs(normal.along) < 0.26
    facade = surface.pattern == FACADE
    key = (surface.albedo * 9973).astype(np.int64)  # an integer per house, from its random albedo
    storey = np.floor(rise / _STOREY)
    share = _share(np.floor(normal.along / _BAY), storey, key)
    depth = np.where(share < 0.25, 0.30, 0.04 * share) - 0.06 * (rise < 0.5)
    depth = np.where(facade & normal.flat, depth, 0).astype(np.float32)
    # A row of windows per storey, with a random spacing per house and random gaps.
    place = normal.along / (2.0 + 2.4 * (key % 101) / 101)
    up = rise - storey * _STOREY
    window = facade & upright & (_share(np.floor(place), storey, key) < 0.6)
    window &= np.abs(place - np.floor(place) - 0.5) < 0.10 + 0.12 * (key % 37) / 37
    window &= (up > 0.95) & (up < 2.15) & (rise > 0)
    for name, where in (("glass", window), ("pane", pane), ("retro", plate)):
        surface.material[where] = INDEX[name]
        surface.albedo[where] = ALBEDO[INDEX[name]]
    return depth


def _share(column: ndarray, storey: ndarray, key: ndarray) -> ndarray:
    """A random number in [0, 1) for each piece of a wall."""
    return ((scramble(column, storey, key) >> 16) & 1023).astype(np.float32) / 1024


def _between_columns(
    firing: ndarray, turn: float, flat: ndarray, ahead: ndarray, across: ndarray
) -> ndarray:
    """Factors of s for lasers that do not fire at the centre of the bin, (N,).

    A plane n . p = const at distance s along d is at distance s (n . d) / (n . d') along d'. Each
    laser fires about twice per bin, at the share `firing` of half a bin of `turn` radians before or
    behind its centre; the nearer return is kept. `ahead` is n . d, `across` d(n . d) / da.
    """
    turns = np.where(across * ahead > 0, firing, firing - 1) * turn
    other = ahead * cosine(turns) + across * sine(turns)
    factor = np.divide(ahead, other, out=np.ones_like(ahead), where=np.abs(other) >= 1e-3)
    return np.where(flat, np.clip(factor, 0.93, 1.0), 1).astype(np.float32)
