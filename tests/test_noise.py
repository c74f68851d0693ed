import zlib

import numpy as np
import pytest
import torch

from r2flow.base.noise import PURPOSES, Draws


def expected(seed: int, purpose: str, index: int, step: int = 0) -> torch.Tensor:
    """Philox under a key of seed and purpose, at a counter of index and step: the definition."""
    key = np.array([seed, zlib.crc32(purpose.encode())], dtype=np.uint64)
    draws = np.random.Generator(np.random.Philox(key=key, counter=step * 2**128 + index * 2**192))
    return torch.from_numpy(draws.standard_normal((2, 4, 8), dtype=np.float32))


@pytest.mark.parametrize("purpose", PURPOSES)
@pytest.mark.parametrize(
    ("seed", "index", "step"),
    [(7, 3, 0), (7, 3, 5), (1 + 2**32, 1 + 2**32, 1), (2**64 - 1, 2**40, 0)],
)
def test_a_draw_is_that_of_its_seed_purpose_index_and_step(
    purpose: str, seed: int, index: int, step: int
):
    draws = Draws(seed, [0, index], purpose)
    assert torch.equal(draws.start((2, 4, 8))[1], expected(seed, purpose, index))
    assert torch.equal(draws.step((2, 4, 8), step)[1], expected(seed, purpose, index, step))
