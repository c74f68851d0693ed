"""Street scenes, ray-cast: LiDAR scans with labels, as many as one wants, from a seed.

`simulate(SENSORS["hdl64e"], seed=1, index=0).image` is range in metres and reflectance, (2, 64, 1024).
"""

from dataclasses import dataclass

import numpy as np

from r2flow.lidar.sensors import Sensor
from r2flow.noise import generator
from r2flow.simulator.lasers import lasers_of
from r2flow.simulator.raycast import cast
from r2flow.simulator.rays import Rays
from r2flow.simulator.returns import report
from r2flow.simulator.scene import Scene
from r2flow.simulator.streets import draw_scene

REVISION = 2  # of what is drawn: another number for every change after which a seed gives other scans


@dataclass(frozen=True)
class SimulatedScan:
    """One scan.

    Attributes:
        image: Range in metres and reflectance in [0, 1], (2, H, W), float32; 0 where missing.
        labels: SemanticKITTI ids, (H, W), uint16; 0 where missing.
    """

    image: np.ndarray
    labels: np.ndarray


def simulate(sensor: Sensor, seed: int, index: int) -> SimulatedScan:
    """Scan `index` of the run `seed`: a function of these alone, whoever computes it.

    The scene is drawn before anything of the sensor, so that all sensors see the same places.
    """
    rng = generator(seed, "simulator", index)
    return observe(draw_scene(rng), sensor, rng)


def observe(scene: Scene, sensor: Sensor, rng: np.random.Generator) -> SimulatedScan:
    """The scan that a sensor, at its usual height above the scene's origin, makes of a scene."""
    rays = Rays(lasers_of(sensor), sensor.columns, sensor.height)
    image, labels = report(sensor, rays, cast(scene, rays, rng), scene.rig, rng)
    return SimulatedScan(image, labels)


__all__ = ["REVISION", "Scene", "SimulatedScan", "draw_scene", "observe", "simulate"]
