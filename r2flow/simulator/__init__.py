"""Simulated LiDAR scans with labels: procedural street scenes, ray-cast.

`simulate("hdl64e", seed=1, index=0).image` is range in metres and reflectance, (2, 64, 1024).
"""

from dataclasses import dataclass

import numpy as np

from r2flow.base.noise import generator
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.simulator.lasers import Rays, lasers_of
from r2flow.simulator.raycast import cast
from r2flow.simulator.returns import report
from r2flow.simulator.roadside import StreetBuilder
from r2flow.simulator.scene import Scene

REVISION = 4  # of the scans: incremented with every change of the scans of a seed


@dataclass(frozen=True)
class SimulatedScan:
    """A simulated scan with labels."""

    # range in metres and reflectance in [0, 1], (2, H, W), float32; 0 where missing
    image: np.ndarray
    labels: np.ndarray  # SemanticKITTI ids, (H, W), uint16; 0 where missing


def simulate(sensor: Sensor | str, seed: int, index: int) -> SimulatedScan:
    """Scan `index` of `seed`: a function of sensor, seed and index, the same bits on every machine.

    The scene is drawn before anything that depends on the sensor, so that all sensors scan the same
    scenes.
    """
    rng = generator(seed, "simulator", index)
    return _observe(draw_scene(rng), named_sensor(sensor), rng)


def draw_scene(rng: np.random.Generator) -> Scene:
    """Draw a scene of a kind in `kinds.KINDS`, chosen by their shares."""
    return StreetBuilder(rng).draw()


def _observe(scene: Scene, sensor: Sensor, rng: np.random.Generator) -> SimulatedScan:
    """Scan a scene with a sensor at its default height above the scene's origin."""
    rays = Rays(lasers_of(sensor), sensor.columns, sensor.height)
    return SimulatedScan(*report(sensor, rays, cast(scene, rays, rng), scene.rig, rng))
