"""Ray casting: the first intersection of each ray of a scan with a scene.

Solids give fragments (pixel, distance), of which each pixel keeps the nearest. Normals, materials and details such as
windows are computed for the nearest fragments only.
"""

from typing import NamedTuple

import numpy as np

from r2flow.simulator.draws import cosine, sine
from r2flow.simulator.lasers import Rays
from r2flow.simulator.materials import INDEX, column
from r2flow.simulator.scene import BODY, CABIN, FACADE, Scene, Surface
from r2flow.simulator.shapes import Fragments, Normal, Shape

ALBEDO = column("albedo")
STOREY = 2.9  # metres
BAY = 1.6  # metres: width of the recessed or projecting parts of a wall


def divided(surface: Surface, k: np.ndarray, normal: Normal, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Material and albedo at points of solids k: panes in facades and cabins, plates on cars; (N,) each."""
    material, albedo = surface.material[k], surface.albedo[k]
    pattern, rise = surface.pattern[k], z - surface.base[k]
    upright = np.abs(normal.z) < 0.9
    window = (pattern == FACADE) & upright & _window(rise, normal.along, albedo)
    pane = (pattern == CABIN) & upright & (rise > 0.94) & (rise < 1.38)
    pane &= np.mod(normal.along + 9.0, 1.0) > 0.1  # pillars
    plate = (pattern == BODY) & normal.end & (rise > 0.42) & (rise < 0.54) & (np.abs(normal.along) < 0.26)
    for name, where in (("glass", window), ("pane", pane), ("retro", plate)):
        material[where] = INDEX[name]
        albedo[where] = ALBEDO[INDEX[name]]
    return material, albedo


def _hash(a: np.ndarray, b: np.ndarray, key: np.ndarray) -> np.ndarray:
    """A number in [0, 1) from three integers."""
    mixed = a * 73856093 ^ b * 83492791 ^ key * 19349663
    mixed = mixed * 2654435761 & 0xFFFFFFFF
    return ((mixed >> 16) & 1023).astype(np.float32) / 1024


def _key(albedo: np.ndarray) -> np.ndarray:
    """An integer per house, from its random albedo."""
    return (albedo * 9973).astype(np.int64)


def _window(rise: np.ndarray, along: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Whether points are on a window: a row per storey, with a random spacing per house and random gaps."""
    key = _key(albedo)
    spacing = 2.0 + 2.4 * (key % 101) / 101
    column, storey = np.floor(along / spacing), np.floor(rise / STOREY)
    across, up = along / spacing - column, rise - storey * STOREY
    present = _hash(column.astype(np.int64), storey.astype(np.int64), key) < 0.6
    half = 0.10 + 0.12 * (key % 37) / 37
    return present & (np.abs(across - 0.5) < half) & (up > 0.95) & (up < 2.15) & (rise > 0)


def relief(surface: Surface, k: np.ndarray, normal: Normal, z: np.ndarray) -> np.ndarray:
    """Depth of walls behind the plane of their front, in metres, (N,): bays, doors, a plinth."""
    wall = (surface.pattern[k] == FACADE) & normal.flat
    rise = z - surface.base[k]
    piece, storey = np.floor(normal.along / BAY).astype(np.int64), np.floor(rise / STOREY).astype(np.int64)
    share = _hash(piece, storey, _key(surface.albedo[k]))
    back = np.where(share < 0.25, 0.30, 0.04 * share) - 0.06 * (rise < 0.5)
    return np.where(wall, back, 0).astype(np.float32)


DRIFT = 0.03  # of half a bin: shift of the firings from one bin to the next


class Hits(NamedTuple):
    """First intersection of each ray; (B, W) each. Rays without intersection have distance inf and label 0."""

    distance: np.ndarray  # horizontal distance s from the sensor's axis in metres
    cosine: np.ndarray  # cosine of the angle between ray and surface normal
    label: np.ndarray  # SemanticKITTI id
    material: np.ndarray  # index into `materials.MATERIALS`
    albedo: np.ndarray  # reflectance at perpendicular incidence


def cast(scene: Scene, rays: Rays, rng: np.random.Generator) -> Hits:
    """The nearest intersection of every ray; `rng` draws which rays pass through leaves and slats."""
    low, cosine = (q.ravel() for q in scene.ground.meet(rays))
    distance = low.copy()
    met = [_visible(shape, surface, rays, distance, rng) for shape, surface in scene.tables]
    for fragments in met:
        np.minimum.at(distance, fragments.pixel, fragments.distance)
    hits = _on_ground(scene, rays, low, cosine)._replace(distance=distance)
    # All nearest fragments are found before any is written, since writing moves some slightly behind their surface.
    won = [fragments.distance == distance[fragments.pixel] for fragments in met]
    for fragments, first, (shape, surface) in zip(met, won, scene.tables, strict=True):
        _on_solid(hits, rays, shape, surface, Fragments(*(q[first] for q in fragments)))
    return Hits(*(q.reshape(rays.shape) for q in hits))


def _visible(shape: Shape, surface: Surface, rays: Rays, limit: np.ndarray, rng: np.random.Generator) -> Fragments:
    """Fragments nearer than the ground, without rays that pass between slats."""
    fragments = shape.fragments(rays, rng)
    keep = fragments.distance < limit[fragments.pixel]
    fragments = Fragments(*(q[keep] for q in fragments))
    if (surface.closed == 1).all():
        return fragments
    # Slats are upright: a column passes or is stopped at all heights.
    lots = rng.random(1 << 16, dtype=np.float32)
    slat = (fragments.pixel % rays.columns + fragments.solid.astype(np.int64) * 7919) & 0xFFFF
    keep = lots[slat] < surface.closed[fragments.solid]
    return Fragments(*(q[keep] for q in fragments))


def _on_ground(scene: Scene, rays: Rays, distance: np.ndarray, cosine: np.ndarray) -> Hits:
    """Hits on the ground without solids, (B W,) each."""
    label, material, albedo = (np.zeros(distance.shape, kind) for kind in (np.uint16, np.uint8, np.float32))
    met = np.flatnonzero(np.isfinite(distance))
    w = met % rays.columns
    x, y = distance[met] * rays.cos[w], distance[met] * rays.sin[w]
    label[met], material[met], albedo[met] = scene.ground.surface(x, y)
    return Hits(distance, cosine, label, material, albedo)


def _on_solid(hits: Hits, rays: Rays, shape: Shape, surface: Surface, fragments: Fragments) -> None:
    """Write the nearest fragments of a table into the hits."""
    pixel, s, k = fragments
    b, w = pixel // rays.columns, pixel % rays.columns
    x, y, z = s * rays.cos[w], s * rays.sin[w], rays.height[b] + s * rays.slope[b]
    normal = shape.normal(k, x, y, z)
    ahead = normal.x * rays.cos[w] + normal.y * rays.sin[w] + normal.z * rays.slope[b]
    hits.cosine[pixel] = np.abs(ahead) / np.sqrt(1 + rays.slope[b] ** 2)
    hits.label[pixel] = surface.label[k]
    hits.material[pixel], hits.albedo[pixel] = divided(surface, k, normal, z)
    moved = s + relief(surface, k, normal, z) / np.maximum(np.abs(ahead), 0.5)
    if not rays.lasers.straight:
        moved = moved * _between_columns(rays, b, w, normal, ahead)
    hits.distance[pixel] = moved


def _between_columns(rays: Rays, b: np.ndarray, w: np.ndarray, normal: Normal, ahead: np.ndarray) -> np.ndarray:
    """Factors of s for lasers that do not fire at the centre of the bin, (N,).

    A plane n . p = const at distance s along d is at distance s (n . d) / (n . d') along d'. Each laser fires about
    twice per bin, which keeps the nearer return.
    """
    firing = (rays.lasers.phase[b] + DRIFT * w) % 1
    across = normal.y * rays.cos[w] - normal.x * rays.sin[w]  # d(n . d) / da
    turn = np.where(across * ahead > 0, firing, firing - 1) * (np.pi / rays.columns)
    other = ahead * cosine(turn) + across * sine(turn)
    factor = np.divide(ahead, other, out=np.ones_like(ahead), where=np.abs(other) >= 1e-3)
    return np.where(normal.flat, np.clip(factor, 0.93, 1.0), 1).astype(np.float32)
