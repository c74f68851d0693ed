"""Details of surfaces: windows, panes and number plates, and how deep parts of a wall stand back."""

import numpy as np

from r2flow.simulator.materials import INDEX, column
from r2flow.simulator.scene import BODY, CABIN, FACADE, Surface
from r2flow.simulator.shapes import Normal

ALBEDO = column("albedo")
STOREY = 2.9  # metres
BAY = 1.6  # metres: width of the parts of a wall that stand back or out


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
    """A number in [0, 1) from three whole numbers."""
    mixed = a * 73856093 ^ b * 83492791 ^ key * 19349663
    mixed = mixed * 2654435761 & 0xFFFFFFFF
    return ((mixed >> 16) & 1023).astype(np.float32) / 1024


def _key(albedo: np.ndarray) -> np.ndarray:
    """A whole number that differs from house to house, from the albedo, which is drawn anew for each."""
    return (albedo * 9973).astype(np.int64)


def _window(rise: np.ndarray, along: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Where windows are: a row in each storey, with a spacing that differs from house to house; some are left out."""
    key = _key(albedo)
    spacing = 2.0 + 2.4 * (key % 101) / 101
    column, storey = np.floor(along / spacing), np.floor(rise / STOREY)
    across, up = along / spacing - column, rise - storey * STOREY
    there = _hash(column.astype(np.int64), storey.astype(np.int64), key) < 0.6
    half = 0.10 + 0.12 * (key % 37) / 37
    return there & (np.abs(across - 0.5) < half) & (up > 0.95) & (up < 2.15) & (rise > 0)


def relief(surface: Surface, k: np.ndarray, normal: Normal, z: np.ndarray) -> np.ndarray:
    """How far walls stand back from the plane of their front, in metres, (N,): bays, doors, a plinth."""
    wall = (surface.pattern[k] == FACADE) & normal.flat
    rise = z - surface.base[k]
    piece, storey = np.floor(normal.along / BAY).astype(np.int64), np.floor(rise / STOREY).astype(np.int64)
    share = _hash(piece, storey, _key(surface.albedo[k]))
    back = np.where(share < 0.10, 0.18, 0.04 * share) - 0.06 * (rise < 0.5)
    return np.where(wall, back, 0).astype(np.float32)
