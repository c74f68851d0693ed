"""How often the 95 % intervals of `--bootstrap` hold the figure that is expected of sets of their size.

    python benchmarks/intervals.py --scans simulated:31        # about 15 minutes on one core; --trials 100 for a look

A population is a pool of scans; sets are drawn from it with repetition, so that what is expected is known: the mean
over the trials. Generated scans come from the same pool (equal: nearly all of a distance is due to the sets' size) or
from the same scans with 10 cm of noise and a tenth of the returns lost (other). An interval that is asked for 95 % has
to hold the expected figure in 92 to 98 % of the trials.
"""

import argparse
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from torch import Tensor

from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics import METRICS
from r2flow.metrics.base import ScanMetric, Side
from r2flow.metrics.bootstrap import bootstrap
from r2flow.metrics.scans import Scans

SENSOR = SENSORS["hdl64e"].resized(16, 256)
NOISE, LOST = 0.1, 0.1  # metres; share of returns


def damaged(images: Tensor, draw: torch.Generator) -> Tensor:
    """Range noise and lost returns."""
    kept = (images[:, :1] > 0) & (torch.rand(images[:, :1].shape, generator=draw) > LOST)
    images = images.clone()
    images[:, 0] += NOISE * torch.randn(images[:, 0].shape, generator=draw)
    return images * kept


def pools(names: list[str], scans: str, size: int) -> dict[str, dict[str, Tensor]]:
    """What each metric takes from each scan of the pool as it is and damaged, (P, D)."""
    source = open_scans(scans, Reading(SENSOR), None, size)
    metrics = {name: METRICS[name]() for name in names}
    rows: dict[str, dict[str, list[Tensor]]] = {name: {"equal": [], "other": []} for name in names}
    draw = torch.Generator().manual_seed(0)
    for images in source.batches(range(len(source)), 20):
        for kind, seen in (("equal", images), ("other", damaged(images, draw))):
            batch = Scans(seen, SENSOR)
            with torch.no_grad():
                for name, metric in metrics.items():
                    rows[name][kind].append(metric.rows(batch).float())
    return {name: {kind: torch.cat(parts) for kind, parts in both.items()} for name, both in rows.items()}


def given(metric: ScanMetric, rows: Tensor, side: Side) -> None:
    """A set by its rows instead of its scans."""
    metric.add_scans(side, len(rows), 0)
    metric.accumulate(rows, side)
    metric.store(side).write(0, rows)


def trials(name: str, pool: dict[str, Tensor], kind: str, size: int, count: int, draws: int) -> Iterator[dict]:
    """Figures and intervals of sets of a size, drawn from the pools."""
    metric = METRICS[name](keep=True)
    for trial in range(count):
        draw = np.random.default_rng([trial, size, kind == "other"])
        metric.reset()
        for side, rows in (("real", pool["equal"]), ("generated", pool[kind])):
            given(metric, rows[draw.integers(len(rows), size=size)], side)
        ends = bootstrap(metric, draws, seed=trial)
        yield {figure: (value, *ends[figure]) for figure, value in metric.compute().items() if figure in ends}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", default="simulated:31")
    parser.add_argument("--pool", type=int, default=1000)
    parser.add_argument("--sizes", default="50,100,200")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--metrics", default="jsd,mmd,frechet_embedded,beams,drop_rate")
    options = parser.parse_args()
    names = options.metrics.split(",")
    print(f"{'figure':<22}{'sets':<8}{'scans':>6}{'mean':>12}{'spread':>12}{'half width':>12}{'held':>8}")
    for name, pool in pools(names, options.scans, options.pool).items():
        for kind in ("equal", "other"):
            for size in map(int, options.sizes.split(",")):
                found = list(trials(name, pool, kind, size, options.trials, options.draws))
                for figure in found[0]:
                    value, low, high = np.array([one[figure] for one in found]).T
                    held = np.mean((low <= value.mean()) & (value.mean() <= high))
                    line = partial("{:>12.4g}".format)
                    spread, width = value.std() / value.mean(), np.mean(high - low) / 2 / value.mean()
                    print(f"{figure:<22}{kind:<8}{size:>6}{line(value.mean())}{line(spread)}{line(width)}{held:>8.1%}",
                          flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
