"""How fast the simulator is: scans per second on one core (it uses no more), and where the time
goes.

Times are the process's own, so that what else runs on the machine counts for little.

python benchmarks/simulator.py --scans 40
"""

import argparse
import time
from collections.abc import Callable

import numpy as np

from r2flow.base.noise import generator
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.simulator import draw_scene, simulate
from r2flow.simulator.lasers import Rays, lasers_of
from r2flow.simulator.raycast import cast
from r2flow.simulator.returns import report


def milliseconds(work: Callable[[int], object], times: int) -> float:
    """Median processor time of work(0), work(1), ... after one unmeasured call."""
    work(0)
    taken = []
    for index in range(times):
        start = time.process_time()
        work(index)
        taken.append(time.process_time() - start)
    return 1e3 * float(np.median(taken))


def parts(sensor: Sensor, times: int) -> dict[str, float]:
    """Median milliseconds of drawing the scene, of casting its rays and of what the sensor makes of
    them.
    """
    rays = Rays(lasers_of(sensor), sensor.columns, sensor.height)
    scenes = [draw_scene(generator(0, "simulator", index)) for index in range(times)]
    rng = np.random.default_rng(0)
    hits = [cast(scene, rays, rng) for scene in scenes]
    return {
        "scene": milliseconds(lambda index: draw_scene(generator(0, "simulator", index)), times),
        "rays": milliseconds(lambda index: cast(scenes[index], rays, rng), times),
        "returns": milliseconds(
            lambda index: report(sensor, rays, hits[index], scenes[index].rig, rng), times
        ),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=40, help="scans per measurement")
    times = parser.parse_args().scans
    sensors = [sensor for _, sensor in SENSORS.items()]
    sensors.insert(1, SENSORS["hdl64e"].resized(32, 256))
    print(f"{'sensor':12s} {'size':>10s} {'ms':>7s} {'scans/s':>8s}   scene   rays  returns (ms)")
    for sensor in sensors:
        whole = milliseconds(lambda index, sensor=sensor: simulate(sensor, 0, index), times)
        share = parts(sensor, times)
        size = "x".join(map(str, sensor.shape))
        print(
            f"{sensor.name:12s} {size:>10s} {whole:7.1f} {1e3 / whole:8.1f} "
            f"{share['scene']:7.1f} {share['rays']:6.1f} {share['returns']:8.1f}"
        )


if __name__ == "__main__":
    main()
