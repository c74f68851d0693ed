"""Scenes: the ground and tables of solids with their surfaces."""

from typing import Any, NamedTuple, get_args

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from r2flow.lidar.labels import LABELS
from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.ground import Ground
from r2flow.simulator.materials import INDEX, MATERIALS
from r2flow.simulator.shapes import Blobs, Boxes, Cylinders, Frusta, Shape
from r2flow.simulator.streets import Footprint, Pose

PLAIN, FACADE, CABIN, BODY = range(4)  # patterns that divide a surface among materials


class Surface(NamedTuple):
    """The surfaces of solids; every field (P,)."""

    label: ndarray  # SemanticKITTI id
    material: ndarray  # index into `materials.MATERIALS`
    albedo: ndarray  # reflectance at perpendicular incidence
    closed: ndarray  # share of rays that the solid stops; less than 1 for slats
    pattern: ndarray  # PLAIN, FACADE (windows), CABIN (panes), BODY (number plates and lamps)
    base: ndarray  # height of the ground at the solid, the reference of patterns


class Scene(NamedTuple):
    """All surfaces of a scene, in metres; z = 0 is the default height of the ground below the
    sensor.
    """

    ground: Ground
    tables: tuple[tuple[Shape, Surface], ...] = ()  # solids of each shape with their surfaces
    rig: int | None = None  # index in `lasers.RIGS` of the ego vehicle, or None


class Site(NamedTuple):
    """The frame of an object, x ahead, y to the left, z up from the ground, in which solids are
    added to a scene.

    After its shape, a solid has a label, a material and the options of `SceneBuilder.add`.
    """

    builder: "SceneBuilder"
    pose: Pose
    ground: float  # height of the ground at the object in metres

    def box(
        self,
        x: float,
        y: float,
        length: float,
        width: float,
        bottom: float,
        top: float,
        *surface: Any,
        leans: tuple[float, ...] = (),
        **options: Any,
    ) -> None:
        """Add a box; with leans of its front, back and sides, a frustum."""
        shape = Frusta if leans else Boxes
        size = length, width, self.ground + bottom, self.ground + top
        solid = shape(*self.pose.shifted(x, y), *size, *leans)
        self.builder.add(solid, self.ground, *surface, **options)

    def cylinder(
        self, x: float, y: float, radius: float, bottom: float, top: float, *surface: Any
    ) -> None:
        x, y, _ = self.pose.shifted(x, y)
        solid = Cylinders(x, y, radius, self.ground + bottom, self.ground + top)
        self.builder.add(solid, self.ground, *surface)

    def blob(
        self, x: float, y: float, z: float, radius: float, height: float, path: float, *surface: Any
    ) -> None:
        x, y, _ = self.pose.shifted(x, y)
        solid = Blobs(x, y, self.ground + z, radius, height, path)
        self.builder.add(solid, self.ground, *surface)


class SceneBuilder(ScalarDraws):
    """Draws a scene: collects solids on the ground, which is set before any solid is added."""

    ground: Ground

    def __init__(self, rng: Generator) -> None:
        super().__init__(rng)
        self._rows: dict[type, list[tuple[float, ...]]] = {shape: [] for shape in get_args(Shape)}
        self._taken: list[Footprint] = []

    def site(self, pose: Pose) -> Site:
        """A site on the ground, the kerb included."""
        x, y, _ = pose
        kerb = self.ground.kerb if self.ground.off_street(x, y) > 0 else 0.0
        return Site(self, pose, self.ground.height(x, y) + kerb)

    def take(self, pose: Pose, length: float, width: float | None = None) -> Site | None:
        """Take a rectangle of ground for an object; None if another object has part of it.

        Without a width, it is a square along the axes of the scene.
        """
        place = (
            Footprint(pose, length, width)
            if width
            else Footprint(pose._replace(yaw=0.0), length, length)
        )
        if not all(place.apart(other) for other in self._taken):
            return None
        self._taken.append(place)
        return self.site(pose)

    def post(self, pose: Pose) -> Site | None:
        """Take the ground of something thin; None if it is another's or a carriageway."""
        return self.take(pose, 0.4) if self.ground.off_street(pose.x, pose.y) > 0 else None

    def albedo(self, material: str) -> float:
        """Draw the reflectance of an object of a material."""
        mean, spread, *_ = MATERIALS[material]
        return min(max(self.normal(mean, spread), 0.01), 0.99)

    def add(
        self,
        solid: Shape,
        base: float,
        label: str,
        material: str,
        albedo: float | None = None,
        closed: float = 1.0,
        pattern: int = PLAIN,
    ) -> None:
        """Add a solid, whose fields are numbers, to the scene; fields as in `Surface`."""
        if albedo is None:
            albedo = self.albedo(material)
        self._rows[type(solid)].append(
            (*solid, LABELS[label], INDEX[material], albedo, closed, pattern, base)
        )

    def build(self, rig: int | None = None) -> Scene:
        """The scene of the solids so far."""
        tables = []
        for shape, rows in self._rows.items():
            if rows:
                # Rounded to 1 / 16384, since the last bit of sines depends on the machine.
                columns = (np.rint(np.array(rows) * 16384) / 16384).astype(np.float32).T.copy()
                tables.append((shape(*columns[:-6]), Surface(*columns[-6:])))
        return Scene(self.ground, tuple(tables), rig)
