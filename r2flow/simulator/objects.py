"""Objects of a street: vehicles, houses, plants, people, poles."""

from math import cos, sin, sqrt, tau

from r2flow.simulator.scene import BODY, CABIN, FACADE, SceneBuilder, Site
from r2flow.simulator.streets import Pose
from r2flow.simulator.tables import TABLES

_NEAR = 40  # metres: clumps of leaves farther away are not resolved by rays
# metres: heights of the body's lower edge and of the bonnet's front
_SILL = 0.22
_BONNET = 0.70


class ObjectBuilder(SceneBuilder):
    """Draws the objects of a street; those that need ground are left out where it is taken."""

    def car(self, pose: Pose, label: str = "car") -> None:
        """A body with plates, a bonnet up to the windscreen, a cabin with panes, four wheels."""
        forms = TABLES["cars"].values()
        form = self.pick([*forms], [share for share, *_ in forms])
        _, length, width, waist, roof, screen, rear, cabin, shift = form
        length *= self.uniform(0.94, 1.05)
        width *= self.uniform(0.97, 1.03)
        site = self.take(pose, length, width)
        if not site:
            return
        if self.chance(0.45):
            paint = label, "dark paint", self.albedo("dark paint")
        else:
            paint = label, "paint", self.uniform(0.12, 0.62)
        cabin *= length
        middle = -shift * length
        # The bonnet leans up to the windscreen.
        lean = (length / 2 - (middle + cabin / 2)) / (waist - _BONNET)
        for x, size, leans, pattern in (
            (0, (length, width, _SILL, _BONNET), (0.12, 0.08, 0.04), BODY),
            (0, (length - 0.1, width - 0.04, _BONNET, waist), (lean, 0.3, 0.10), BODY),
            (middle, (cabin, width - 0.10, waist, roof), (screen, rear, 0.25), CABIN),
        ):
            site.box(x, 0, *size, *paint, leans=leans, pattern=pattern)
        for x in (-0.3 * length, 0.3 * length):
            _axle(site, label, x, width / 2 - 0.10, 0.60, 0.22, 0.62)

    def truck(self, pose: Pose, label: str = "truck") -> None:
        """A delivery van or lorry: cab in front of a box on wheels."""
        length = self.uniform(5.5, 9.5)
        width = self.uniform(2.0, 2.5)
        height = self.uniform(2.4, 3.6)
        site = self.take(pose, length, width)
        if not site:
            return
        cab = 1.9  # metres, its length
        paint = label, "paint", self.uniform(0.2, 0.7)
        size = cab, width - 0.1, 0.45, 2.3
        site.box((length - cab) / 2, 0, *size, *paint, leans=(0.25, 0, 0.04), pattern=BODY)
        site.box(
            -cab / 2, 0, length - cab, width, 0.75, height, label, "paint", self.uniform(0.2, 0.7)
        )
        for x in (-0.35 * length, 0.34 * length):
            _axle(site, label, x, width / 2 - 0.16, 0.9, 0.3, 0.9)

    def bicycle(self, pose: Pose, label: str = "bicycle") -> Site | None:
        """Two spoked wheels and a frame."""
        site = self.take(pose, 1.7, 0.5)
        if site:
            for x in (-0.52, 0.52):
                site.box(x, 0, 0.62, 0.05, 0, 0.66, label, "rubber", closed=0.4)
            site.box(0, 0, 0.9, 0.06, 0.35, 0.95, label, "metal", closed=0.5)
        return site

    def cyclist(self, pose: Pose) -> None:
        """A rider on a bicycle."""
        label = "moving-bicyclist"
        site = self.bicycle(pose, label)
        if site:
            site.blob(0, 0, 1.25, 0.22, 0.34, 0, label, "cloth")
            site.blob(0.1, 0, 1.68, 0.11, 0.13, 0, label, "skin")
            site.cylinder(0, 0, 0.12, 0.4, 1.0, label, "cloth")

    def person(self, pose: Pose, label: str) -> None:
        """Two legs, a trunk, arms and a head."""
        site = self.take(pose, 0.5)
        if not site:
            return
        tall = self.uniform(1.55, 1.9)
        cloth = label, "cloth", self.albedo("cloth")
        stride = self.uniform(0.05, 0.25)
        for side in (-1, 1):
            site.cylinder(side * stride, side * 0.09, 0.08, 0, 0.48 * tall, label, "cloth")
            site.blob(-side * stride * 0.7, side * 0.23, 0.64 * tall, 0.07, 0.17 * tall, 0, *cloth)
        site.blob(0, 0, 0.66 * tall, 0.20, 0.21 * tall, 0, *cloth)
        site.blob(0, 0, 0.93 * tall, 0.11, 0.13, 0, label, "skin")

    def house(self, pose: Pose, length: float, width: float, height: float) -> bool:
        """Rows of windows under a gable roof, with or without a bay; False on taken ground."""
        site = self.take(pose, length, width)
        if not site:
            return False
        material = "plaster" if self.chance(0.75) else "brick"
        wall = "building", material, self.albedo(material)
        site.box(0, 0, length, width, -2, height, *wall, pattern=FACADE)
        pitch = self.uniform(0.9, 1.6)  # metres inwards per metre of height
        ridge = height + (width / 2 + 0.4) / pitch
        site.box(
            0,
            0,
            length + 0.4,
            width + 0.8,
            height,
            ridge,
            "building",
            "brick",
            leans=(0.0, 0.0, pitch),
        )
        if self.chance(0.5):
            x = self.uniform(-0.35, 0.35) * length
            for y in (-width / 2, width / 2):
                bay = self.uniform(1.4, 3.5), self.uniform(0.8, 2.4), -1, self.uniform(2.4, height)
                site.box(x, y, *bay, *wall, pattern=FACADE)
        return True

    def tree(self, pose: Pose, size: float) -> None:
        site = self.post(pose)
        if not site:
            return
        trunk = self.uniform(0.07, 0.20) * size
        clear = self.uniform(1.5, 2.8)
        crown = self.uniform(1.2, 2.6) * size
        tall = self.uniform(1.2, 2.2) * size
        site.cylinder(0, 0, trunk, -0.5, clear + tall, "trunk", "bark")
        count, clump = (self.whole(13, 18), 0.30) if pose.away < _NEAR else (self.whole(6, 8), 0.42)
        self._clumps(pose, clear + tall, crown, tall, clump * crown, count, self.uniform(0.4, 1.3))

    def bush(self, pose: Pose, size: float) -> None:
        """A few leafy clumps on the ground."""
        height = self.uniform(0.3, 0.9) * size
        self._clumps(
            pose,
            height * 0.8,
            0.8 * size,
            height,
            0.38 * size,
            self.whole(4, 7),
            self.uniform(0.15, 0.5),
        )

    def thicket(self, pose: Pose) -> None:
        """Tall trees whose leaves reach the ground."""
        height = self.uniform(2.0, 4.0)
        count, clump = (self.whole(14, 22), 0.9) if pose.away < _NEAR else (self.whole(6, 9), 1.4)
        radius = self.uniform(2.0, 3.6)
        self._clumps(pose, height * 0.9, radius, height, clump, count, self.uniform(0.5, 1.6))

    def _clumps(
        self,
        pose: Pose,
        z: float,
        radius: float,
        height: float,
        size: float,
        count: int,
        path: float,
    ) -> None:
        """Leafy clumps of similar size, spread evenly over an ellipsoid at height z."""
        site = self.site(pose._replace(yaw=0.0))
        leaves = "vegetation", "leaves", self.albedo("leaves")
        for _ in range(count):
            turn = self.uniform(0, tau)
            up = self.uniform(-1, 1)
            far = self.unit() ** (1 / 3)
            out = far * sqrt(1 - up * up) * radius
            clump = size * self.uniform(0.6, 1.4)
            shape = clump, clump * self.uniform(0.6, 1.0), path * self.uniform(0.4, 1.6)
            site.blob(out * cos(turn), out * sin(turn), z + far * up * height, *shape, *leaves)

    def woods(self, pose: Pose) -> None:
        """Distant trees as a few large blobs."""
        site = self.site(pose)
        leaves = "vegetation", "leaves", self.albedo("leaves")
        for _ in range(self.whole(2, 4)):
            radius = self.uniform(2.0, 4.5)
            height = self.uniform(2.5, 5.0)
            place = self.normal(0, 4), self.normal(0, 4), 0.8 * height
            site.blob(*place, radius, height, self.uniform(0.4, 2.0), *leaves)

    def hedge(self, pose: Pose, length: float, height: float) -> None:
        """A trimmed hedge, in pieces of different height and depth; open on carriageways."""
        leaves = "vegetation", "leaves", self.albedo("leaves")
        pieces = max(1, round(length / 2.5))
        for piece in range(pieces):
            middle = pose.shifted(((piece + 0.5) / pieces - 0.5) * length)
            site = self.site(middle.turned(self.uniform(-0.03, 0.03)))
            size = (
                length / pieces + 0.1,
                self.uniform(0.7, 1.1),
                -0.3,
                height * self.uniform(0.9, 1.08),
            )
            if self.ground.off_street(middle.x, middle.y) > 0:
                site.box(0, 0, *size, *leaves)

    def fence(self, pose: Pose, length: float) -> None:
        """A wall, a plank fence, slats or wire with posts."""
        site = self.site(pose)
        style = self.unit()
        height = self.uniform(0.9, 1.9)
        if style < 0.35:
            site.box(0, 0, length, 0.25, -0.5, min(height, 1.4), "fence", "concrete")
            return
        closed = 1.0 if style < 0.6 else self.uniform(0.25, 0.7)
        site.box(0, 0, length, 0.04, 0, height, "fence", "wood", closed=closed)
        posts = max(2, round(length / 2.5))
        for post in range(posts):
            x = (post / (posts - 1) - 0.5) * length
            site.cylinder(x, 0, 0.05, 0, height + 0.08, "fence", "wood")

    def pole(self, pose: Pose) -> None:
        """A lamp post."""
        site = self.post(pose)
        if not site:
            return
        tall = self.uniform(4.5, 8.5)
        site.cylinder(0, 0, self.uniform(0.05, 0.11), -0.3, tall, "pole", "metal")
        if self.chance(0.3):  # a base with a door
            site.cylinder(0, 0, self.uniform(0.10, 0.15), -0.3, 0.9, "pole", "metal")

    def sign(self, pose: Pose) -> None:
        """A retro-reflecting plate on a post, facing along yaw."""
        site = self.post(pose)
        if site:
            low = self.uniform(1.7, 2.4)
            size = self.uniform(0.45, 0.8)
            site.cylinder(0, 0, 0.04, -0.3, low + size, "pole", "metal")
            site.box(0.07, 0, 0.03, size, low, low + size, "traffic-sign", "retro")

    def bollard(self, pose: Pose) -> None:
        """A waist-high post with a reflecting band."""
        site = self.post(pose)
        if site:
            radius = self.uniform(0.06, 0.12)
            tall = self.uniform(0.8, 1.1)
            site.cylinder(0, 0, radius, 0, tall, "pole", "metal")
            site.cylinder(0, 0, radius + 0.01, tall - 0.3, tall - 0.15, "pole", "retro")

    def bin(self, pose: Pose) -> None:
        site = self.post(pose)
        if site:
            size = self.uniform(0.45, 0.7)
            site.box(0, 0, size, size, 0, 1.05, "other-object", "plastic")

    def cabinet(self, pose: Pose) -> None:
        site = self.post(pose)
        if site:
            size = self.uniform(0.6, 1.4), 0.4, 0, self.uniform(0.9, 1.4)
            site.box(0, 0, *size, "other-structure", "concrete")


def _axle(
    site: Site, label: str, x: float, y: float, length: float, width: float, height: float
) -> None:
    """Two wheels, y metres to the left and right."""
    for side in (-y, y):
        site.box(x, side, length, width, 0, height, label, "rubber")
