"""Roadsides: houses, gardens, street furniture, parked and moving vehicles, people."""

import math

from r2flow.simulator import objects
from r2flow.simulator.ground import Street
from r2flow.simulator.kinds import Kind
from r2flow.simulator.scene import SceneBuilder
from r2flow.simulator.shapes import Boxes

END = 82.0  # metres: maximum distance of objects from the sensor
CLEAR = 3.2  # metres around the sensor that stay empty


def free(b: SceneBuilder, x: float, y: float, room: float) -> bool:
    """Whether a position is `room` metres off all carriageways and pavements, within reach and not too near."""
    if not CLEAR < math.hypot(x, y) < END + 5:
        return False
    return bool(b.ground.off_street(x, y) > b.ground.pavement + room)


def line_front(b: SceneBuilder, kind: Kind, street: Street, side: int) -> None:
    """Place plots along a side of a street."""
    draws = b.draws
    setback = draws.uniform(*kind.setback)
    edge = street.half_width + street.pavement
    u, stop = max(-END, street.start) + draws.uniform(-4, 6), min(END, street.stop)
    while u < stop:
        length = draws.uniform(7, 16 if kind.storeys[0] < 3 else 24)
        back = max(setback + draws.normal(0, 0.2 * setback + 0.1), 0.2)
        if draws.chance(kind.built) and _house(b, kind, street, side, u, length, edge + back):
            _garden(b, kind, street, side, u, length, edge, back)
        elif draws.chance(0.2):
            _car_park(b, street, side, u + length / 2, edge)
        else:
            green(b, street, side, u, length, edge + 0.5)
        gap = draws.exponential(kind.gap)
        if gap > 2.5:
            _gap(b, street, side, u + length, gap, edge + back)
        u += length + gap


def _house(b: SceneBuilder, kind: Kind, street: Street, side: int, u: float, length: float, edge: float) -> bool:
    """A house, if there is room, usually with an object behind it that limits the view."""
    draws = b.draws
    width, middle = draws.uniform(8, 12), u + length / 2
    x, y, heading = street.place(middle, side * (edge + width / 2))
    corners = [street.place(v, side * (edge + w)) for v in (u, u + length) for w in (0, width)]
    if not all(free(b, px, py, 0.3) for px, py, _ in (*corners, (x, y, 0))):
        return False
    height = 2.9 * draws.whole(*kind.storeys) + 0.3
    if not objects.house(b, x, y, heading + draws.normal(0, 0.03), length, width, height):
        return False
    if draws.chance(0.75):
        beyond(b, street, side, middle, edge + width)
    return True


def _garden(
    b: SceneBuilder, kind: Kind, street: Street, side: int, u: float, length: float, edge: float, back: float
) -> None:
    """Hedge or fence and plants between pavement and house."""
    draws, middle = b.draws, u + length / 2
    x, y, heading = street.place(middle, side * (edge + 0.6))
    ends = [street.place(v, side * (edge + 0.6)) for v in (u, u + length)]
    if back > 1.2 and all(free(b, px, py, 0.1) for px, py, _ in ends):
        if draws.chance(kind.hedges):
            objects.hedge(b, x, y, heading, length * draws.uniform(0.5, 1.0), draws.uniform(0.8, 2.4))
        elif draws.chance(kind.fences):
            objects.fence(b, x, y, heading, length * draws.uniform(0.5, 1.0))
    for _ in range(draws.poisson(kind.plants * length / 10)):
        out = edge + draws.uniform(0.3, max(back - 0.4, 0.6))
        _plant(b, *street.place(u + draws.uniform(0, length), side * out)[:2])


def _plant(b: SceneBuilder, x: float, y: float) -> None:
    if not free(b, x, y, 0.2):
        return
    if b.draws.chance(0.5):
        objects.tree(b, x, y, b.draws.uniform(0.7, 1.3))
    else:
        objects.bush(b, x, y, b.draws.uniform(0.5, 1.3))


def green(b: SceneBuilder, street: Street, side: int, u: float, length: float, edge: float) -> None:
    """A plot without a house: trees, bushes, thickets."""
    draws = b.draws
    if draws.chance(0.35):
        x, y, heading = street.place(u + length / 2, side * (edge + draws.uniform(0.5, 3)))
        if all(free(b, x + d * math.cos(heading), y + d * math.sin(heading), 0.1) for d in (-length / 2, length / 2)):
            objects.hedge(b, x, y, heading, length, draws.uniform(1.0, 2.6))
    for _ in range(draws.poisson(length / 2.2)):
        _plant(b, *street.place(u + draws.uniform(0, length), side * (edge + draws.uniform(0.3, 14)))[:2])
    for _ in range(draws.poisson(length / 6)):
        x, y, _ = street.place(u + draws.uniform(0, length), side * (edge + draws.uniform(7, 22)))
        if free(b, x, y, 3.5):
            objects.thicket(b, x, y)


def _gap(b: SceneBuilder, street: Street, side: int, u: float, gap: float, lateral: float) -> None:
    """A gap between two houses: a gate or wall, with trees behind."""
    x, y, heading = street.place(u + gap / 2, side * (lateral + 0.5))
    if b.draws.chance(0.4) and free(b, x, y, gap / 2):
        objects.fence(b, x, y, heading, gap * 0.9)
    green(b, street, side, u, gap, lateral + 2)


def _car_park(b: SceneBuilder, street: Street, side: int, middle: float, edge: float) -> None:
    """A car park on a green plot: two rows of cars at right angles to the street."""
    draws = b.draws
    for row in (3.5, 11.0):
        for slot in range(-3, 4):
            x, y, heading = street.place(middle + 2.7 * slot, side * (edge + row))
            if draws.chance(0.6) and free(b, x, y, 2.5) and math.hypot(x, y) > CLEAR + 2:
                objects.car(b, x, y, heading + math.pi / 2 * draws.side() + draws.normal(0, 0.03))
    beyond(b, street, side, middle, edge + 10)


def beyond(b: SceneBuilder, street: Street, side: int, middle: float, lateral: float) -> None:
    """The second row: a house or tall trees that limit the view."""
    draws = b.draws
    x, y, heading = street.place(middle + draws.uniform(-8, 8), side * (lateral + draws.uniform(12, 28)))
    if draws.chance(0.5) and free(b, x, y, 9):
        objects.house(b, x, y, heading, draws.uniform(10, 20), draws.uniform(8, 11), draws.uniform(6, 12))
    elif free(b, x, y, 4):
        objects.thicket(b, x, y)


def close_street(b: SceneBuilder, street: Street) -> None:
    """Houses or trees across the far ends of a street, as at a bend."""
    draws = b.draws
    for end, limit in ((-1, street.start), (1, street.stop)):
        if abs(limit) < END:
            continue
        x, y, heading = street.place(end * draws.uniform(50, 76), draws.normal(0, 3))
        if draws.chance(0.45):
            objects.house(b, x, y, heading + math.pi / 2, draws.uniform(14, 26), 9, draws.uniform(6, 11))
        elif draws.chance(0.75):
            for _ in range(draws.whole(1, 3)):
                objects.thicket(b, x + draws.normal(0, 3), y + draws.normal(0, 6))


def close_view(b: SceneBuilder) -> None:
    """Distant woods and houses on all sides, off the streets."""
    draws = b.draws
    for _ in range(22):
        turn, away = draws.uniform(-math.pi, math.pi), draws.uniform(38, 78)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if draws.chance(0.3) and free(b, x, y, 12):
            objects.house(b, x, y, draws.uniform(0, math.pi), draws.uniform(12, 24), 9, draws.uniform(5, 11))
        elif free(b, x, y, 6):
            objects.woods(b, x, y)


def _clear(b: SceneBuilder, street: Street, x: float, y: float, room: float) -> bool:
    """Whether a position next to a street is within reach, not too near, and `room` metres off the other streets."""
    others = (other for other in b.ground.streets if other != street)
    return 2.6 < math.hypot(x, y) < END and all(other.away(x, y) > room for other in others)


def _driven(b: SceneBuilder, x: float, y: float) -> bool:
    """Whether a position is on the ego vehicle's path."""
    main = b.ground.streets[0]
    u, lateral = main.locate(x, y)
    return abs(lateral + main.offset) < 2.6 and abs(u) < 30


def park(b: SceneBuilder, kind: Kind, street: Street, side: int) -> None:
    """Parked cars along the kerb, partly on it, with gaps; or side by side, facing the kerb."""
    draws = b.draws
    if draws.chance(0.2) or kind.parked == 0:
        return
    nose_in = draws.chance(0.12)
    taken, step = kind.parked * draws.uniform(0.3, 2.2), 2.6 if nose_in else 5.5
    lateral = side * (street.half_width + (draws.uniform(1.5, 2.5) if nose_in else draws.uniform(-1.0, 0.7)))
    u, stop = max(-END, street.start) + draws.uniform(0, 6), min(END, street.stop)
    while u < stop:
        u += step + draws.uniform(0, 0.15 * step)
        x, y, heading = street.place(u, lateral + draws.normal(0, 0.12))
        if not _clear(b, street, x, y, 5.0) or math.hypot(x, y) < CLEAR or _driven(b, x, y) or not draws.chance(taken):
            continue
        along = heading + (0 if side < 0 else math.pi)
        if draws.chance(0.04) and not nose_in:
            objects.truck(b, x, y, along)
            u += 4
        else:
            objects.car(b, x, y, along + nose_in * math.pi / 2 * draws.side() + draws.normal(0, 0.03))


def furnish(b: SceneBuilder, street: Street, side: int) -> None:
    """Lamp posts, signs, rows of trees, bollards, bins and bicycles along the kerb."""
    draws = b.draws
    edge = street.half_width + min(0.5, street.pavement / 2 + 0.2)
    u, spacing, alley = max(-END, street.start) + draws.uniform(0, 25), draws.uniform(16, 37), draws.chance(0.3)
    while u < min(END, street.stop):
        x, y, heading = street.place(u, side * edge)
        if _clear(b, street, x, y, 0.6):
            if draws.chance(0.7):
                objects.pole(b, x, y)
            if draws.chance(0.5):
                sx, sy, _ = street.place(u + draws.uniform(-1, 1), side * (edge + 0.2))
                objects.sign(b, sx, sy, heading + (math.pi if side < 0 else 0) + draws.normal(0, 0.15))
            if alley:
                tx, ty, _ = street.place(u + spacing / 2, side * (edge + 0.3))
                if free(b, tx, ty, -street.pavement):
                    objects.tree(b, tx, ty, draws.uniform(0.8, 1.4))
        u += spacing * draws.uniform(0.7, 1.3)
    if street.pavement > 0:
        _clutter(b, street, side, edge)


def _clutter(b: SceneBuilder, street: Street, side: int, edge: float) -> None:
    draws = b.draws
    if draws.chance(0.25):
        start = draws.uniform(-30, 20)
        for step in range(draws.whole(3, 8)):
            x, y, _ = street.place(start + 2.2 * step, side * (edge - 0.1))
            if _clear(b, street, x, y, 0.5):
                objects.bollard(b, x, y)
    for _ in range(draws.poisson(2.0)):
        x, y, heading = street.place(draws.uniform(-40, 40), side * (edge + street.pavement - 0.4))
        if _clear(b, street, x, y, 0.5):
            draws.pick((objects.bin_, objects.bicycle, objects.cabinet), (0.5, 0.25, 0.25))(b, x, y, heading)


def drive(b: SceneBuilder, kind: Kind, main: Street) -> None:
    """Moving vehicles: ahead and behind in the ego lane, oncoming in the other."""
    draws = b.draws
    for _ in range(draws.poisson(kind.traffic)):
        same_lane = draws.chance(0.5)
        u = draws.uniform(8, 65) * (1 if draws.chance(0.6) else -1)
        if not main.start < u < main.stop:
            continue
        x, y, heading = main.place(u, (-1 if same_lane else 1) * main.half_width / 2)
        build = objects.truck if draws.chance(0.1) else objects.car
        build(b, x, y, heading + (0 if same_lane else math.pi), moving=True)


def walk(b: SceneBuilder, kind: Kind, main: Street) -> None:
    """People on the pavements, cyclists on the carriageway."""
    draws = b.draws
    for _ in range(draws.poisson(kind.people)):
        lateral = draws.side() * (main.half_width + draws.uniform(0.3, max(main.pavement, 0.6)))
        x, y, heading = main.place(draws.uniform(-35, 35), lateral)
        if math.hypot(x, y) > CLEAR:
            objects.person(b, x, y, heading + math.pi * draws.chance(0.5), moving=draws.chance(0.7))
    for _ in range(draws.poisson(0.25 * kind.people)):
        side = draws.side()
        x, y, heading = main.place(draws.uniform(6, 40) * draws.side(), side * (main.half_width - 0.7))
        objects.cyclist(b, x, y, heading + math.pi * (side > 0))


def guard(b: SceneBuilder, main: Street) -> None:
    """Guard rails on both sides."""
    for side in (1, -1):
        for u in range(-80, 80, 8):
            x, y, heading = main.place(u + 4, side * (main.half_width + 0.8))
            ground = b.level(x, y)
            b.add(Boxes(x, y, heading, 8.1, 0.12, ground + 0.45, ground + 0.78), "fence", "metal", albedo=0.4)
