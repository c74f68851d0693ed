"""Objects of a street: vehicles, houses, plants, people, poles."""

import math
from typing import NamedTuple

from r2flow.simulator.scene import BODY, CABIN, FACADE, SceneBuilder
from r2flow.simulator.shapes import Blobs, Boxes, Cylinders, Frusta


class Form(NamedTuple):
    """Dimensions of a car in metres; leans are metres inwards per metre of height."""

    share: float
    length: float
    width: float
    waist: float  # height of the lower edge of the panes
    roof: float
    screen: float  # lean of the windscreen
    rear: float  # lean of the rear window
    cabin: float  # share of the length that is cabin
    shift: float  # of the cabin's middle to the back, as a share of the length


_CARS = (
    Form(0.32, 4.0, 1.70, 0.90, 1.47, 0.80, 0.25, 0.72, 0.08),  # hatchback
    Form(0.24, 4.6, 1.78, 0.90, 1.43, 0.95, 0.85, 0.62, 0.03),  # saloon
    Form(0.22, 4.7, 1.80, 0.92, 1.47, 0.90, 0.20, 0.72, 0.10),  # estate
    Form(0.12, 4.5, 1.86, 1.00, 1.70, 0.60, 0.20, 0.74, 0.10),  # tall
    Form(0.10, 4.9, 1.92, 1.05, 1.95, 0.50, 0.05, 0.84, 0.08),  # van
)
_SILL, _BONNET = 0.22, 0.70  # metres: heights of the body's lower edge and of the bonnet's front


def _beside(x: float, y: float, yaw: float, u: float, v: float = 0.0) -> tuple[float, float]:
    """The position u metres ahead of (x, y) along yaw and v metres to the left."""
    c, s = math.cos(yaw), math.sin(yaw)
    return x + u * c - v * s, y + u * s + v * c


def car(b: SceneBuilder, x: float, y: float, yaw: float, moving: bool = False) -> None:
    """A body with plates, a bonnet that rises to the windscreen, a cabin with panes, four wheels."""
    draws = b.draws
    form = draws.pick(_CARS, [form.share for form in _CARS])
    length, width = form.length * draws.uniform(0.94, 1.05), form.width * draws.uniform(0.97, 1.03)
    if not b.take(x, y, yaw, length, width):
        return
    ground, label = b.level(x, y), "moving-car" if moving else "car"
    dark = draws.chance(0.45)
    paint, albedo = ("dark paint", b.albedo("dark paint")) if dark else ("paint", draws.uniform(0.12, 0.62))
    u, long = -form.shift * length, form.cabin * length
    cabin, waist, roof = _beside(x, y, yaw, u), ground + form.waist, ground + form.roof
    bonnet = (length / 2 - (u + long / 2)) / (form.waist - _BONNET)  # leans up to the windscreen
    parts = (
        (Frusta(x, y, yaw, length, width, ground + _SILL, ground + _BONNET, 0.12, 0.08, 0.04), BODY),
        (Frusta(x, y, yaw, length - 0.1, width - 0.04, ground + _BONNET, waist, bonnet, 0.3, 0.10), BODY),
        (Frusta(*cabin, yaw, long, width - 0.10, waist, roof, form.screen, form.rear, 0.25), CABIN),
    )
    for part, pattern in parts:
        b.add(part, label, paint, albedo, pattern=pattern, base=ground)
    for i in (-1, 1):
        for j in (-1, 1):
            place = _beside(x, y, yaw, i * length * 0.30, j * (width / 2 - 0.10))
            b.add(Boxes(*place, yaw, 0.60, 0.22, ground, ground + 0.62), label, "rubber")


def truck(b: SceneBuilder, x: float, y: float, yaw: float, moving: bool = False) -> None:
    """A delivery van or lorry: cab in front of a box on wheels."""
    length, width, height = b.draws.uniform(5.5, 9.5), b.draws.uniform(2.0, 2.5), b.draws.uniform(2.4, 3.6)
    if not b.take(x, y, yaw, length, width):
        return
    ground, label = b.level(x, y), "moving-truck" if moving else "truck"
    cab = 1.9
    front, rear = _beside(x, y, yaw, (length - cab) / 2), _beside(x, y, yaw, -cab / 2)
    driver = Frusta(*front, yaw, cab, width - 0.1, ground + 0.45, ground + 2.3, 0.25, 0, 0.04)
    b.add(driver, label, "paint", b.draws.uniform(0.2, 0.7), pattern=BODY, base=ground)
    load = Boxes(*rear, yaw, length - cab, width, ground + 0.75, ground + height)
    b.add(load, label, "paint", b.draws.uniform(0.2, 0.7))
    for u in (-0.35 * length, 0.34 * length):
        for v in (-width / 2 + 0.16, width / 2 - 0.16):
            b.add(Boxes(*_beside(x, y, yaw, u, v), yaw, 0.9, 0.3, ground, ground + 0.9), label, "rubber")


def bicycle(b: SceneBuilder, x: float, y: float, yaw: float) -> None:
    if b.take(x, y, yaw, 1.7, 0.5):
        _cycle(b, x, y, yaw, "bicycle")


def _cycle(b: SceneBuilder, x: float, y: float, yaw: float, label: str) -> None:
    """Two spoked wheels and a frame."""
    ground = b.level(x, y)
    for u in (-0.52, 0.52):
        b.add(Boxes(*_beside(x, y, yaw, u), yaw, 0.62, 0.05, ground, ground + 0.66), label, "rubber", closed=0.4)
    b.add(Boxes(x, y, yaw, 0.9, 0.06, ground + 0.35, ground + 0.95), label, "metal", closed=0.5)


def house(b: SceneBuilder, x: float, y: float, yaw: float, length: float, width: float, height: float) -> bool:
    """A block with rows of windows under a gable roof, sometimes with a bay or a porch; False on taken ground."""
    if not b.take(x, y, yaw, length, width):
        return False
    ground = b.level(x, y)
    wall = "plaster" if b.draws.chance(0.75) else "brick"
    albedo = b.albedo(wall)
    block = Boxes(x, y, yaw, length, width, ground - 2, ground + height)
    b.add(block, "building", wall, albedo, pattern=FACADE, base=ground)
    pitch = b.draws.uniform(0.9, 1.6)  # metres inwards per metre of height
    roof = Frusta(
        x, y, yaw, length + 0.4, width + 0.8, ground + height, ground + height + (width / 2 + 0.4) / pitch,
        0.0, 0.0, pitch,
    )  # fmt: skip
    b.add(roof, "building", "brick")
    if b.draws.chance(0.5):
        u = b.draws.uniform(-0.35, 0.35) * length
        for v in (-width / 2, width / 2):
            bay = Boxes(
                *_beside(x, y, yaw, u, v), yaw, b.draws.uniform(1.4, 3.5), b.draws.uniform(0.8, 2.4),
                ground - 1, ground + b.draws.uniform(2.4, height),
            )  # fmt: skip
            b.add(bay, "building", wall, albedo, pattern=FACADE, base=ground)
    return True


def _clumps(
    b: SceneBuilder, x: float, y: float, z: float, radius: float, height: float, size: float, count: int, path: float
) -> None:
    """Leafy clumps of similar size, spread evenly over an ellipsoid around (x, y, z)."""
    draws, albedo = b.draws, b.albedo("leaves")
    for _ in range(count):
        turn, up = draws.uniform(0, 2 * math.pi), draws.uniform(-1, 1)
        far = draws.unit() ** (1 / 3)
        out = far * math.sqrt(1 - up * up) * radius
        clump = size * draws.uniform(0.6, 1.4)
        blob = Blobs(
            x + out * math.cos(turn), y + out * math.sin(turn), z + far * up * height,
            clump, clump * draws.uniform(0.6, 1.0), path * draws.uniform(0.4, 1.6),
        )  # fmt: skip
        b.add(blob, "vegetation", "leaves", albedo)


def tree(b: SceneBuilder, x: float, y: float, size: float) -> None:
    if not b.post(x, y):
        return
    draws, ground = b.draws, b.level(x, y)
    trunk, clear = draws.uniform(0.07, 0.20) * size, draws.uniform(1.5, 2.8)
    crown, tall = draws.uniform(1.2, 2.6) * size, draws.uniform(1.2, 2.2) * size
    b.add(Cylinders(x, y, trunk, ground - 0.5, ground + clear + tall), "trunk", "bark")
    near = math.hypot(x, y) < 40  # farther away, rays are too sparse to resolve clumps
    count, clump = (draws.whole(13, 18), 0.30) if near else (draws.whole(6, 8), 0.42)
    _clumps(b, x, y, ground + clear + tall, crown, tall, clump * crown, count, draws.uniform(0.4, 1.3))


def bush(b: SceneBuilder, x: float, y: float, size: float) -> None:
    """A few leafy clumps on the ground."""
    height = b.draws.uniform(0.3, 0.9) * size
    z = b.level(x, y) + height * 0.8
    _clumps(b, x, y, z, 0.8 * size, height, 0.38 * size, b.draws.whole(4, 7), b.draws.uniform(0.15, 0.5))


def thicket(b: SceneBuilder, x: float, y: float) -> None:
    """Tall trees whose leaves reach the ground."""
    draws = b.draws
    height = draws.uniform(2.0, 4.0)
    count, clump = (draws.whole(14, 22), 0.9) if math.hypot(x, y) < 40 else (draws.whole(6, 9), 1.4)
    z = b.level(x, y) + height * 0.9
    _clumps(b, x, y, z, draws.uniform(2.0, 3.6), height, clump, count, draws.uniform(0.5, 1.6))


def woods(b: SceneBuilder, x: float, y: float) -> None:
    """Distant trees as a few large blobs."""
    draws, ground, albedo = b.draws, b.level(x, y), b.albedo("leaves")
    for _ in range(draws.whole(2, 4)):
        radius, height = draws.uniform(2.0, 4.5), draws.uniform(2.5, 5.0)
        blob = Blobs(
            x + draws.normal(0, 4), y + draws.normal(0, 4), ground + 0.8 * height,
            radius, height, draws.uniform(0.4, 2.0),
        )  # fmt: skip
        b.add(blob, "vegetation", "leaves", albedo)


def hedge(b: SceneBuilder, x: float, y: float, yaw: float, length: float, height: float) -> None:
    """A trimmed hedge, in pieces of different height and depth; open on carriageways."""
    albedo = b.albedo("leaves")
    pieces = max(1, round(length / 2.5))
    for piece in range(pieces):
        px, py = _beside(x, y, yaw, ((piece + 0.5) / pieces - 0.5) * length)
        ground = b.level(px, py)
        box = Boxes(
            px, py, yaw + b.draws.uniform(-0.03, 0.03), length / pieces + 0.1, b.draws.uniform(0.7, 1.1),
            ground - 0.3, ground + height * b.draws.uniform(0.9, 1.08),
        )  # fmt: skip
        if b.ground.off_street(px, py) > 0:
            b.add(box, "vegetation", "leaves", albedo)


def fence(b: SceneBuilder, x: float, y: float, yaw: float, length: float) -> None:
    """A wall, a plank fence, slats or wire with posts."""
    ground, style = b.level(x, y), b.draws.unit()
    height = b.draws.uniform(0.9, 1.9)
    if style < 0.35:
        b.add(Boxes(x, y, yaw, length, 0.25, ground - 0.5, ground + min(height, 1.4)), "fence", "concrete")
        return
    closed = 1.0 if style < 0.6 else b.draws.uniform(0.25, 0.7)
    b.add(Boxes(x, y, yaw, length, 0.04, ground, ground + height), "fence", "wood", closed=closed)
    posts = max(2, round(length / 2.5))
    for post in range(posts):
        place = _beside(x, y, yaw, (post / (posts - 1) - 0.5) * length)
        b.add(Cylinders(*place, 0.05, ground, ground + height + 0.08), "fence", "wood")


def pole(b: SceneBuilder, x: float, y: float) -> None:
    """A lamp post."""
    if not b.post(x, y):
        return
    ground = b.level(x, y)
    tall = b.draws.uniform(4.5, 8.5)
    b.add(Cylinders(x, y, b.draws.uniform(0.05, 0.11), ground - 0.3, ground + tall), "pole", "metal")
    if b.draws.chance(0.3):  # a base with a door
        b.add(Cylinders(x, y, b.draws.uniform(0.10, 0.15), ground - 0.3, ground + 0.9), "pole", "metal")


def sign(b: SceneBuilder, x: float, y: float, yaw: float) -> None:
    """A retro-reflecting plate on a post, facing along yaw."""
    if not b.post(x, y):
        return
    ground, low = b.level(x, y), b.draws.uniform(1.7, 2.4)
    size = b.draws.uniform(0.45, 0.8)
    b.add(Cylinders(x, y, 0.04, ground - 0.3, ground + low + size), "pole", "metal")
    plate = Boxes(*_beside(x, y, yaw, 0.07), yaw, 0.03, size, ground + low, ground + low + size)
    b.add(plate, "traffic-sign", "retro")


def bollard(b: SceneBuilder, x: float, y: float) -> None:
    """A waist-high post with a reflecting band."""
    if not b.post(x, y):
        return
    ground, radius = b.level(x, y), b.draws.uniform(0.06, 0.12)
    tall = b.draws.uniform(0.8, 1.1)
    b.add(Cylinders(x, y, radius, ground, ground + tall), "pole", "metal")
    b.add(Cylinders(x, y, radius + 0.01, ground + tall - 0.3, ground + tall - 0.15), "pole", "retro")


def bin_(b: SceneBuilder, x: float, y: float, yaw: float) -> None:
    if not b.post(x, y):
        return
    ground, size = b.level(x, y), b.draws.uniform(0.45, 0.7)
    b.add(Boxes(x, y, yaw, size, size, ground, ground + 1.05), "other-object", "plastic")


def cabinet(b: SceneBuilder, x: float, y: float, yaw: float) -> None:
    if not b.post(x, y):
        return
    ground = b.level(x, y)
    box = Boxes(x, y, yaw, b.draws.uniform(0.6, 1.4), 0.4, ground, ground + b.draws.uniform(0.9, 1.4))
    b.add(box, "other-structure", "concrete")


def person(b: SceneBuilder, x: float, y: float, yaw: float, moving: bool) -> None:
    """Two legs, a trunk, arms and a head."""
    if not b.take(x, y, 0.0, 0.5, 0.5):
        return
    ground, tall = b.level(x, y), b.draws.uniform(1.55, 1.9)
    label = "moving-person" if moving else "person"
    albedo, stride = b.albedo("cloth"), b.draws.uniform(0.05, 0.25)
    for side in (-1, 1):
        leg, arm = _beside(x, y, yaw, side * stride, side * 0.09), _beside(x, y, yaw, -side * stride * 0.7, side * 0.23)
        b.add(Cylinders(*leg, 0.08, ground, ground + 0.48 * tall), label, "cloth")
        b.add(Blobs(*arm, ground + 0.64 * tall, 0.07, 0.17 * tall, 0), label, "cloth", albedo)
    b.add(Blobs(x, y, ground + 0.66 * tall, 0.20, 0.21 * tall, 0), label, "cloth", albedo)
    b.add(Blobs(x, y, ground + 0.93 * tall, 0.11, 0.13, 0), label, "skin")


def cyclist(b: SceneBuilder, x: float, y: float, yaw: float) -> None:
    """A rider on a bicycle."""
    if not b.take(x, y, yaw, 1.7, 0.5):
        return
    _cycle(b, x, y, yaw, "moving-bicyclist")
    ground, albedo = b.level(x, y), b.albedo("cloth")
    b.add(Blobs(x, y, ground + 1.25, 0.22, 0.34, 0), "moving-bicyclist", "cloth", albedo)
    b.add(Blobs(*_beside(x, y, yaw, 0.1), ground + 1.68, 0.11, 0.13, 0), "moving-bicyclist", "skin")
    b.add(Cylinders(x, y, 0.12, ground + 0.4, ground + 1.0), "moving-bicyclist", "cloth")
