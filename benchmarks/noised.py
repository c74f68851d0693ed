"""At which times a flow's scans lose their likeness: held-out scans are noised to a time and drawn on from there.

Of x_t = t x_1 + (1 - t) x_0 with a held-out x_1, the sampler `sde` goes on from t to 1. For the exact velocity the end
has the distribution of the held-out scans at any t, so its distance to other held-out scans is then that of the
held-out scans themselves (t = 1). What it is more, the network's velocity between t and 1 has done. Beside it the
range error of the network's x_1hat = x_t + (1 - t) v(t, x_t) where a ray has a return, in units of the noise, 1 - t.

python benchmarks/noised.py street --num 128
"""

import argparse
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.grids import build_grid
from r2flow.flow.stochastic import CHURN, sde
from r2flow.generators import Flow, as_flow
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.fidelity import distances, panel
from r2flow.model.checkpoint import load_checkpoint
from r2flow.noise import Draws
from r2flow.progress import track
from r2flow.reports.tables import print_table
from r2flow.simulator import simulate

LINES = ("gradient, azimuth", "gradient, elevation", "steps by sector", "surface normals")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="a model, a run folder or a checkpoint")
    parser.add_argument("--num", type=int, default=128, help="scans to noise, of seed 3000")
    parser.add_argument("--real", type=int, default=512, help="scans to compare them with, of seed 2000")
    parser.add_argument("--times", default="0,0.5,0.7,0.85,0.92,0.96,0.98", help="where to go on from")
    parser.add_argument("--batch", type=int, default=8)
    arguments = parser.parse_args()
    loaded = load_checkpoint(arguments.checkpoint)
    flow = as_flow(loaded.generator, "the velocity's error")

    def scans(seed: int, num: int) -> np.ndarray:
        return np.stack([simulate(loaded.sensor, seed, i).image for i in range(num)])

    truth, held = panel(scans(2000, arguments.real), loaded.sensor), scans(3000, arguments.num)
    x_1, returned = loaded.encoding.encode(torch.from_numpy(held).float()), torch.from_numpy(held[:, 0] > 0)
    grid = build_grid("power:2.5", 0.0, 1 - 1 / 128, 31)  # that of `sde`, 32 steps
    rows = [row(truth, held, loaded.sensor, {"from t =": 1.0})]
    for wanted in track([float(t) for t in arguments.times.split(",")], "times"):
        times = torch.cat([grid[grid >= wanted - 1e-9], grid.new_ones(1)])
        ends, errors = [], []
        for first in range(0, arguments.num, arguments.batch):
            here = slice(first, first + arguments.batch)
            end, error = drawn_on(flow, x_1[here], times, Draws(0, range(arguments.num)[here]))
            ends.append(flow.space.decode(end))
            errors.append(error[:, 0][returned[here]])
        error = torch.cat(errors)
        found = {"from t =": float(times[0]), "steps": len(times) - 1}
        found |= {"x_1hat, rms": float(error.square().mean().sqrt()), "median": float(error.abs().median())}
        rows.append(row(truth, torch.cat(ends).numpy(), loaded.sensor, found))
    columns = {key: key for key in rows[-1]}
    print_table([{key: each.get(key, float("nan")) for key in columns} for each in rows], columns)


@torch.inference_mode()
def drawn_on(flow: Flow, x_1: Tensor, times: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
    """The end from the first of the times on, and the first estimate's error over 1 - t, both (B, C, H, W)."""
    field, t = flow.field(), float(times[0])
    x = t * x_1 + (1 - t) * draws.start(flow.noise_shape)

    def estimate(t: Tensor, x: Tensor) -> Tensor:
        return x + (1 - t) * field(t, x)

    error = (estimate(times[0].float(), x) - x_1) / (1 - t)
    *_, end = sde(estimate, x, times, CHURN, lambda j: draws.step(flow.noise_shape, j))
    return end, error


def row(
    truth: Mapping[str, np.ndarray], images: np.ndarray, sensor: Sensor, found: dict[str, float]
) -> dict[str, float]:
    lines = distances(panel(images, sensor), truth)
    return {**found, "panel's mean": float(np.mean(list(lines.values()))), **{name: lines[name] for name in LINES}}


if __name__ == "__main__":
    main()
