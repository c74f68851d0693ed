"""Kinds of places, and their random ground plans: streets and uneven ground."""

import math
from typing import NamedTuple

import numpy as np

from r2flow.lidar.labels import LABELS
from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.ground import Ground, Patch, Street
from r2flow.simulator.materials import INDEX, MATERIALS

Span = tuple[float, float]


class Kind(NamedTuple):
    share: float  # share of scenes
    half_width: Span  # half of the carriageway in metres, from and to
    pavement: Span  # width of the pavement in metres, from and to
    setback: Span  # distance of the houses from the pavement in metres, from and to
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


KINDS = {
    "residential": Kind(
        share=0.45, half_width=(2.3, 3.5), pavement=(1.0, 2.0), setback=(0.5, 4.5), gap=6.0, storeys=(2, 3),
        built=0.70, parked=0.43, plants=8.75, hedges=0.60, fences=0.30, people=1.5, traffic=1.3,
        paved=0.4, crossing=0.75,
    ),
    "urban": Kind(
        share=0.22, half_width=(3.2, 5.5), pavement=(1.8, 4.0), setback=(0.0, 3.0), gap=5.0, storeys=(3, 5),
        built=0.81, parked=0.47, plants=5.0, hedges=0.08, fences=0.10, people=5.0, traffic=2.7, paved=1.0, crossing=0.8,
    ),
    "suburb": Kind(
        share=0.25, half_width=(2.3, 3.4), pavement=(0.0, 2.0), setback=(2.0, 7.0), gap=12.0, storeys=(1, 2),
        built=0.61, parked=0.27, plants=10, hedges=0.60, fences=0.22, people=0.6, traffic=1.0, paved=0.2, crossing=0.6,
    ),
    "highway": Kind(
        share=0.08, half_width=(6.0, 9.0), pavement=(0.0, 0.0), setback=(14.0, 30.0), gap=30.0, storeys=(1, 4),
        built=0.44, parked=0.0, plants=6.25, hedges=0.0, fences=0.0, people=0.0, traffic=5.0, paved=0.0, crossing=0.0,
    ),
}  # fmt: skip


def draw_ground(draws: ScalarDraws, name: str) -> Ground:
    """Draw the ground of a place of this kind: streets, slopes and surfaces."""
    kind = KINDS[name]
    streets = _streets(draws, kind, straight=name == "highway")
    main = streets[0]
    steep = 0.7 if kind.setback[1] > 10 else 0.3
    bank_left, bank_right = (draws.normal(0.3, 0.8) if draws.chance(steep) else 0.0 for _ in range(2))
    paved = draws.chance(kind.paved)
    verge = (LABELS["other-ground"], INDEX["paving"]) if paved else (LABELS["terrain"], INDEX["grass"])
    albedo = [min(max(draws.normal(m.albedo, m.spread), 0.01), 0.99) for m in MATERIALS]
    return Ground(
        waves=tuple(_wave(draws, *wave) for wave in _WAVES),
        lean=(draws.normal(0.013, 0.005), draws.normal(-0.003, 0.018)),
        drop=draws.normal(0.05, 0.02),
        streets=streets,
        kerb=draws.uniform(0.05, 0.14) if main.pavement > 0 else 0.0,
        tufts=0.0 if paved else draws.uniform(*TUFTS),
        banks=(bank_left, bank_right),
        verge=verge,
        patches=_drives(draws, main) if main.pavement > 0 else (),
        albedo=np.array(albedo, dtype=np.float32),
    )


TUFTS = 0.02, 0.18  # metres: height of grass and rubble on verges, from and to

# Length and height in metres of the waves of the ground.
_WAVES = ((7.0, 0.012), (16.0, 0.03), (38.0, 0.07), (80.0, 0.20), (170.0, 0.40))


def _wave(draws: ScalarDraws, length: float, height: float) -> tuple[float, float, float, float]:
    number, turn = 2 * math.pi / (length * draws.uniform(0.8, 1.25)), draws.uniform(0, 2 * math.pi)
    amplitude = height * draws.uniform(0.3, 1.5)
    return amplitude, number * math.cos(turn), number * math.sin(turn), draws.uniform(0, 2 * math.pi)


def _streets(draws: ScalarDraws, kind: Kind, straight: bool) -> tuple[Street, ...]:
    """The street of the car, which drives on its right half, and possibly a crossing or joining street."""
    half = draws.uniform(*kind.half_width)
    lines = (0.0, half - 0.3, 0.3 - half) if straight or draws.chance(0.35) else ()
    main = Street(
        heading=draws.normal(0, 0.35 if draws.chance(0.25) else 0.05),
        offset=half / 2 * draws.uniform(0.6, 1.05),
        curvature=draws.normal(0, 0.0008 if straight else 0.0035),
        half_width=half,
        pavement=draws.uniform(*kind.pavement),
        lines=lines,
    )
    return _crossed(draws, main) if draws.chance(kind.crossing) else (main,)


def _crossed(draws: ScalarDraws, main: Street) -> tuple[Street, ...]:
    """A crossroads, a side street, or a main street that ends at another street."""
    at, half = draws.uniform(-40, 50), draws.uniform(2.6, 4.5)
    across = Street(
        heading=math.pi / 2 + draws.normal(0, 0.2), offset=-at, curvature=draws.normal(0, 0.0025),
        half_width=half, pavement=draws.uniform(1.2, 2.5),
    )  # fmt: skip
    form = draws.pick(("cross", "left", "right", "end"), (0.4, 0.2, 0.2, 0.2))
    for _ in range(20):  # to where the centre lines cross, `at` along the first and `middle` along the other
        middle, _ = across.locate(*main.place(at, 0.0)[:2])
        at, _ = main.locate(*across.place(middle, 0.0)[:2])
    joins = abs(main.locate(*across.place(middle, 0.0)[:2])[1]) < main.half_width  # else they run side by side
    if form == "end" and joins and abs(at) > 12:
        return (main._replace(stop=at) if at > 0 else main._replace(start=at)), across
    if form == "left" and joins:
        across = across._replace(start=middle)
    elif form == "right" and joins:
        across = across._replace(stop=middle)
    return main, across


def _drives(draws: ScalarDraws, main: Street) -> tuple[Patch, ...]:
    out = []
    for _ in range(draws.whole(1, 5)):
        length, width = draws.uniform(2.5, 9), draws.uniform(4, 10)
        lateral = draws.side() * (main.half_width + main.pavement + width / 2)
        x, y, heading = main.place(draws.uniform(-40, 40), lateral)
        out.append(Patch(x, y, heading, length, width))
    return tuple(out)
