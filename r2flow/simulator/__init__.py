"""Simulated LiDAR scans with labels: procedural street scenes, ray-cast.

`simulate("hdl64e", seed=1, index=0).image` is range in metres and reflectance, (2, 64, 1024).
"""

from dataclasses import dataclass

import numpy as np

from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.noise import generator
from r2flow.simulator import roadside
from r2flow.simulator.draws import ScalarDraws
from r2flow.simulator.kinds import KINDS, draw_ground
from r2flow.simulator.lasers import RIGS, Rays, lasers_of
from r2flow.simulator.raycast import cast
from r2flow.simulator.returns import report
from r2flow.simulator.scene import Scene, SceneBuilder

REVISION = 4  # of the scans: incremented with every change of the scans of a seed


@dataclass(frozen=True)
class SimulatedScan:
    """A simulated scan with labels."""

    image: np.ndarray  # range in metres and reflectance in [0, 1], (2, H, W), float32; 0 where missing
    labels: np.ndarray  # SemanticKITTI ids, (H, W), uint16; 0 where missing


def simulate(sensor: Sensor | str, seed: int, index: int) -> SimulatedScan:
    """Scan `index` of `seed`, a function of sensor, seed and index only, bit-identical on every machine.

    The scene is drawn before anything that depends on the sensor, so that all sensors scan the same scenes.
    """
    rng = generator(seed, "simulator", index)
    return observe(draw_scene(rng), named_sensor(sensor), rng)


def draw_scene(rng: np.random.Generator) -> Scene:
    """Draw a scene of a kind in `kinds.KINDS`, chosen by their shares."""
    draws = ScalarDraws(rng)
    name = draws.pick(list(KINDS), [k.share for k in KINDS.values()])
    b, k = SceneBuilder(draw_ground(draws, name), draws), KINDS[name]
    streets = b.ground.streets
    for street in streets:
        for side in (1, -1):
            roadside.line_front(b, k, street, side)
            roadside.park(b, k, street, side)
            roadside.furnish(b, street, side)
        roadside.close_street(b, street)
    roadside.close_view(b)
    roadside.drive(b, k, streets[0])
    roadside.walk(b, k, streets[0])
    if name == "highway":
        roadside.guard(b, streets[0])
    return b.build(rig=draws.pick(range(len(RIGS)), (0.7, 0.3)))


def observe(scene: Scene, sensor: Sensor, rng: np.random.Generator) -> SimulatedScan:
    """Scan a scene with a sensor at its default height above the scene's origin."""
    rays = Rays(lasers_of(sensor), sensor.columns, sensor.height)
    return SimulatedScan(*report(sensor, rays, cast(scene, rays, rng), scene.rig, rng))
