"""Two checkouts side by side: processor seconds of one thread and peak memory of users' work.

Each checkout has a process for a case. They work in turns, one repetition each; the table has the
medians. Scans are simulated. `stream` less `stream_named` is what finding the sensor takes. Of
commands, `first` and `drive`, seconds and memory are those of their processes, start included.

git worktree add ../before main
python benchmarks/sides.py ../before . --repeats 7
python benchmarks/sides.py ../before . --cases vlp16,street
python benchmarks/sides.py . . --models densify,densify_small --cases vlp16,hdl64e,os1_128
python benchmarks/sides.py ../before . --avx2   # float32 as on a core without AVX-512 and bfloat16
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy import ndarray

Work = Callable[[], object]
MODEL = "SIDES_MODEL"  # environment variable: the model that completes
PRECISION = "SIDES_PRECISION"  # and that of its network, where it is not the usual one
AVX2 = {
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ATEN_CPU_CAPABILITY": "avx2",
    PRECISION: "32-true",
}
HOW: Any = {"precision": os.environ[PRECISION]} if PRECISION in os.environ else {}


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
    return lambda: flow.complete(images * measured, state, **HOW)


def cloud(seed: int = 1) -> "ndarray":
    """A scan of a VLP-16, (N, 4) float32."""
    import numpy as np

    from r2flow.lidar.projection import image_to_points
    from r2flow.lidar.sensors import SENSORS
    from r2flow.simulator import simulate

    sensor = SENSORS["vlp16"].resized(16, 1800)
    return np.column_stack(image_to_points(simulate(sensor, seed, 0).image, sensor))


def points() -> Work:
    """Completion of a VLP-16's points in memory to 64 x 1024."""
    import r2flow

    flow = r2flow.load(os.environ[MODEL])
    scan = cloud()
    return lambda: flow.complete(scan, sensor="vlp16", **HOW)


def stream(sensor: str | None) -> Work:
    """Completion of one scan of a VLP-16 after another: by a `completer`, if the checkout has it."""
    import r2flow

    flow = r2flow.load(os.environ[MODEL])
    scan = cloud()
    if hasattr(flow, "completer"):
        completer = flow.completer(sensor, **HOW)
        return lambda: completer(scan)
    return lambda: flow.complete(scan, sensor=sensor, **HOW)


def command(count: int, threads: str, *words: str) -> Work:
    """`r2flow complete` of `count` files of a VLP-16."""
    folder = Path(tempfile.mkdtemp())
    scan = cloud()
    for number in range(count):
        scan.astype("<f4").tofile(folder / f"{number:03}.bin")
    environment = {**os.environ, "OMP_NUM_THREADS": threads}
    program = (sys.executable, "-W", "ignore", "-m", "r2flow")
    how = [word for value in HOW.values() for word in ("--precision", value)]

    def work() -> None:
        with tempfile.TemporaryDirectory() as out:
            subprocess.run(
                [*program, "complete", folder, *words, *how, "--out", f"{out}/dense"],
                env=environment,
                stdout=subprocess.DEVNULL,
                check=True,
            )

    return work


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
    "stream": lambda: stream(None),
    "stream_named": lambda: stream("vlp16"),
    "first": lambda: command(1, "1"),
    "drive": lambda: command(100, "2", "-c", os.environ[MODEL]),
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


COMMANDS = ("first", "drive")


def run(case: str) -> None:
    """A repetition for each line of input: processor seconds, and MiB at the peak above the start."""
    import torch

    torch.set_num_threads(1)
    work = CASES[case]()
    of = resource.RUSAGE_CHILDREN if case in COMMANDS else resource.RUSAGE_SELF
    before = resource.getrusage(of)
    for _ in sys.stdin:
        start = resource.getrusage(of)
        work()
        end = resource.getrusage(of)
        seconds = end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime
        print(seconds, (end.ru_maxrss - before.ru_maxrss) / 1024, flush=True)


def begun(checkout: Path, case: str, **environment: str) -> subprocess.Popen[str]:
    """The process of a checkout for a case."""
    command = [sys.executable, "-W", "ignore", __file__, "--run", case]
    own = {"PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1", **environment}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env={**os.environ, **own}, stdin=pipe, stdout=pipe, text=True)


def repeated(process: subprocess.Popen[str]) -> list[float]:
    """Seconds and MiB of a repetition."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return [float(word) for word in process.stdout.readline().split()]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkouts", nargs="*", type=Path)
    parser.add_argument("--cases", default=",".join(CASES))
    parser.add_argument("--models", default="densify,densify", help="of the two, to complete")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--avx2", action="store_true")
    parser.add_argument("--run", help=argparse.SUPPRESS)  # of a process for one case
    given = parser.parse_args()
    if given.run:
        return run(given.run)
    print(
        "| work | before, s | after, s | ratio | before, MiB | after, MiB |\n|---|---|---|---|---|---|"
    )
    for case in given.cases.split(","):
        each = zip(given.checkouts, given.models.split(","), strict=True)
        isa = AVX2 if given.avx2 else {}
        sides = [begun(checkout, case, **isa, **{MODEL: model}) for checkout, model in each]
        for side in sides if case not in COMMANDS else ():
            repeated(side)  # the first one reserves memory
        rounds = [[repeated(side) for side in sides] for _ in range(given.repeats)]
        for side in sides:
            side.communicate()
        (a, m), (b, n) = (
            map(statistics.median, zip(*results, strict=True))
            for results in zip(*rounds, strict=True)
        )
        print(f"| {case} | {a:.3f} | {b:.3f} | {b / a:.2f} | {m:.0f} | {n:.0f} |", flush=True)


if __name__ == "__main__":
    main()
