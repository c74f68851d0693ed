"""Two checkouts side by side: processor seconds of one thread and peak memory of users' work.

Each run of a case is a process of its own, of the checkouts in turns; a run gives the median of its
repetitions, the table the medians over the runs. Scans are simulated.

git worktree add ../before main
python benchmarks/sides.py ../before . --runs 5
python benchmarks/sides.py ../before . --cases vlp16,street
python benchmarks/sides.py . . --models densify,densify_small --cases vlp16,hdl64e,os1_128
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

Work = Callable[[], object]
MODEL = "SIDES_MODEL"  # environment variable: the model that completes


def completing(sensor: str, size: tuple[int, int] | None, keep: int) -> Work:
    """Completion of every `keep`-th row of an image of a sensor."""
    import torch

    import r2flow
    from r2flow.lidar.known import ray_states
    from r2flow.lidar.sensors import SENSORS
    from r2flow.simulator import simulate

    flow = r2flow.load(os.environ[MODEL])
    if size:
        flow = flow.through(SENSORS[sensor].resized(*size))
    images = torch.from_numpy(simulate(flow.sensor, 1, 0).image)[None]
    measured = torch.zeros(flow.sensor.shape, dtype=torch.bool)
    measured[::keep] = True
    state = ray_states(images, measured)
    return lambda: flow.complete(images * measured, state)


def points() -> Work:
    """Completion of a VLP-16's points in memory to 64 x 1024."""
    import numpy as np

    import r2flow
    from r2flow.lidar.projection import image_to_points
    from r2flow.lidar.sensors import SENSORS
    from r2flow.simulator import simulate

    sensor = SENSORS["vlp16"].resized(16, 1800)
    xyz, strength = image_to_points(simulate(sensor, 1, 0).image, sensor)
    cloud = np.column_stack([xyz, strength])
    flow = r2flow.load(os.environ[MODEL])
    return lambda: flow.complete(cloud, sensor="vlp16")


def sampling(precision: str) -> Work:
    """A scan of `street` in 16 evaluations."""
    import r2flow

    flow = r2flow.load("street")
    return lambda: flow.sample(1, sampler="adams3", steps=16, precision=precision)


def training(name: str, rounded: bool = False) -> Work:
    """A training step on one image of 2 x 64 x 1024: forward, backward and AdamW."""
    import torch

    from r2flow.backbones import BACKBONES
    from r2flow.lidar.sensors import SENSORS

    model = BACKBONES.build(name, SENSORS["hdl64e"].rays())
    optimiser = torch.optim.AdamW(model.parameters())
    x = torch.randn(1, 2, 64, 1024)

    def step() -> None:
        optimiser.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=rounded):
            loss = model(0.5, x).square().mean()
        loss.backward()
        optimiser.step()

    return step


def pictures() -> Work:
    """Four pictures of `r2flow show`."""
    from r2flow.lidar.sensors import SENSORS
    from r2flow.reports.figures import save_figure
    from r2flow.reports.pictures import scan_figure
    from r2flow.simulator import simulate

    sensor = SENSORS["hdl64e"]
    images = [simulate(sensor, 1, index).image for index in range(4)]
    out = Path(tempfile.mkdtemp())
    return lambda: [
        save_figure(scan_figure(image, sensor.rays()), out / f"{index}.png")
        for index, image in enumerate(images)
    ]


CASES: dict[str, Callable[[], Work]] = {
    "vlp16": points,
    "hdl64e": lambda: completing("hdl64e", None, 4),
    "os1_128": lambda: completing("os1_128", (128, 1024), 4),
    "street": lambda: sampling("32-true"),
    "street_bf16": lambda: sampling("bf16-mixed"),
    "hdit_tiny": lambda: training("hdit_tiny"),
    "hdit_tiny_bf16": lambda: training("hdit_tiny", rounded=True),
    "hdit": lambda: training("hdit"),
    "hdit_bf16": lambda: training("hdit", rounded=True),
    "pictures": pictures,
}


def run(case: str, repeats: int) -> dict[str, float]:
    """Processor seconds of a repetition after the first, and MiB at the peak above the start."""
    import torch

    torch.set_num_threads(1)
    work = CASES[case]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    work()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {"seconds": statistics.median(seconds), "memory": (peak - before) / 1024}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkouts", nargs="*", type=Path)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--models", default="densify,densify", help="of the two, to complete")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--run", help=argparse.SUPPRESS)  # of a process for one case
    given = parser.parse_args()
    if given.run:
        print(json.dumps(run(given.run, given.repeats)))
        return
    print(
        "| work | before, s | after, s | ratio | before, MiB | after, MiB |\n|---|---|---|---|---|---|"
    )
    for case in given.cases.split(","):
        found: list[list[dict[str, float]]] = [[] for _ in given.checkouts]
        for _ in range(given.runs):
            models = given.models.split(",")
            for checkout, model, results in zip(given.checkouts, models, found, strict=True):
                command = [sys.executable, "-W", "ignore", __file__, "--run", case]
                done = subprocess.run(
                    [*command, "--repeats", str(given.repeats)],
                    env={
                        **os.environ,
                        "PYTHONPATH": str(checkout.resolve()),
                        "OMP_NUM_THREADS": "1",
                        MODEL: model,
                    },
                    stdout=subprocess.PIPE,
                    check=True,
                )
                results.append(json.loads(done.stdout.splitlines()[-1]))
        (a, b), (m, n) = (
            [statistics.median(one[key] for one in results) for results in found]
            for key in ("seconds", "memory")
        )
        print(f"| {case} | {a:.3f} | {b:.3f} | {b / a:.2f} | {m:.0f} | {n:.0f} |", flush=True)


if __name__ == "__main__":
    main()
