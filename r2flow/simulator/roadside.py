"""Objects on carriageway and kerb: parked cars, traffic, people, lamps, signs, trees."""

import math

from r2flow.simulator import props, vehicles
from r2flow.simulator.fronts import CLEAR, END, free
from r2flow.simulator.ground import Street
from r2flow.simulator.kinds import Kind
from r2flow.simulator.scene import SceneBuilder
from r2flow.simulator.shapes import Boxes


def _clear(b: SceneBuilder, street: Street, x: float, y: float, room: float) -> bool:
    """Whether a place beside a street is within reach, not too near, and `room` metres off the other streets."""
    others = (other for other in b.ground.streets if other != street)
    return 2.6 < math.hypot(x, y) < END and all(other.away(x, y) > room for other in others)


def _driven(b: SceneBuilder, x: float, y: float) -> bool:
    """Whether a place is on the own car's path."""
    main = b.ground.streets[0]
    u, lateral = main.locate(x, y)
    return abs(lateral + main.offset) < 2.6 and abs(u) < 30


def park(b: SceneBuilder, kind: Kind, street: Street, side: int) -> None:
    """Cars along the kerb, partly on it, with free places between; or side by side, facing the kerb."""
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
        if not _clear(b, street, x, y, 5.0) or math.hypot(x, y) < CLEAR or _driven(b, x, y):
            continue
        if not draws.chance(taken):
            continue
        along = heading + (0 if side < 0 else math.pi)
        if draws.chance(0.04) and not nose_in:
            vehicles.truck(b, x, y, along)
            u += 4
        else:
            vehicles.car(b, x, y, along + nose_in * math.pi / 2 * draws.side() + draws.normal(0, 0.03))


def furnish(b: SceneBuilder, street: Street, side: int) -> None:
    """Lamp posts, signs, rows of trees, bollards, bins and bicycles along the kerb."""
    draws = b.draws
    edge = street.half_width + min(0.5, street.pavement / 2 + 0.2)
    u, spacing, alley = max(-END, street.start) + draws.uniform(0, 25), draws.uniform(14, 32), draws.chance(0.3)
    while u < min(END, street.stop):
        x, y, heading = street.place(u, side * edge)
        if _clear(b, street, x, y, 0.6):
            if draws.chance(0.7):
                props.pole(b, x, y)
            if draws.chance(0.5):
                shift = draws.uniform(-1, 1)
                sx, sy, _ = street.place(u + shift, side * (edge + 0.2))
                props.sign(b, sx, sy, heading + (math.pi if side < 0 else 0) + draws.normal(0, 0.15))
            if alley:
                tx, ty, _ = street.place(u + spacing / 2, side * (edge + 0.3))
                if free(b, tx, ty, -street.pavement):
                    props.tree(b, tx, ty, draws.uniform(0.8, 1.4))
        u += spacing * draws.uniform(0.7, 1.3)
    if street.pavement > 0:
        _clutter(b, street, side, edge)


def _clutter(b: SceneBuilder, street: Street, side: int, edge: float) -> None:
    """Small things on the pavement."""
    draws = b.draws
    if draws.chance(0.25):
        start = draws.uniform(-30, 20)
        for step in range(draws.whole(3, 8)):
            x, y, _ = street.place(start + 2.2 * step, side * (edge - 0.1))
            if _clear(b, street, x, y, 0.5):
                props.bollard(b, x, y)
    for _ in range(draws.poisson(2.0)):
        x, y, heading = street.place(draws.uniform(-40, 40), side * (edge + street.pavement - 0.4))
        if _clear(b, street, x, y, 0.5):
            draws.pick((props.bin_, vehicles.bicycle, props.cabinet), (0.5, 0.25, 0.25))(b, x, y, heading)


def drive(b: SceneBuilder, kind: Kind, main: Street) -> None:
    """Moving vehicles: ahead and behind in the own lane, oncoming in the other."""
    draws = b.draws
    for _ in range(draws.poisson(kind.traffic)):
        own = draws.chance(0.5)
        u = draws.uniform(8, 65) * (1 if draws.chance(0.6) else -1)
        if not main.start < u < main.stop:
            continue
        x, y, heading = main.place(u, (-1 if own else 1) * main.half_width / 2)
        build = vehicles.truck if draws.chance(0.1) else vehicles.car
        build(b, x, y, heading + (0 if own else math.pi), moving=True)


def walk(b: SceneBuilder, kind: Kind, main: Street) -> None:
    """People on the pavements, cyclists on the carriageway."""
    draws = b.draws
    for _ in range(draws.poisson(kind.people)):
        lateral = draws.side() * (main.half_width + draws.uniform(0.3, max(main.pavement, 0.6)))
        x, y, heading = main.place(draws.uniform(-35, 35), lateral)
        if math.hypot(x, y) > CLEAR:
            props.person(b, x, y, heading + math.pi * draws.chance(0.5), moving=draws.chance(0.7))
    for _ in range(draws.poisson(0.25 * kind.people)):
        side = draws.side()
        x, y, heading = main.place(draws.uniform(6, 40) * draws.side(), side * (main.half_width - 0.7))
        props.cyclist(b, x, y, heading + math.pi * (side > 0))


def guard(b: SceneBuilder, main: Street) -> None:
    """Guard rails on both sides."""
    for side in (1, -1):
        for u in range(-80, 80, 8):
            x, y, heading = main.place(u + 4, side * (main.half_width + 0.8))
            ground = b.level(x, y)
            rail = Boxes(x, y, heading, 8.1, 0.12, ground + 0.45, ground + 0.78)
            b.add(rail, "fence", "metal", albedo=0.4)
