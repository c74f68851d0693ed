"""Whether the paper's ordering holds: 1-RF, 2-RF and 2-TD, on a plane with a known answer and on simulated scans.

    python benchmarks/ordering.py --out ordering          # about 20 minutes on two quiet cores
    python benchmarks/ordering.py --out ordering --only plane

Sizes, steps and seeds are the constants below, written down before the first run. An untrained flow is perfectly
straight, so straightness is read beside the distance to the data, and a 1-RF first has to beat controls that have
learned nothing.
"""

import argparse
import math
import subprocess
import sys
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from r2flow.data.datamodule import ScanDataModule
from r2flow.flow.solvers import Velocity, solve
from r2flow.flow.straightness import curvature
from r2flow.generators import Field
from r2flow.metrics.fidelity import controls, distances, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.noise import Draws
from r2flow.reports.pages import Page, write_page
from r2flow.reports.tables import table
from r2flow.reports.verdicts import all_above_0
from r2flow.stages import STAGES
from r2flow.stages.base import learning_rate_factor
from r2flow.stages.rectify import Rectify

ROOT = Path(__file__).resolve().parents[1]
SEEDS = (1, 2, 3)
MANY = 64  # Euler steps that stand for the flow's own end

# The plane: eight Gaussians on a circle.
MODES, RADIUS, SPREAD = 8, 2.0, 0.15
PLANE_STEPS = {"rectify": 6000, "reflow": 6000, "distill": 4000}
PLANE_BATCH, PLANE_PAIRS, PLANE_SAMPLES = 512, 40_000, 8192

# The scans: simulated, 16 x 128, a quarter of the demo's pixels, so that more of them are seen in the same time.
SCAN_RUN = [
    "experiment=demo", "sensor.rows=16", "sensor.columns=128", "data.batch_size=8", "data.scenes=1024",
    "chain.rf1.trainer.max_steps=2000", "chain.rf2.trainer.max_steps=1200", "chain.td2.trainer.max_steps=800",
    "chain.rf2.data.pairs.num=1000", "chain.td2.data.pairs.num=1000", "trainer.val_check_interval=400",
    "callbacks.pictures=null", "callbacks.curvature=null", "loggers=[csv]",
]  # fmt: skip
SCAN_SAMPLES = 64

# What the words below mean, in numbers.
STRAIGHTER = 0.5  # of the 1-RF's bend, at most
NO_WORSE = 1.15  # times the 1-RF's distance at many steps, at most
FAR_BETTER = 0.75  # of the other's distance, at most


class Plane(nn.Module):
    """v(t, x) on the plane, a multilayer perceptron; x is (B, 1, 1, 2)."""

    def __init__(self, width: int = 128) -> None:
        super().__init__()
        sizes = [2 + 1 + 8, width, width, width]
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.SiLU())]
        self.net = nn.Sequential(*layers, nn.Linear(width, 2))

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        flat = x.reshape(len(x), 2)
        t = t.expand(len(x))[:, None]
        waves = [wave(math.pi * k * t) for k in (1, 2, 3, 4) for wave in (torch.sin, torch.cos)]
        return self.net(torch.cat([flat, t, *waves], 1)).reshape(x.shape)


def plane_data(count: int, draw: torch.Generator) -> Tensor:
    """Points of the eight Gaussians, (count, 1, 1, 2)."""
    angle = 2 * math.pi * torch.randint(MODES, (count,), generator=draw) / MODES
    centre = RADIUS * torch.stack([angle.cos(), angle.sin()], 1)
    return (centre + SPREAD * torch.randn(count, 2, generator=draw)).reshape(-1, 1, 1, 2)


def plane_velocity(t: Tensor, x: Tensor) -> Tensor:
    """E[x_1 - x_0 | x_t = x], the exact answer that a 1-RF regresses to (paper, eq. 2 and its minimiser)."""
    angle = 2 * math.pi * torch.arange(MODES) / MODES
    centres = (RADIUS * torch.stack([angle.cos(), angle.sin()], 1)).to(x)
    flat, t = x.reshape(len(x), 1, 2), t.reshape(-1, 1, 1).to(x)
    variance = (1 - t) ** 2 + (t * SPREAD) ** 2
    weight = torch.softmax(-((flat - t * centres) ** 2).sum(2, keepdim=True) / (2 * variance), dim=1)
    slope = (t * SPREAD**2 - (1 - t)) / variance
    return (weight * (centres + slope * (flat - t * centres))).sum(1).reshape(x.shape)


def sliced_distance(a: Tensor, b: Tensor, directions: int = 64) -> float:
    """Sliced 2-Wasserstein distance of two sets of equally many points."""
    angle = math.pi * torch.arange(directions) / directions
    axes = torch.stack([angle.cos(), angle.sin()])
    p, q = (points.reshape(-1, 2) @ axes for points in (a, b))
    return float((p.sort(0).values - q.sort(0).values).square().mean().sqrt())


def train_plane(stage: Rectify, batch: Callable[[int], dict[str, Tensor]], steps: int) -> nn.Module:
    stage.log = lambda *args, **kwargs: None  # type: ignore[method-assign]
    optimizer = torch.optim.AdamW(stage.parameters(), lr=2e-3, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: learning_rate_factor(step, 200, steps))
    for step in range(steps):
        optimizer.zero_grad()
        stage.training_step(batch(step), step).backward()
        optimizer.step()
        schedule.step()
    return stage.generator.function.requires_grad_(False)


def plane_flows(seed: int) -> dict[str, nn.Module]:
    """1-RF, 2-RF and 2-TD of one seed, each initialised from the one before."""
    torch.manual_seed(seed)
    draw = torch.Generator().manual_seed(1000 + seed)

    def scans(step: int) -> dict[str, Tensor]:
        x_1 = plane_data(PLANE_BATCH, draw)
        return {"x_0": torch.randn(x_1.shape, generator=draw), "x_1": x_1, "u": torch.rand(len(x_1), generator=draw)}

    def pairs_of(flow: nn.Module) -> Callable[[int], dict[str, Tensor]]:
        x_0 = torch.randn(PLANE_PAIRS, 1, 1, 2, generator=draw)
        x_1 = solve(flow, x_0, method="dopri5", tolerance=1e-5).x

        def batch(step: int) -> dict[str, Tensor]:
            chosen = torch.randint(len(x_0), (PLANE_BATCH,), generator=draw)
            return {"x_0": x_0[chosen], "x_1": x_1[chosen], "u": torch.rand(PLANE_BATCH, generator=draw)}

        return batch

    flows: dict[str, nn.Module] = {}
    for name, options in (
        ("1-RF", {"name": "rectify"}),
        ("2-RF", {"name": "reflow"}),
        ("2-TD", {"name": "distill", "steps": 2}),
    ):
        network = Plane()
        batch: Callable[[int], dict[str, Tensor]] = scans
        if flows:
            parent = list(flows.values())[-1]
            network.load_state_dict(parent.state_dict())
            batch = pairs_of(parent)
        stage = STAGES.build(options, Field(network, (1, 1, 2)))
        flows[name] = train_plane(stage, batch, PLANE_STEPS[str(options["name"])])
    return flows


def measure(
    flows: Mapping[str, Velocity], x_0: Tensor, distance: Callable[[Tensor], float], extra: Mapping[str, float]
) -> dict[str, float]:
    """Every figure that the claims are about, of one seed."""
    with torch.inference_mode():
        tight = solve(flows["2-RF"], x_0, method="dopri5", tolerance=1e-5).x
        ends = {
            (name, steps): solve(flow, x_0, steps=steps).x for name, flow in flows.items() for steps in (1, 2, MANY)
        }
        found = {f"distance {name} {steps}": distance(end) for (name, steps), end in ends.items()}
        for name in ("2-RF", "2-TD"):
            found[f"pair error {name} 2"] = float((ends[name, 2] - tight).square().mean().sqrt())
        for name in ("1-RF", "2-RF"):
            found[f"bend {name}"] = float(curvature(flows[name], x_0, MANY).normalised.median())
    return {**found, **extra}


def plane(seed: int) -> dict[str, float]:
    draw = torch.Generator().manual_seed(2000 + seed)
    truth, x_0 = plane_data(PLANE_SAMPLES, draw), torch.randn(PLANE_SAMPLES, 1, 1, 2, generator=draw)
    gaussian = truth.mean(0) + truth.std(0) * torch.randn(truth.shape, generator=draw)
    flows = plane_flows(seed)
    exact = solve(plane_velocity, x_0.double(), method="dopri5", tolerance=1e-8).x.float()
    floor = sliced_distance(plane_data(PLANE_SAMPLES, draw), truth)
    extra = {
        "control untrained": sliced_distance(x_0, truth),
        "control gaussian": sliced_distance(gaussian, truth),
        "floor": floor,
        "distance exact 1-RF": sliced_distance(exact, truth),
    }
    return measure(flows, x_0, lambda end: sliced_distance(end, truth), extra)


def scans(seed: int, folder: Path) -> dict[str, float]:
    run = folder / f"seed-{seed}"
    command = [sys.executable, str(ROOT / "train.py"), *SCAN_RUN, f"seed={seed}", f"run_dir='{run}'"]
    subprocess.run(command, check=True)
    flows = {name: load_checkpoint(run / link) for name, link in (("1-RF", "rf1"), ("2-RF", "rf2"), ("2-TD", "td2"))}
    first = flows["1-RF"]
    data = ScanDataModule(first.sensor, first.encoding, seed, **first.config["data"])
    training, held = data.sources()
    real = np.stack([held[i] for i in range(len(held))])
    truth = panel(real, first.sensor)
    kinds = controls(np.stack([training[i] for i in range(SCAN_SAMPLES)]), first.sensor, SCAN_SAMPLES, seed)
    extra = {
        f"control {name}": mean_of(distances(truth, panel(images, first.sensor))) for name, images in kinds.items()
    }
    known = np.stack([training[i] for i in range(SCAN_SAMPLES, 2 * SCAN_SAMPLES)])
    extra["floor"] = mean_of(distances(truth, panel(known, first.sensor)))
    x_0 = Draws(seed, range(SCAN_SAMPLES)).start(first.encoding.shape)
    return measure({name: flow.model for name, flow in flows.items()}, x_0, judge(first, truth), extra)


def judge(flow: Checkpoint, truth: dict[str, np.ndarray]) -> Callable[[Tensor], float]:
    return lambda end: mean_of(distances(truth, panel(flow.encoding.decode(end).numpy(), flow.sensor)))


def mean_of(values: Mapping[str, float]) -> float:
    return float(np.mean(list(values.values())))


def claims(found: list[dict[str, float]]) -> list[dict[str, Any]]:
    """The paper's statements, each with the figures of every seed and the verdict over the seeds."""
    best = [min(v for k, v in one.items() if k.startswith("control")) for one in found]

    def each(key: str) -> list[float]:
        return [one[key] for one in found]

    def row(claim: str, left: list[float], right: list[float], at_most: float) -> dict[str, Any]:
        margins = [math.log(at_most * b / a) for a, b in zip(left, right, strict=True)]
        return {
            "claim": claim, "left": spread(left), "right": spread(right), "left / right, at most": at_most,
            "seen": spread([a / b for a, b in zip(left, right, strict=True)]),
            "margins": margins, "verdict": all_above_0([margins]),
        }  # fmt: skip

    many = str(MANY)
    return [
        row("1-RF beats every control", each(f"distance 1-RF {many}"), best, 1.0),
        row("2-RF bends at most half as much", each("bend 2-RF"), each("bend 1-RF"), STRAIGHTER),
        row("2-RF is no worse at many steps", each(f"distance 2-RF {many}"), each(f"distance 1-RF {many}"), NO_WORSE),
        row("one step: 2-RF far better than 1-RF", each("distance 2-RF 1"), each("distance 1-RF 1"), FAR_BETTER),
        row(
            "two steps: 2-TD nearer to held-out pairs than 2-RF",
            each("pair error 2-TD 2"),
            each("pair error 2-RF 2"),
            1.0,
        ),
        row("two steps: 2-TD nearer to the data than 2-RF", each("distance 2-TD 2"), each("distance 2-RF 2"), 1.0),
    ]


def spread(values: list[float]) -> str:
    """Mean and half the range over the seeds."""
    return f"{np.mean(values):.3g} ± {(max(values) - min(values)) / 2:.1g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", choices=["plane", "scans"])
    arguments = parser.parse_args()
    text, rows = [], []
    for kind, run in (("plane", plane), ("scans", lambda seed: scans(seed, arguments.out / "runs"))):
        if arguments.only not in (None, kind):
            continue
        found = []
        for seed in SEEDS:
            found.append(run(seed))
            rows.append({"problem": kind, "seed": seed, **found[-1]})
            print(kind, seed, {key: round(value, 4) for key, value in found[-1].items()}, flush=True)
        columns = {
            "claim": "claim",
            "left": "left",
            "right": "right",
            "seen": "left / right",
            "left / right, at most": "at most",
            "verdict": "verdict",
        }
        means = [{"figure": key, "mean and half range": spread([one[key] for one in found])} for key in found[0]]
        text += [
            f"## {kind}",
            table(claims(found), columns),
            table(means, {"figure": "figure", "mean and half range": "mean ± half range"}),
        ]
    page = Page(
        name="ordering", title="The paper's ordering", text=text, rows=rows, figures={},
        command=f"python benchmarks/ordering.py --out {arguments.out}", seeds={f"run {seed}": seed for seed in SEEDS},
    )  # fmt: skip
    print(write_page(page, arguments.out)[-1].read_text())


if __name__ == "__main__":
    main()
