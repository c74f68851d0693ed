"""Kinds of places, and their random ground plans: streets and uneven ground."""

from math import cos, pi, sin, tau
from typing import NamedTuple

import numpy as np

from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.ground import Ground
from r2flow.simulator.materials import MATERIALS
from r2flow.simulator.scene import SceneBuilder
from r2flow.simulator.streets import Footprint, Street
from r2flow.simulator.tables import TABLES

_Span = tuple[float, float]


class Kind(NamedTuple):
    """A kind of place, as the distributions that its streets are drawn from."""

    share: float  # share of scenes
    half_width: _Span  # half of the carriageway in metres, from and to
    pavement: _Span  # width of the pavement in metres, from and to
    setback: _Span  # distance of the houses from the pavement in metres, from and to
    gap: float  # mean gap between houses in metres
    storeys: tuple[int, int]  # from and to
    built: float  # share of plots with a house; the others are green
    parked: float  # share of the kerb taken by parked cars
    plants: float  # trees and bushes per 10 metres of front
    hedges: float  # share of fronts with a hedge
    fences: float  # share of fronts with a fence or wall
    people: float  # mean number of people
    traffic: float  # mean number of moving vehicles
    paved: float  # probability that the ground between pavement and houses is paved, not lawn
    crossing: float  # probability of a crossing street
    highway: bool = False  # whether the street is straight, with lines and guard rails


KINDS = tuple(Kind(**kind) for kind in TABLES["kinds"].values())

_TUFTS = 0.02, 0.18  # metres: height of grass and rubble on verges, from and to

# Length and height in metres of the waves of the ground.
_WAVES = ((7.0, 0.012), (16.0, 0.03), (38.0, 0.07), (80.0, 0.20), (170.0, 0.40))


def draw_ground(draws: SceneBuilder, kind: Kind) -> Ground:
    """Draw the ground of a place of this kind: streets, slopes and surfaces."""
    streets = _streets(draws, kind)
    main = streets[0]
    steep = 0.7 if kind.setback[1] > 10 else 0.3
    banks = [draws.normal(0.3, 0.8) if draws.chance(steep) else 0.0 for _ in range(2)]
    paved = draws.chance(kind.paved)
    albedo = [draws.albedo(name) for name in MATERIALS]
    return Ground(
        waves=tuple(_wave(draws, *wave) for wave in _WAVES),
        lean=(draws.normal(0.013, 0.005), draws.normal(-0.003, 0.018)),
        drop=draws.normal(0.05, 0.02),
        streets=streets,
        kerb=draws.uniform(0.05, 0.14) if main.pavement > 0 else 0.0,
        tufts=0.0 if paved else draws.uniform(*_TUFTS),
        banks=(banks[0], banks[1]),
        paved=paved,
        yards=_drives(draws, main) if main.pavement > 0 else (),
        albedo=np.array(albedo, np.float32),
    )


def _wave(draws: ScalarDraws, length: float, height: float) -> tuple[float, float, float, float]:
    number = tau / (length * draws.uniform(0.8, 1.25))
    turn = draws.uniform(0, tau)
    return (
        height * draws.uniform(0.3, 1.5),
        number * cos(turn),
        number * sin(turn),
        draws.uniform(0, tau),
    )


def _streets(draws: ScalarDraws, kind: Kind) -> tuple[Street, ...]:
    """The street of the car, which drives on its right half, and possibly a crossing or joining
    street.
    """
    half = draws.uniform(*kind.half_width)
    lines = (0.0, half - 0.3, 0.3 - half) if kind.highway or draws.chance(0.35) else ()
    main = Street(
        heading=draws.normal(0, 0.35 if draws.chance(0.25) else 0.05),
        offset=half / 2 * draws.uniform(0.6, 1.05),
        curvature=draws.normal(0, 0.0008 if kind.highway else 0.0035),
        half_width=half,
        pavement=draws.uniform(*kind.pavement),
        lines=lines,
    )
    return _crossed(draws, main) if draws.chance(kind.crossing) else (main,)


def _crossed(draws: ScalarDraws, main: Street) -> tuple[Street, ...]:
    """A crossroads, a side street, or a main street that ends at another street."""
    at = draws.uniform(-40, 50)
    half = draws.uniform(2.6, 4.5)
    across = Street(
        heading=pi / 2 + draws.normal(0, 0.2),
        offset=-at,
        curvature=draws.normal(0, 0.0025),
        half_width=half,
        pavement=draws.uniform(1.2, 2.5),
    )
    form = draws.pick(("cross", "left", "right", "end"), (0.4, 0.2, 0.2, 0.2))
    # to where the centre lines cross, `at` along the first and `middle` along the other
    for _ in range(20):
        middle, _ = across.locate(*main.place(at, 0.0)[:2])
        at, lateral = main.locate(*across.place(middle, 0.0)[:2])
    if abs(lateral) >= main.half_width:  # they run side by side
        return main, across
    if form == "end" and abs(at) > 12:
        return (main._replace(stop=at) if at > 0 else main._replace(start=at)), across
    if form == "left":
        across = across._replace(start=middle)
    if form == "right":
        across = across._replace(stop=middle)
    return main, across


def _drives(draws: ScalarDraws, main: Street) -> tuple[Footprint, ...]:
    out = []
    for _ in range(draws.whole(1, 5)):
        length = draws.uniform(2.5, 9)
        width = draws.uniform(4, 10)
        lateral = draws.side() * (main.half_width + main.pavement + width / 2)
        out.append(Footprint(main.place(draws.uniform(-40, 40), lateral), length, width))
    return tuple(out)
