"""Materials and their reflectance.

Reflectance is as a calibrated HDL-64E reports it: nearly constant for a rough wall from 3 to 20 metres.
"""

from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    name: str
    albedo: float  # mean reflectance at perpendicular incidence
    spread: float  # standard deviation of albedo between objects
    texture: float  # scale of the noise of reflectance between pixels; its standard deviation is 1.3 of it
    gloss: float  # g in the incidence falloff (1 + g) c / (c + g), c the cosine; a mirror has a large g
    swallow: float  # share of pulses that do not return, for any angle and distance
    depth: float  # mean depth, along the ground, in metres at which pulses return from inside (leaves, grass)


MATERIALS = (
    Material("asphalt", 0.26, 0.025, 0.035, 0.03, 0.001, 0.0),
    Material("paving", 0.345, 0.02, 0.035, 0.03, 0.001, 0.0),
    Material("marking", 0.46, 0.05, 0.08, 0.03, 0.0, 0.0),
    Material("grass", 0.385, 0.02, 0.045, 0.01, 0.002, 0.02),
    Material("plaster", 0.46, 0.10, 0.05, 0.08, 0.002, 0.0),
    Material("brick", 0.38, 0.08, 0.08, 0.08, 0.002, 0.0),
    Material("glass", 0.20, 0.05, 0.08, 2.0, 0.12, 0.12),
    Material("pane", 0.02, 0.03, 0.05, 2.0, 0.78, 0.10),
    Material("paint", 0.28, 0.20, 0.06, 0.7, 0.01, 0.0),
    Material("dark paint", 0.00, 0.03, 0.02, 0.5, 0.04, 0.0),
    Material("rubber", 0.04, 0.03, 0.03, 0.3, 0.04, 0.0),
    Material("plastic", 0.18, 0.12, 0.05, 0.3, 0.01, 0.0),
    Material("metal", 0.22, 0.14, 0.08, 0.3, 0.02, 0.0),
    Material("retro", 0.95, 0.04, 0.05, 0.02, 0.0, 0.0),
    Material("leaves", 0.41, 0.05, 0.08, 0.10, 0.003, 0.04),
    Material("bark", 0.38, 0.06, 0.08, 0.10, 0.005, 0.0),
    Material("wood", 0.38, 0.10, 0.08, 0.10, 0.005, 0.0),
    Material("concrete", 0.38, 0.06, 0.05, 0.05, 0.002, 0.0),
    Material("cloth", 0.30, 0.14, 0.08, 0.15, 0.01, 0.0),
    Material("skin", 0.35, 0.05, 0.08, 0.15, 0.01, 0.0),
)
INDEX = {material.name: k for k, material in enumerate(MATERIALS)}


def column(field: str) -> np.ndarray:
    """A property of all materials, (M,), float32."""
    return np.array([getattr(material, field) for material in MATERIALS], dtype=np.float32)
