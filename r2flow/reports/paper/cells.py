"""Every generator at every number of evaluations, measured once and kept, so that a stopped report goes on."""

import json
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.evaluation.measuring import Gathered, Work, measure, point_key
from r2flow.evaluation.sets import SampledScans, ScanSet, sampled_set
from r2flow.files import atomic_write, parse_json
from r2flow.generators import Sampler
from r2flow.metrics.base import ScanMetric, Side
from r2flow.metrics.birds_eye import BINS
from r2flow.metrics.jsd import JSD
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.sampling import sample
from r2flow.reports.paper.subjects import PaperRun
from r2flow.reports.speed_quality import BETWEEN

SHOWN = 2  # scans of each generator that are drawn
SEED = 0  # of their noise, the same for every generator


@dataclass(frozen=True)
class Cell:
    """One generator in one number of steps: a flow's are Euler's.

    The row has label, role, family, kind, seed, steps (evaluations of the network), seconds a scan, and each metric's
    first figure under its name with its interval's `_low` and `_high`. Beside it: points of all scans from above,
    (100, 100), and the first scans.
    """

    row: dict[str, Any]
    birds_eye: np.ndarray
    images: np.ndarray


@dataclass(frozen=True)
class CellSettings:
    """What is the same for all cells: `num` scans of each flow against the real ones, finished cells in the folder."""

    real: ScanSet
    metrics: Mapping[str, ScanMetric]
    gathered: Gathered
    num: int
    bootstrap: int
    work: Work
    folder: Path
    device: str

    def path(self, subject: PaperRun, sampler: Sampler, steps: int) -> Path:
        """A cell's file, named by everything that it depends on."""
        usual = Sampler()
        more = {key: getattr(sampler, key) for key in ("grid", "precision")}
        more = {key: value for key, value in more.items() if value != getattr(usual, key)}
        key = point_key(
            self.real, self.metrics, weights=subject.weights, steps=steps, num=self.num, seed=SEED,
            bootstrap=self.bootstrap, device=self.device, protocol=self.gathered.protocol.name, **more,
        )  # fmt: skip
        return self.folder / f"{key}.safetensors"


def measure_cells(settings: CellSettings, flow: Checkpoint, subject: PaperRun, steps: Sequence[int]) -> Iterator[Cell]:
    """The cells of one generator, each kept when it is done.

    One that has a single number of steps, as a distilled flow, is measured there only; another system also at its own.
    """
    own = {flow.generator.sampler.steps} if subject.system else set()
    for count in sorted({*steps, *own}) if subject.steps is None else [subject.steps]:
        sampler = flow.generator.in_steps(count)  # Euler for a flow, as in the paper
        path = settings.path(subject, sampler, count)
        cell = _read(path)
        if cell is None:
            cell = _measure(settings, flow, subject, sampler, count)
            _write(path, cell)
        # The run's name and folder, and the other runs of its chain, may have changed since.
        row = {**cell.row, "label": subject.label, "role": subject.role, "family": subject.family, "kind": subject.kind}
        yield Cell(row, cell.birds_eye, cell.images)


def _measure(settings: CellSettings, flow: Checkpoint, subject: PaperRun, sampler: Sampler, steps: int) -> Cell:
    drawn = sampled_set(flow, f"{subject.label}, {steps} steps", settings.num, sampler, SEED)
    sees = flow.encoding.reflectance
    metrics = {name: metric for name, metric in settings.metrics.items() if sees or not metric.needs_reflectance}
    found = measure(metrics, settings.gathered, drawn, settings.work, settings.bootstrap)
    assert isinstance(drawn.source, SampledScans)
    row: dict[str, Any] = {
        "label": subject.label, "role": subject.role, "family": subject.family, "seed": subject.seed,
        "steps": flow.generator.evaluations_of(sampler), "scans": settings.num,
        "seconds": statistics.median(drawn.source.seconds),
    }  # fmt: skip
    for one in found:
        first = next(iter(one.figures))
        row[one.metric] = one.figures[first]
        if first in one.intervals:
            row[f"{one.metric}_low"], row[f"{one.metric}_high"] = one.intervals[first]
    row["remarks"] = BETWEEN.join(dict.fromkeys(remark for one in found for remark in one.remarks))
    counts = counts_of(settings.metrics["jsd"], "generated")
    images = np.concatenate([s.images.numpy() for s in sample(flow, min(SHOWN, settings.num), SEED, sampler=sampler)])
    return Cell(row, counts, images)


def counts_of(jsd: ScanMetric, side: Side) -> np.ndarray:
    """The bird's-eye histogram of all scans of a side, (100, 100), which the JSD compares."""
    assert isinstance(jsd, JSD)
    total = jsd.real_sum if side == "real" else jsd.generated_sum
    return total.cpu().numpy().reshape(BINS, BINS)


def _read(path: Path) -> Cell | None:
    """A finished cell; one that cannot be read is measured again."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="numpy") as file:
            row = parse_json((file.metadata() or {})["row"])
            return Cell(row, file.get_tensor("birds_eye"), file.get_tensor("images"))
    except (SafetensorError, OSError, KeyError, ValueError):
        return None


def _write(path: Path, cell: Cell) -> None:
    from safetensors.numpy import save

    tensors = {"birds_eye": cell.birds_eye, "images": cell.images}
    with atomic_write(path) as file:
        file.write(save(tensors, metadata={"row": json.dumps(cell.row)}))
