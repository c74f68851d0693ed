"""Counter-based random numbers: a function of (run seed, purpose, index).

The noise of image k is independent of worker, rank, device and previous draws, so that runs resume
bit for bit and pairs can be redrawn. Training, evaluation and simulation have different purposes
and never share noise. Stochastic samplers also count their steps (`Draws`).
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from r2flow.base.errors import InputError

PURPOSES = (
    "training",
    "validation",
    "pairs",
    "evaluation",
    "simulator",
    "shuffle",
    "mixture",
    "augmentation",
    "dropout",
    "weights",
    "condition",
    "beside",
)


def generator(seed: int, purpose: str, index: int, step: int = 0) -> np.random.Generator:
    """Random stream of an index and step: Philox with key (seed, purpose) and counter from [0, 0,
    step, index].

    `index` is the number of an image, scene or epoch, `step` a step of a sampler, or part of a
    GAN's step, for the same index; all numbers are in [0, 2^64).
    """
    assert purpose in PURPOSES, purpose
    assert step >= 0, step
    for name, number in (("a seed", seed), ("an index", index)):
        if not (isinstance(number, Integral) and 0 <= number < 2**64):
            raise InputError(f"{name} must be a whole number in [0, 2^64), found {number!r}.")
    # Philox4x64 counts blocks of four numbers in the low words of a 256-bit counter: with index and
    # step in the two highest words, each pair has 2^128 blocks.
    key = np.array([seed, zlib.crc32(purpose.encode())], dtype=np.uint64)
    counter = np.array([0, 0, step, index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def standard_normal(
    shape: tuple[int, ...], seed: int, purpose: str, index: int, step: int = 0
) -> Tensor:
    """Standard normal noise of an index and step, float32 on the CPU; x_0 at step 0."""
    return torch.from_numpy(
        generator(seed, purpose, index, step).standard_normal(shape, dtype=np.float32)
    )


@dataclass(frozen=True)
class Draws:
    """Standard normal noise of a batch of scans: a function of (seed, purpose, i, j) for scan i in
    step j.

    Noise is independent of the batch, and of skipped or reordered steps.
    """

    seed: int  #: run seed, 0 <= seed < 2^64
    numbers: Sequence[int]  #: number of each scan of the batch, (B,)
    purpose: str = "evaluation"  #: one of `PURPOSES`

    def start(self, shape: tuple[int, ...]) -> Tensor:
        """x_0 of each scan, (B, *shape) float32 on the CPU: `standard_normal` of the scans'
        numbers.
        """
        return self.step(shape, 0)

    def step(self, shape: tuple[int, ...], j: int) -> Tensor:
        """Noise of each scan in step j, (B, *shape) float32 on the CPU; step 0 is the start."""
        noise = torch.empty(len(self.numbers), *shape, dtype=torch.float32, device="cpu")
        for row, number in zip(noise, self.numbers, strict=True):
            row.copy_(standard_normal(shape, self.seed, self.purpose, number, j))
        return noise


def seed_torch(seed: int, purpose: str, index: int = 0) -> None:
    """Seed torch's generators, for initial weights and dropout; the CPU's uses the low 32 bits."""
    torch.manual_seed(int(generator(seed, purpose, index).integers(2**63)))
