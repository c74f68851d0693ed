"""Scenes: the ground and tables of solids with their surfaces."""

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


class SceneBuilder:
    """Collects the solids of a scene."""

    def __init__(self, ground: Ground, draws: ScalarDraws) -> None:
        self.ground = ground
        self.draws = draws
        self._rows: dict[type, list[tuple[float, ...]]] = {shape: [] for shape in get_args(Shape)}

    def level(self, x: float, y: float) -> float:
        """Height of the ground at a position in metres, including the kerb."""
        return float(self.ground.height(x, y)) + self.ground.kerb * (self.ground.off_street(x, y) > 0)

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
        """The scene as tables."""
        return Scene(self.ground, tuple(_table(shape, rows) for shape, rows in self._rows.items() if rows), rig)


def _table(shape: type, rows: list[tuple[float, ...]]) -> tuple[Shape, Surface]:
    # Rounded to 1 / 16384, since the last bit of sines depends on the machine.
    columns = np.ascontiguousarray((np.rint(np.array(rows) * 16384) / 16384).astype(np.float32).T)
    *solid, label, material, albedo, closed, pattern, base = columns
    label, material, pattern = label.astype(np.uint16), material.astype(np.uint8), pattern.astype(np.uint8)
    return shape(*solid), Surface(label, material, albedo, closed, pattern, base)
