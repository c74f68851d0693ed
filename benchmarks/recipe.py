"""What a small budget learns most by: held-out loss and fidelity against seconds, for several recipes of a 1-RF.

    python benchmarks/recipe.py --out recipe --only before fast    # two hours on one core; resumes
    python benchmarks/recipe.py --out recipe --budgets 160    # and each part of the recipe left out

Recipes, budgets, seeds and the verdict are the constants below, written down before the first run. Seconds are CPU
seconds of one thread, from the start of the first step to the end of the last; scans are made beforehand. Each budget
is a run of its own, whose learning rate comes down to 0 at its end.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.files import atomic_write
from r2flow.flow.path import interpolate
from r2flow.lidar.sensors import build_sensor
from r2flow.metrics.fidelity import distances, panel
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.sampling import sample
from r2flow.noise import standard_normal
from r2flow.reports.pages import STYLES, blank_figure, few_log_ticks
from r2flow.reports.tables import table
from r2flow.simulator import simulate

ROOT = Path(__file__).resolve().parents[1]
SEEDS = (0, 1, 2)
BUDGETS = (60, 160, 480)  # CPU seconds
SENSOR = build_sensor("hdl64e", 32, 256)
SCENES, HELD_OUT, SAMPLES = 4096, 384, 128
HELD_OUT_SEED = 1000
TIMES = (0.1, 0.3, 0.5, 0.7, 0.85, 0.92, 0.96, 0.98)
# From noise to data by the same solver for all: 32 evaluations, denser towards t = 1.
SOLVER: dict[str, Any] = {"method": "midpoint", "steps": 16, "grid": "power:2"}

COMMON = [
    "sensor=hdl64e_small", "data=simulated", f"data.scenes={SCENES}", "data.batch_size=8",
    "samples.num=0", "callbacks.pictures=null", "callbacks.curvature=null", "loggers=[csv]", "trainer=cpu",
    "callbacks.checkpoint.every=1000000", "trainer.val_check_interval=1000000",
]  # fmt: skip
FAST = ["experiment=fast"]
RECIPES: dict[str, list[str]] = {
    "before": ["backbone=hdit_tiny", "data.augment.flip=true"],
    "fast": [*FAST, "trainer.precision=bf16-mixed"],
    "fast in float32": FAST,
    "without Muon": [*FAST, "trainer.precision=bf16-mixed", "stage.muon=null"],
    "without late times": [*FAST, "trainer.precision=bf16-mixed", "stage.time={name: uniform}"],
    "without the path": [*FAST, "trainer.precision=bf16-mixed", "backbone.detail=null"],
    "without preconditioning": [*FAST, "trainer.precision=bf16-mixed", "backbone.data_std=null"],
    "a wider path": [*FAST, "trainer.precision=bf16-mixed", "backbone.detail=[3, 24]"],
    "without a position": [
        *FAST,
        "trainer.precision=bf16-mixed",
        "backbone.position=none",
        "data.augment.flip=true",
    ],
}
ALL_BUDGETS = ("before", "fast")
PARTS_BUDGET = 160  # of the others
# What is not in `fast` becomes part of it if it is nearer by the panel's mean in every seed.
# The verdict: `fast` is at 160 s no farther than `before` at 480 s, by the panel's mean and by the loss, in every seed.
EARLY, LATE = BUDGETS[1:]


def cpu_seconds(overrides: list[str], folder: Path, steps: int, seed: int, out: Path) -> float:
    """Train, or go on; CPU seconds of the child process."""
    command = [sys.executable, str(ROOT / "train.py"), *COMMON, *overrides, f"seed={seed}", f"run_dir={folder}"]
    command += [f"trainer.max_steps={steps}", f"data.root={out / f'scenes-{seed}'}"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def seconds_a_step(overrides: list[str], runs: Path, seed: int) -> float:
    """From two short runs, so that what comes before the first step drops out."""
    note = runs / "step.json"
    if not note.exists():
        with tempfile.TemporaryDirectory() as folder:
            short = {n: cpu_seconds(overrides, Path(folder, str(n)), n, seed, runs.parent.parent) for n in (10, 60)}
        with atomic_write(note) as file:
            file.write(json.dumps((short[60] - short[10]) / 50).encode())
    return float(json.loads(note.read_text()))


def measure(folder: Path, truth: np.ndarray, real: dict[str, np.ndarray]) -> dict[str, Any]:
    """Held-out loss at uniform times, error of x_1 at t = 0.98, and the panel."""
    flow = load_checkpoint(folder).generator
    x_1 = flow.space.encoding.encode(torch.from_numpy(truth[:64]))
    losses = []
    for number, t in enumerate(TIMES):
        x_0 = torch.stack([standard_normal(flow.noise_shape, 7, "evaluation", 64 * number + k) for k in range(64)])
        x_t, u_t = interpolate(x_0, x_1, torch.full((64,), t))
        with torch.no_grad():
            v = torch.cat([flow.velocity(torch.tensor(t), part) for part in x_t.split(8)])  # type: ignore[operator]
        losses.append(float((v - u_t).square().mean()))
    images = torch.cat([drawn.images for drawn in sample(flow, SAMPLES, batch_size=8, **SOLVER)]).numpy()
    found = distances(panel(images, SENSOR), real)
    weight = np.gradient(np.array([0.0, *TIMES[1:-1], 1.0]))
    return {
        "loss": float(np.dot(losses, weight) / weight.sum()),
        "late": 0.02 * losses[-1] ** 0.5,
        "panel": float(np.mean(list(found.values()))),
        "lines": found,
    }


def make_scenes(folder: Path, seed: int) -> None:
    """The training scans of a seed, made once."""
    command = [sys.executable, "-m", "r2flow.cli", "simulate", "--out", str(folder), "--num", str(SCENES)]
    subprocess.run([*command, "--seed", str(seed), "--size", "32x256", "--format", "npy"], check=True)


def curves(rows: list[list[Any]], floor: float) -> Figure:
    """Panel and loss against seconds, a line for each recipe of several budgets and a dot for each seed."""
    figure = blank_figure(9, 3.6)
    for axes, key in zip(figure.subplots(1, 2), ("panel", "loss"), strict=True):
        for name, style in zip(ALL_BUDGETS, STYLES, strict=False):
            own = [(budget, found[key]) for one, budget, _, found in rows if one == name]
            budgets = sorted({budget for budget, _ in own})
            means = [np.mean([value for other, value in own if other == budget]) for budget in budgets]
            axes.plot(budgets, means, label=name, **style)
            axes.plot(*zip(*own, strict=True), ".", color=style["color"])
        if key == "panel":
            axes.axhline(floor, color="grey", ls="--", label="other simulated scans")
        axes.set(
            xlabel="CPU seconds",
            ylabel={"panel": "panel's mean", "loss": "held-out loss"}[key],
            xscale="log",
            yscale="log",
        )
        few_log_ticks(axes.xaxis)
        few_log_ticks(axes.yaxis)
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--budgets", type=int, nargs="+", default=BUDGETS)
    parser.add_argument("--only", nargs="+", default=list(RECIPES), choices=RECIPES)
    given = parser.parse_args()
    torch.set_num_threads(1)
    held_out = np.stack([simulate(SENSOR, HELD_OUT_SEED, k).image for k in range(HELD_OUT + SAMPLES)])
    truth, real = held_out[:HELD_OUT], panel(held_out[:HELD_OUT], SENSOR)
    floor = distances(panel(held_out[HELD_OUT:], SENSOR), real)
    rows = []
    for seed in given.seeds:
        make_scenes(given.out / f"scenes-{seed}", seed)
        for name in given.only:
            runs = given.out / f"seed-{seed}" / name.replace(" ", "-")
            step = seconds_a_step(RECIPES[name], runs, seed)
            for budget in given.budgets if name in ALL_BUDGETS else [b for b in given.budgets if b == PARTS_BUDGET]:
                folder, note = runs / str(budget), runs / f"{budget}.json"
                if not note.exists():
                    steps = round(budget / step)
                    cpu_seconds(RECIPES[name], folder, steps, seed, given.out)
                    found = {"images": 8 * steps, "step": step, **measure(folder, truth, real)}
                    with atomic_write(note) as file:
                        file.write(json.dumps(found).encode())
                found = json.loads(note.read_text())
                rows.append([name, budget, seed, found])
                print(
                    f"{name}, {budget} s, seed {seed}: panel {found['panel']:.4f}, loss {found['loss']:.4f}", flush=True
                )
    lines = []
    for name, budget in dict.fromkeys((name, budget) for name, budget, _, _ in rows):
        of = [found for a, b, _, found in rows if (a, b) == (name, budget)]
        cells = [
            f"{np.mean([f[key] for f in of]):.4f} ± {np.ptp([f[key] for f in of]) / 2:.4f}"
            for key in ("panel", "loss", "late")
        ]
        worst = max(floor, key=lambda line: float(np.mean([f["lines"][line] for f in of])) / floor[line])
        lines.append([name, f"{budget}", f"{np.mean([f['images'] for f in of]):.0f}", *cells, worst])
    head = ["recipe", "CPU seconds", "images", "panel's mean", "held-out loss", "RMS of x_1 at t = 0.98", "worst line"]
    text = f"{table(lines, head)}\n\nThe floor, {SAMPLES} other simulated scans: {np.mean(list(floor.values())):.4f}.\n"
    for key in ("panel", "loss"):
        early = {seed: f[key] for name, budget, seed, f in rows if (name, budget) == ("fast", EARLY)}
        late = {seed: f[key] for name, budget, seed, f in rows if (name, budget) == ("before", LATE)}
        both = [seed for seed in early if seed in late]
        held = sum(early[seed] <= late[seed] for seed in both)
        text += f"{key}: fast at {EARLY} s is no farther than before at {LATE} s in {held} of {len(both)} seeds\n"
    with atomic_write(given.out / "recipe.md") as file:
        file.write(text.encode())
    curves(rows, float(np.mean(list(floor.values())))).savefig(given.out / "recipe.png", dpi=110)
    print(text)


if __name__ == "__main__":
    main()
