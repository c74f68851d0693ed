"""What is behind the pavement: houses, their gardens, gaps, greens, car parks."""

import math

from r2flow.simulator import props, vehicles
from r2flow.simulator.ground import Street
from r2flow.simulator.kinds import Kind
from r2flow.simulator.scene import SceneBuilder

END = 82.0  # metres: nothing is built farther from the sensor
CLEAR = 3.2  # metres around the sensor that stay empty


def free(b: SceneBuilder, x: float, y: float, room: float) -> bool:
    """Whether a place is `room` metres off all carriageways and pavements, within reach and not too near."""
    if not CLEAR < math.hypot(x, y) < END + 5:
        return False
    pavement = max(street.pavement for street in b.ground.streets)
    return bool(b.ground.off_street(x, y) > pavement + room)


def line_front(b: SceneBuilder, kind: Kind, street: Street, side: int) -> None:
    """Plots one after another along one side of a street."""
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
    """A house, where there is room, and something behind it that limits the view."""
    draws = b.draws
    width, middle = draws.uniform(8, 12), u + length / 2
    x, y, heading = street.place(middle, side * (edge + width / 2))
    corners = [street.place(v, side * (edge + w)) for v in (u, u + length) for w in (0, width)]
    if not all(free(b, px, py, 0.3) for px, py, _ in (*corners, (x, y, 0))):
        return False
    height = 2.9 * draws.whole(*kind.storeys) + 0.3
    props.house(b, x, y, heading + draws.normal(0, 0.03), length, width, height)
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
            props.hedge(b, x, y, heading, length * draws.uniform(0.5, 1.0), draws.uniform(0.8, 2.4))
        elif draws.chance(kind.fences):
            props.fence(b, x, y, heading, length * draws.uniform(0.5, 1.0))
    for _ in range(draws.poisson(kind.plants * length / 10)):
        out = edge + draws.uniform(0.3, max(back - 0.4, 0.6))
        _plant(b, *street.place(u + draws.uniform(0, length), side * out)[:2])


def _plant(b: SceneBuilder, x: float, y: float) -> None:
    if not free(b, x, y, 0.2):
        return
    if b.draws.chance(0.5):
        props.tree(b, x, y, b.draws.uniform(0.7, 1.3))
    else:
        props.bush(b, x, y, b.draws.uniform(0.5, 1.3))


def green(b: SceneBuilder, street: Street, side: int, u: float, length: float, edge: float) -> None:
    """A plot without a house: trees, bushes, thickets."""
    draws = b.draws
    if draws.chance(0.35):
        x, y, heading = street.place(u + length / 2, side * (edge + draws.uniform(0.5, 3)))
        if all(free(b, x + d * math.cos(heading), y + d * math.sin(heading), 0.1) for d in (-length / 2, length / 2)):
            props.hedge(b, x, y, heading, length, draws.uniform(1.0, 2.6))
    for _ in range(draws.poisson(length / 2.2)):
        _plant(b, *street.place(u + draws.uniform(0, length), side * (edge + draws.uniform(0.3, 14)))[:2])
    for _ in range(draws.poisson(length / 6)):
        x, y, _ = street.place(u + draws.uniform(0, length), side * (edge + draws.uniform(7, 22)))
        if free(b, x, y, 3.5):
            props.thicket(b, x, y)


def _gap(b: SceneBuilder, street: Street, side: int, u: float, gap: float, lateral: float) -> None:
    """Between two houses: a gate or wall, and trees behind."""
    draws = b.draws
    x, y, heading = street.place(u + gap / 2, side * (lateral + 0.5))
    if draws.chance(0.4) and free(b, x, y, gap / 2):
        props.fence(b, x, y, heading, gap * 0.9)
    green(b, street, side, u, gap, lateral + 2)


def _car_park(b: SceneBuilder, street: Street, side: int, middle: float, edge: float) -> None:
    """Two rows of cars at right angles to the street, on the green."""
    draws = b.draws
    for row in (3.5, 11.0):
        for slot in range(-3, 4):
            x, y, heading = street.place(middle + 2.7 * slot, side * (edge + row))
            if draws.chance(0.6) and free(b, x, y, 2.5) and math.hypot(x, y) > CLEAR + 2:
                vehicles.car(b, x, y, heading + math.pi / 2 * draws.side() + draws.normal(0, 0.03))
    beyond(b, street, side, middle, edge + 10)


def beyond(b: SceneBuilder, street: Street, side: int, middle: float, lateral: float) -> None:
    """The second row: a house or tall trees that limit the view."""
    draws = b.draws
    x, y, heading = street.place(middle + draws.uniform(-8, 8), side * (lateral + draws.uniform(12, 28)))
    if draws.chance(0.5) and free(b, x, y, 9):
        props.house(b, x, y, heading, draws.uniform(10, 20), draws.uniform(8, 11), draws.uniform(6, 12))
    elif free(b, x, y, 4):
        props.thicket(b, x, y)


def close_street(b: SceneBuilder, street: Street) -> None:
    """Houses or trees across the far ends, as where streets bend out of sight."""
    draws = b.draws
    for end, limit in ((-1, street.start), (1, street.stop)):
        if abs(limit) < END:
            continue
        x, y, heading = street.place(end * draws.uniform(50, 76), draws.normal(0, 3))
        if draws.chance(0.45):
            props.house(b, x, y, heading + math.pi / 2, draws.uniform(14, 26), 9, draws.uniform(6, 11))
        elif draws.chance(0.75):
            for _ in range(draws.whole(1, 3)):
                props.thicket(b, x + draws.normal(0, 3), y + draws.normal(0, 6))


def close_view(b: SceneBuilder) -> None:
    """Woods and houses far away on all sides, wherever there is no street."""
    draws = b.draws
    for _ in range(22):
        turn, away = draws.uniform(-math.pi, math.pi), draws.uniform(38, 78)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if draws.chance(0.3) and free(b, x, y, 12):
            props.house(b, x, y, draws.uniform(0, math.pi), draws.uniform(12, 24), 9, draws.uniform(5, 11))
        elif free(b, x, y, 6):
            props.woods(b, x, y)
