"""Procedural street scenes around a car that drives along x."""

import numpy as np

from r2flow.simulator import fronts, roadside
from r2flow.simulator.ego import RIGS
from r2flow.simulator.kinds import KINDS, draw_ground
from r2flow.simulator.scalar_draws import ScalarDraws
from r2flow.simulator.scene import Scene, SceneBuilder


def draw_scene(rng: np.random.Generator) -> Scene:
    """A scene of one of `kinds.KINDS`, drawn by their shares."""
    draws = ScalarDraws(rng)
    name = draws.pick(list(KINDS), [k.share for k in KINDS.values()])
    b, k = SceneBuilder(draw_ground(draws, name), draws), KINDS[name]
    streets = b.ground.streets
    for street in streets:
        for side in (1, -1):
            fronts.line_front(b, k, street, side)
            roadside.park(b, k, street, side)
            roadside.furnish(b, street, side)
        fronts.close_street(b, street)
    fronts.close_view(b)
    roadside.drive(b, k, streets[0])
    roadside.walk(b, k, streets[0])
    if name == "highway":
        roadside.guard(b, streets[0])
    return b.build(rig=draws.pick(range(len(RIGS)), (0.7, 0.3)))
