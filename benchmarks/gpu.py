"""A GPU in at most twelve minutes: backbones as shares of its matmul rate, attention, models.

Each part is skipped once the time is up, and what fails says so and lets the others run. It was
tried on a CPU alone (`--device cpu --rows 16 --columns 64`).

python benchmarks/gpu.py --minutes 12
"""

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable, Iterator

import torch
from backbones import built, line, measured, seconds

import r2flow
from r2flow.backbones.attention import BACKENDS, neighbourhood_attention
from r2flow.lidar.known import ray_states
from r2flow.simulator import simulate

MODES = ("bfloat16", "training-bfloat16", "float32", "compiled-bfloat16")
TOKENS = (8, 64, 256, 2, 64)  # batch, rows, columns, heads and channels of hdit's first level
WINDOW = (3, 9)
PRECISIONS = ("32-true", "bf16-mixed")
Part = tuple[str, Callable[[], str]]


def backbone(name: str, mode: str, given: argparse.Namespace) -> str:
    """Latency and share of one backbone in one mode."""
    model = built(name, given.rows, given.columns, "auto", given.device)
    model.train("training" in mode)
    row = {"name": name, "mode": mode, "attention": "auto", "batch": given.batch}
    return line(row | measured(model, mode, given.batch, 10, given.device))


def median_ms(work: Callable[[], object], device: str) -> float:
    """Median milliseconds of ten calls after two."""
    times = [seconds(work, device) for _ in range(12)]
    return 1e3 * statistics.median(times[2:])


def attention(path: str, device: str) -> str:
    """Forward of one path of neighbourhood attention in bfloat16."""
    q, k, v = torch.randn(3, *TOKENS, device=device, dtype=torch.bfloat16)
    if path == "natten":
        if importlib.util.find_spec("natten") is None:
            return "attention, natten: not installed"
        from natten.functional import na2d

        pad = WINDOW[1] // 2
        q, k, v = (torch.cat([x[:, :, -pad:], x, x[:, :, :pad]], 2) for x in (q, k, v))
        work = lambda: na2d(q, k, v, kernel_size=WINDOW, scale=1.0)  # noqa: E731
    else:
        work = lambda: neighbourhood_attention(q, k, v, WINDOW, backend=path)  # noqa: E731
    return f"attention, {path}: {median_ms(work, device):.3f} ms"


def completed(precision: str, device: str) -> str:
    """`densify`, every fourth row of a scan of an HDL-64E."""
    flow = r2flow.load("densify", device)
    images = torch.from_numpy(simulate(flow.sensor, 1, 0).image)[None]
    measured_rows = (torch.arange(64) % 4 == 0)[:, None].expand(64, 1024)
    given = images * measured_rows
    state = ray_states(images, measured_rows)
    work = lambda: flow.complete(given, state, precision=precision)  # noqa: E731
    return f"densify, {precision}: {median_ms(work, device):.1f} ms a scan"


def drawn(precision: str, device: str) -> str:
    """`street` in 16 evaluations, 16 scans at once."""
    flow = r2flow.load("street", device)
    how = {"sampler": "adams3", "steps": 16, "batch_size": 16, "precision": precision}
    work = lambda: flow.sample(16, **how)  # noqa: E731
    return f"street, {precision}: {median_ms(work, device) / 16:.1f} ms a scan"


def parts(given: argparse.Namespace) -> Iterator[Part]:
    """What is measured, the most useful first."""
    device = given.device
    for precision in PRECISIONS:
        yield "densify", lambda precision=precision: completed(precision, device)
        yield "street", lambda precision=precision: drawn(precision, device)
    for path in (*BACKENDS, "natten"):
        yield f"attention, {path}", lambda path=path: attention(path, device)
    for mode in MODES:
        for name in ("hdit", "efficient_unet", "adm_unet"):
            yield f"{name}, {mode}", lambda n=name, m=mode: backbone(n, m, given)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=12)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--rows", type=int, default=64)
    parser.add_argument("--columns", type=int, default=1024)
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    print(f"torch {torch.__version__}, {given.device}", flush=True)
    for name, part in parts(given):
        if time.monotonic() > end:
            print(f"{name}: no time left")
            continue
        try:
            print(part(), flush=True)
        except Exception as error:  # the other parts are worth their time
            print(f"{name}: {type(error).__name__}: {str(error).splitlines()[:1]}", flush=True)


if __name__ == "__main__":
    main()
