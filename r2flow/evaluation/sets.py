"""Sets of scans sampled from a generator on access."""

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from torch import Tensor

from r2flow.data.sets import ScanSet
from r2flow.data.sources import MadeScans
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.model.checkpoint import Checkpoint, checkpoints_of, weights_hash
from r2flow.model.sampling import draw
from r2flow.models import MODELS

CHECKPOINTS = (".ckpt", ".pth", ".safetensors")


def is_checkpoint(text: str) -> bool:
    """Whether a text names a generator to sample: a checkpoint file, a run folder or a model."""
    path = Path(text).expanduser()
    if path.is_dir():
        return bool(checkpoints_of(path)) or any(path.glob("step-*.ckpt"))
    return path.suffix in CHECKPOINTS or (not path.exists() and text in MODELS)


def sampled_set(
    flow: Checkpoint,
    label: str,
    num: int,
    sampler: Sampler | None = None,
    seed: int = 0,
    precision: Precision = "32-true",
) -> ScanSet:
    """Set of scans 0 to num - 1 of a generator and seed, sampled on access.

    Their noise (seed, "evaluation", i) is disjoint from the noise of training and reflow pairs.
    """
    sampler = sampler or flow.generator.sampler
    sampler.check(flow.generator)
    about = {
        "kind": "sampled", "weights": weights_hash(flow), "step": flow.step, "num": num,
        "sampler": sampler.asdict(), "precision": precision, "seed": seed, "noise": "evaluation",
        "reflectance": flow.encoding.reflectance,
    }  # fmt: skip
    return ScanSet(label, SampledScans(flow, range(num), sampler, seed, precision), flow.sensor, about)


class SampledScans(MadeScans):
    """Scans of a generator; each depends only on (seed, number)."""

    drawn, word = True, "sample"

    def __init__(
        self, flow: Checkpoint, numbers: Sequence[int], sampler: Sampler, seed: int, precision: Precision = "32-true"
    ) -> None:
        self.flow, self.numbers, self.sampler, self.seed, self.precision = flow, numbers, sampler, seed, precision
        self.unsolved = 0  # samples so far that missed the tolerance
        self.evaluations: list[int] = []  # network evaluations per scan
        self.seconds: list[float] = []  # seconds per scan, for each batch

    def __getitem__(self, index: int) -> np.ndarray:
        return self.batch([index])[0].numpy()

    def subset(self, indices: Sequence[int]) -> Self:
        part = super().subset(indices)
        part.evaluations, part.seconds, part.unsolved = [], [], 0
        return part

    def batch(self, indices: Sequence[int]) -> Tensor:
        """Sample a batch, (B, 2 or 1, H, W); unconverged samples are included and counted."""
        batch = draw(
            self.flow.generator, [self.numbers[i] for i in indices], self.seed, self.sampler, precision=self.precision
        )
        self.seconds.append(batch.seconds / len(indices))
        self.evaluations += batch.evaluations.tolist()
        self.unsolved += int((~batch.converged).sum())
        return batch.images.nan_to_num(0.0)
