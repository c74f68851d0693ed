"""Measurements of an ablation: cost and quality of its runs, as rows of a CSV."""

import csv
import ctypes
import io
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.base.files import write_file
from r2flow.base.noise import Draws
from r2flow.data.sets import ScanSet
from r2flow.data.sources import InMemory
from r2flow.evaluation.comparing import Comparer
from r2flow.evaluation.copies import find_nearest
from r2flow.evaluation.measuring import Work
from r2flow.evaluation.sets import baseline_sets, sampled_set
from r2flow.flow.path import interpolate
from r2flow.flow.straightness import straightness
from r2flow.generators import Flow, Generator, Sampler, as_flow
from r2flow.metrics import METRICS
from r2flow.metrics.panel import REFLECTANCE, distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.reports.backbones import cost
from r2flow.reports.tables import Row

TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the error of x_1
_BATCH = 8
_PATHS = 8  # scans of the bend
_METRICS = ("things", "jsd", "mmd", "kid_handcrafted_range", "frechet_handcrafted_range")
_WORK = Work(_BATCH)
_TEXTS = ("combination", "model", "sampler", "settings", "steps")  # columns that are no numbers
# Samplers and numbers of steps by a generator's default sampler; of others it is the only one.
_SYSTEMS: Mapping[str, Mapping[str, Sequence[int]]] = {
    "adams3": {"euler": (1, 2, 4, 8, 16), "adams3": (2, 4, 8, 16)},
    "ddpm": {"ddpm": (8, 32, 256), "ddim": (8, 32)},
    "latent_ddim": {"latent_ddim": (8, 50)},
}


@dataclass
class Judge:
    """Measures sets of scans against the same held-out ones, and their copies of training scans."""

    real: ScanSet
    training: ScanSet
    device: str

    def __post_init__(self) -> None:
        self.counts = panel(self.real[:].numpy(), self.real.sensor)
        metrics = {name: METRICS[name]().to(self.device) for name in _METRICS}
        self.compare = Comparer(metrics, _WORK)

    def figures(self, images: Tensor) -> Row:
        """Figures of a set of images, (N, 2 or 1, H, W). The error of the distance is the
        jackknife's over the scans.
        """
        names = [f"sample {number}" for number in range(len(images))]
        sampled = ScanSet("samples", InMemory(images.numpy(), names), self.real.sensor)
        measured = self.compare("judged", "", self.real, sampled).measured
        rows = np.stack([panel(image[None], self.real.sensor) for image in images.numpy()])
        total = rows.sum(0)
        lines = distances(self.counts, total)
        without = [_of_range(distances(self.counts, total - row)) for row in rows]
        nearest = find_nearest({"": sampled}, self.training, _WORK, self.device)[""].distances
        return {
            "distance": mean_distance(lines),
            "distance of ranges": _of_range(lines),
            "error": math.sqrt(len(rows) - 1) * float(np.std(without)),
            **{key: value for result in measured for key, value in result.figures.items()},
            "copies": float(np.median(nearest)),
        }


def _of_range(lines: Mapping[str, float]) -> float:
    """The panel's mean without reflectance, which some systems do not draw."""
    return mean_distance({line: value for line, value in lines.items() if line != REFLECTANCE})


def measure_run(run: str, judge: Judge, evaluations: Sequence[int] | None) -> list[Row]:
    """Figures of a run by its samplers: those of `_SYSTEMS`, or the default one and, of flows,
    Euler in `evaluations`.

    Every run has the same held-out scans and the same noise.
    """
    checkpoint = load_checkpoint(run, judge.device)
    generator = checkpoint.generator
    if not generator.unconditional:
        return []
    costs = cost(checkpoint.config.model, 5, judge.device)
    figures: Row = {
        "parameters, millions": costs["parameters"] / 1e6,
        "GMAC": costs["gmac"],
        "ms an evaluation": costs["latency_ms"],
    }
    if isinstance(generator, Flow):
        figures |= _of_velocity(checkpoint, judge.real, judge.device)
    rows = []
    for sampler in _samplers(generator, evaluations):
        images, drawing = _drawn(checkpoint, len(judge.real), sampler)
        row = {**figures, "sampler": sampler.name, "evaluations": sampler.evaluations(generator)}
        rows.append(row | drawing | judge.figures(images))
    return rows


def _samplers(generator: Generator, evaluations: Sequence[int] | None) -> list[Sampler]:
    default = generator.sampler
    names = ["euler", default.name] if isinstance(generator, Flow) else [default.name]
    counts = dict.fromkeys(names, evaluations) if evaluations else _SYSTEMS.get(default.name, {})
    if generator.fixed:
        kept = not evaluations or default.evaluations(generator) in evaluations
        return [default] if kept else []
    return [generator.choose(name, steps=steps) for name in counts for steps in counts[name]] or [
        default
    ]


def _drawn(checkpoint: Checkpoint, num: int, sampler: Sampler) -> tuple[Tensor, Row]:
    """Scans, with the processor seconds of one and the memory of a batch of `_BATCH`, in MiB."""
    source = sampled_set(checkpoint, "", num, sampler).source
    source.batch([0])  # the first call is slower
    before = _resident(reset=True)
    begin = time.process_time()
    batches = [source.batch(range(i, min(i + _BATCH, num))) for i in range(0, num, _BATCH)]
    seconds = (time.process_time() - begin) / num
    return torch.cat(batches), {"seconds a scan": seconds, "MiB": _resident("VmHWM") - before}


def _resident(line: str = "VmRSS", reset: bool = False) -> float:
    """Resident memory, or its peak since the last reset (VmHWM), in MiB; NaN except on Linux."""
    if not sys.platform.startswith("linux"):
        return math.nan
    if reset:
        ctypes.CDLL(None).malloc_trim(0)  # what was freed before is no part of it
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text().partition(f"{line}:")[2]
    return int(status.split()[0]) / 1024


def reference_rows(judge: Judge) -> list[Row]:
    """Figures of as many training scans as held-out ones, and of the baselines."""
    count = len(judge.real)
    sets = {"training scans": judge.training.spread(count), **baseline_sets(judge.real, count)}
    return [{"combination": name, **judge.figures(scans[:])} for name, scans in sets.items()]


@torch.no_grad()
def _of_velocity(checkpoint: Checkpoint, real: ScanSet, device: str) -> Row:
    """RMS error of x_1 at each time, in model space, and bend; none of a distilled flow."""
    flow = as_flow(checkpoint.generator, "an ablation", distilled=True)
    if flow.fixed:
        return {}
    squares = torch.zeros(len(TIMES), dtype=torch.float64)
    for first in range(0, len(real), _BATCH):
        images = real[first : first + _BATCH]
        x_1 = flow.space.encoding.encode(images).to(device)
        x_0 = Draws(0, range(first, first + len(x_1))).start(flow.noise_shape).to(device)
        squares += _squared_errors(flow, x_0, x_1)
    rms = (squares / len(real)).sqrt().tolist()
    errors = {f"error of x_1, t = {t}": value for t, value in zip(TIMES, rms, strict=True)}
    noise = Draws(0, range(_PATHS)).start(flow.noise_shape).to(device)
    bend = straightness(flow.velocity, noise, steps=16).s_normalised.mean().item()
    return {**errors, "bend": bend}


def _squared_errors(flow: Flow, x_0: Tensor, x_1: Tensor) -> Tensor:
    """Mean squares of x_t + (1 - t) v - x_1 of each time, summed over the scans."""
    sums = []
    for t in TIMES:
        x_t, _ = interpolate(x_0, x_1, torch.full((len(x_1),), t, device=x_1.device))
        v = flow.velocity(torch.tensor(t, device=x_1.device), x_t)
        error = x_t + (1 - t) * v - x_1
        sums.append(error.double().square().flatten(1).mean(1).sum().cpu())
    return torch.stack(sums)


def read_rows(path: Path) -> list[Row]:
    """The rows of finished runs, without their empty cells; none if the file is missing."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as lines:
        return [
            {key: _value(key, text) for key, text in row.items() if text}
            for row in csv.DictReader(lines)
        ]


def _value(column: str, text: str) -> Any:
    return text if column in _TEXTS else float(text)


def write_rows(rows: Sequence[Row], path: Path) -> Path:
    """Write the rows of finished runs, one for each sampler, with six digits."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = io.StringIO()
    writer = csv.DictWriter(lines, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{x:.6g}" if isinstance(x, float) else x for k, x in row.items()})
    write_file(path, lines.getvalue())
    return path
