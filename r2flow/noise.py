"""Counter-based randomness: every draw is a function of (run seed, purpose, index) alone.

The noise of image k does not depend on the worker, rank or device that draws it, nor on what was
drawn before; that is what makes a run resumable bit for bit and pairs redrawable from their index.
The purpose is part of the key, so that training, evaluation and simulation never share a draw.
A sampler that draws noise in every step counts the steps as well (`Draws`).
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from operator import index as index_of

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError

PURPOSES = (
    "training", "validation", "pairs", "evaluation", "simulator", "shuffle", "mixture", "augmentation", "dropout",
    "weights", "condition", "beside",
)  # fmt: skip


def generator(seed: int, purpose: str, index: int, step: int = 0) -> np.random.Generator:
    """The random stream of one index and step: Philox keyed by (seed, purpose), counting from [0, 0, step, index].

    Args:
        seed: Run seed, 0 <= seed < 2^64.
        purpose: One of `PURPOSES`.
        index: Number of the image, scene or epoch, 0 <= index < 2^64.
        step: Step of what draws several times for one index, a sampler or a GAN's batch, 0 <= step < 2^64.

    Raises:
        InputError: a seed that is no whole number or outside its range, which is the user's to choose.
        OverflowError: an index or a step outside its range.
    """
    assert purpose in PURPOSES, purpose
    assert index >= 0 <= step, (index, step)
    try:
        seed = index_of(seed)
    except TypeError:
        raise InputError(f"a seed must be a whole number, found {seed!r}.") from None
    if not 0 <= seed < 2**64:
        raise InputError(f"a seed must lie in [0, 2^64), found {seed}.")
    # Philox4x64 has a 128-bit key and a 256-bit counter that counts blocks of four draws in its low
    # words: index and step go into the two highest words, which leaves 2^128 blocks to each pair.
    key = np.array([seed, zlib.crc32(purpose.encode())], dtype=np.uint64)
    counter = np.array([0, 0, step, index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def standard_normal(shape: tuple[int, ...], seed: int, purpose: str, index: int, step: int = 0) -> Tensor:
    """N(0, I) of one index and step, float32 on the CPU, of the given shape; x_0 at step 0."""
    return torch.from_numpy(generator(seed, purpose, index, step).standard_normal(shape, dtype=np.float32))


@dataclass(frozen=True)
class Draws:
    """The standard normal noise of a batch of scans: scan i in step j has a function of (seed, purpose, i, j).

    A scan's noise does not depend on the others of its batch, nor on their order. A sampler that leaves out
    steps or takes them in another order draws the same noise for the steps that it takes.

    Attributes:
        seed: Run seed, 0 <= seed < 2^64.
        numbers: Number of each scan of the batch, (B,).
        purpose: One of `PURPOSES`.
    """

    seed: int
    numbers: Sequence[int]
    purpose: str = "evaluation"

    def start(self, shape: tuple[int, ...]) -> Tensor:
        """x_0 of each scan, (B, *shape) float32 on the CPU: the rows are `standard_normal` of the scans' numbers."""
        return self._of_step(shape, 0)

    def step(self, shape: tuple[int, ...], j: int) -> Tensor:
        """Noise of each scan in step j >= 1, (B, *shape) float32 on the CPU; that of step 0 is the start's."""
        assert j >= 1
        return self._of_step(shape, j)

    def _of_step(self, shape: tuple[int, ...], j: int) -> Tensor:
        noise = torch.empty(len(self.numbers), *shape)
        for row, number in zip(noise, self.numbers, strict=True):
            row.copy_(standard_normal(shape, self.seed, self.purpose, number, j))
        return noise


def seed_torch(seed: int, purpose: str, index: int = 0) -> None:
    """Start torch's own generators from a draw of ours, for what draws from them: initial weights, dropout.

    On the CPU torch keeps the low 32 bits.
    """
    torch.manual_seed(int(generator(seed, purpose, index).integers(2**63)))
