"""What storing a flow's matrices in half precision changes: its velocity, and the scans that it draws.

Both are held against the flow in float32, from the same noise. The yardstick is the solver: what twice as many steps
change in the scans.

python benchmarks/half_precision.py runs/street
"""

import argparse
import copy
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from r2flow.generators import Flow, as_flow
from r2flow.metrics.fidelity import distances, panel
from r2flow.model.checkpoint import large_matrices, load_checkpoint
from r2flow.model.sampling import sample
from r2flow.noise import Draws
from r2flow.reports.tables import print_table

TIMES = (0.0, 0.5, 0.9, 0.98)


def rounded(flow: Flow, kind: torch.dtype) -> Flow:
    """The flow with its large matrices rounded to a type, computing in float32 as before."""
    other = copy.deepcopy(flow)
    for name in large_matrices(other):
        value = other.get_parameter(name)
        value.data = value.data.to(kind).to(value.dtype)
    return other


@torch.inference_mode()
def velocity_error(flow: Flow, other: Flow, x_0: Tensor, x_1: Tensor) -> dict[str, float]:
    """|v' - v| / |v| over all scans, at points between noise and the flow's own scans."""
    found = {}
    for t in TIMES:
        time, x = torch.tensor(t), (1 - t) * x_0 + t * x_1
        v = flow.velocity(time, x)
        found[f"v at {t:g}"] = float((other.velocity(time, x) - v).norm() / v.norm())
    return found


def scan_error(images: np.ndarray, others: np.ndarray) -> dict[str, float]:
    """What differs in metres and in reflectance where both have a return, and where only one has."""
    both = (images[:, 0] > 0) & (others[:, 0] > 0)
    change = np.abs(images - others)
    r = images[:, 0][both]
    metres = change[:, 0][both]
    found = {"median, mm": float(1e3 * np.median(metres)), "90 %, mm": float(1e3 * np.quantile(metres, 0.9))}
    found |= {"median, % of range": float(100 * np.median(metres / r))}
    if images.shape[1] > 1:
        found["reflectance, median"] = float(np.median(change[:, 1][both]))
    return {**found, "dropped in one, %": float(100 * ((images[:, 0] > 0) != (others[:, 0] > 0)).mean())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", help="a run folder or a checkpoint in float32")
    parser.add_argument("--num", type=int, default=8, help="scans")
    arguments = parser.parse_args()
    loaded = load_checkpoint(arguments.checkpoint)
    flow = as_flow(loaded.generator, "the velocity's error")
    x_0 = Draws(0, range(arguments.num)).start(flow.noise_shape)
    x_1 = flow.generate(x_0).x

    def scans(of: Flow, **how: int) -> np.ndarray:
        return np.concatenate([drawn.images.numpy() for drawn in sample(of, arguments.num, **how)])

    plain = scans(flow)
    truth = panel(plain, loaded.sensor)
    others = {"float16": rounded(flow, torch.float16), "bfloat16": rounded(flow, torch.bfloat16)}
    drawn: Mapping[str, np.ndarray] = {name: scans(other) for name, other in others.items()}
    drawn = {**drawn, "twice the steps": scans(flow, steps=2 * flow.sampler.steps)}
    rows = []
    for name, images in drawn.items():
        velocity = velocity_error(flow, others[name], x_0, x_1) if name in others else {}
        mean = float(np.mean(list(distances(truth, panel(images, loaded.sensor)).values())))
        rows.append({"": name, **velocity, **scan_error(plain, images), "panel's mean": mean})
    columns = {key: key for key in rows[0]}
    print_table([{key: row.get(key, float("nan")) for key in columns} for row in rows], columns)


if __name__ == "__main__":
    main()
