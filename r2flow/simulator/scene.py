"""Scenes: the ground and tables of solids with their surfaces."""

import math
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np

from r2flow.lidar.labels import LABELS
from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.ground import Ground
from r2flow.simulator.materials import INDEX, MATERIALS
from r2flow.simulator.shapes import Shape

PLAIN, FACADE, CABIN, BODY = range(4)  # patterns that divide a surface among materials


class Surface(NamedTuple):
    """The surfaces of solids; every field (P,)."""

    label: np.ndarray  # SemanticKITTI id
    material: np.ndarray  # index into `materials.MATERIALS`
    albedo: np.ndarray  # reflectance at perpendicular incidence
    closed: np.ndarray  # share of rays that the solid stops; less than 1 for slats
    pattern: np.ndarray  # PLAIN, FACADE (windows), CABIN (panes), BODY (number plates and lamps)
    base: np.ndarray  # height of the ground at the solid, the reference of patterns


@dataclass(frozen=True)
class Scene:
    """All surfaces of a scene, in metres; z = 0 is the default height of the ground below the sensor."""

    ground: Ground
    tables: tuple[tuple[Shape, Surface], ...] = ()  # solids of each shape with their surfaces
    rig: int | None = None  # index in `lasers.RIGS` of the ego vehicle, or None


class Footprint(NamedTuple):
    """The ground below an object: a rectangle with its length along (c, s)."""

    x: float
    y: float
    c: float
    s: float
    length: float
    width: float

    def separated(self, other: "Footprint") -> bool:
        """Whether a side of this rectangle separates it from another."""
        dx, dy = self.x - other.x, self.y - other.y
        cos, sin = abs(self.c * other.c + self.s * other.s), abs(self.c * other.s - self.s * other.c)
        return (
            2 * abs(dx * self.c + dy * self.s) >= self.length + other.length * cos + other.width * sin
            or 2 * abs(dy * self.c - dx * self.s) >= self.width + other.length * sin + other.width * cos
        )


class SceneBuilder:
    """Collects the solids of a scene."""

    def __init__(self, ground: Ground, draws: ScalarDraws) -> None:
        self.ground = ground
        self.draws = draws
        self._rows: dict[type, list[tuple[float, ...]]] = {shape: [] for shape in get_args(Shape)}
        self._taken: list[Footprint] = []

    def level(self, x: float, y: float) -> float:
        """Height of the ground at a position in metres, including the kerb."""
        return float(self.ground.height(x, y)) + self.ground.kerb * (self.ground.off_street(x, y) > 0)

    def take(self, x: float, y: float, yaw: float, length: float, width: float) -> bool:
        """Take a rectangle of ground for an object, unless another object has part of it."""
        place = Footprint(x, y, math.cos(yaw), math.sin(yaw), length, width)
        for other in self._taken:
            far = abs(x - other.x) + abs(y - other.y) >= length + width + other.length + other.width
            if not (far or place.separated(other) or other.separated(place)):
                return False
        self._taken.append(place)
        return True

    def post(self, x: float, y: float) -> bool:
        """Take the ground of something thin, unless it is another's or a carriageway."""
        return bool(self.ground.off_street(x, y) > 0) and self.take(x, y, 0.0, 0.4, 0.4)

    def albedo(self, material: str) -> float:
        """Draw the reflectance of an object of a material."""
        m = MATERIALS[INDEX[material]]
        return min(max(self.draws.normal(m.albedo, m.spread), 0.01), 0.99)

    def add(
        self,
        solid: Shape,
        label: str,
        material: str,
        albedo: float | None = None,
        closed: float = 1.0,
        pattern: int = PLAIN,
        base: float = 0.0,
    ) -> None:
        """Add a solid, whose fields are numbers, to the scene."""
        albedo = self.albedo(material) if albedo is None else albedo
        self._rows[type(solid)].append((*solid, LABELS[label], INDEX[material], albedo, closed, pattern, base))

    def build(self, rig: int | None = None) -> Scene:
        return Scene(self.ground, tuple(_table(shape, rows) for shape, rows in self._rows.items() if rows), rig)


def _table(shape: type, rows: list[tuple[float, ...]]) -> tuple[Shape, Surface]:
    # Rounded to 1 / 16384, since the last bit of sines depends on the machine.
    columns = np.ascontiguousarray((np.rint(np.array(rows) * 16384) / 16384).astype(np.float32).T)
    *solid, label, material, albedo, closed, pattern, base = columns
    label, material, pattern = label.astype(np.uint16), material.astype(np.uint8), pattern.astype(np.uint8)
    return shape(*solid), Surface(label, material, albedo, closed, pattern, base)
