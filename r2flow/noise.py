"""Counter-based randomness: every draw is a function of (run seed, purpose, index) alone.

The noise of image k does not depend on the worker, rank or device that draws it, nor on what was
drawn before; that is what makes a run resumable bit for bit and pairs redrawable from their index.
The purpose is part of the key, so that training, evaluation and simulation never share a draw.
"""

import zlib

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError

PURPOSES = (
    "training", "validation", "pairs", "evaluation", "simulator", "shuffle", "mixture", "augmentation", "dropout",
    "weights",
)  # fmt: skip


def generator(seed: int, purpose: str, index: int) -> np.random.Generator:
    """The random stream of one index: Philox keyed by (seed, purpose), its counter started at index.

    Args:
        seed: Run seed, 0 <= seed < 2^64.
        purpose: One of `PURPOSES`.
        index: Number of the image, scene or epoch, 0 <= index < 2^64.

    Raises:
        InputError: a seed outside its range, which is the user's to choose.
        ValueError: an unknown purpose, or an index outside its range.
    """
    if purpose not in PURPOSES:
        raise ValueError(f"no purpose named {purpose!r}; known: {', '.join(PURPOSES)}.")
    if not 0 <= seed < 2**64:
        raise InputError(f"a seed must lie in [0, 2^64), found {seed}.")
    if not 0 <= index < 2**64:
        raise ValueError(f"an index must lie in [0, 2^64), found {index}.")
    # Philox4x64 has a 128-bit key and a 256-bit counter that counts blocks of four draws in its low
    # words: the index goes into the highest word, which leaves 2^192 blocks to each index.
    key = np.array([seed, zlib.crc32(purpose.encode())], dtype=np.uint64)
    counter = np.array([0, 0, 0, index], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def standard_normal(shape: tuple[int, ...], seed: int, purpose: str, index: int) -> Tensor:
    """x_0 ~ N(0, I) of one index, float32 on the CPU, of the given shape."""
    return torch.from_numpy(generator(seed, purpose, index).standard_normal(shape, dtype=np.float32))


def seed_torch(seed: int, purpose: str, index: int = 0) -> None:
    """Start torch's own generators from a draw of ours, for what draws from them: initial weights, dropout."""
    torch.manual_seed(int(generator(seed, purpose, index).integers(2**63)))
