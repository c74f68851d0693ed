"""Several data sets in one run, by weight."""

import numpy as np
import pytest

from r2flow.data.loader import RunSampler
from r2flow.data.mixture import MixedOrder, Mixture
from r2flow.errors import InputError

SIZES, WEIGHTS = [5, 40, 3], [3.0, 1.0, 4.0]


class Numbers:
    """A source whose scans are numbers."""

    def __init__(self, values) -> None:
        self.values = list(values)
        self.names = [str(value) for value in self.values]

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: int) -> np.ndarray:
        return np.full((2, 1, 1), self.values[index], np.float32)

    def subset(self, indices) -> "Numbers":
        return Numbers(self.values[i] for i in indices)


def values(source) -> list[int]:
    return [int(source[i][0, 0, 0]) for i in range(len(source))]


def test_parts_lie_end_to_end():
    mixture = Mixture([Numbers([1, 2]), Numbers([]), Numbers([7, 8, 9])])
    assert values(mixture) == [1, 2, 7, 8, 9]
    assert mixture.names == ["1", "2", "7", "8", "9"]
    some = mixture.subset([1, 2, 4])
    assert values(some) == [2, 7, 9]
    assert [len(part) for part in some.parts] == [1, 0, 2]
    with pytest.raises(IndexError):
        mixture[5]


def part_of(index: int) -> int:
    return int(np.searchsorted(np.cumsum(SIZES), index, side="right"))


def test_weights_are_the_shares_of_the_images():
    order = MixedOrder(SIZES, WEIGHTS, seed=1)
    parts = np.bincount([part_of(order[k]) for k in range(8000)]) / 8000
    np.testing.assert_allclose(parts, [3 / 8, 1 / 8, 4 / 8], atol=0.02)  # standard deviation at most 0.0056
    first = [index for k in range(8000) if (index := order[k]) < 5]
    np.testing.assert_allclose(np.bincount(first) / len(first), [0.2] * 5, atol=0.03)  # standard deviation 0.0073
    assert [order[k] for k in (7999, 3)] == [MixedOrder(SIZES, WEIGHTS, seed=1)[k] for k in (7999, 3)]


def test_resume_and_ranks_change_nothing():
    def keys(rank=0, ranks=1, first=0):
        sampler = RunSampler(MixedOrder(SIZES, WEIGHTS, seed=1), 4, 30, rank, ranks)
        sampler.first_batch = first
        return list(sampler)

    assert keys(first=11) == keys()[11:]
    for whole, *shares in zip(keys(), keys(0, 2), keys(1, 2), strict=True):
        assert sorted(key for share in shares for key in share) == sorted(whole)


def test_what_cannot_be_mixed_is_refused():
    with pytest.raises(InputError, match="no scan left"):
        MixedOrder([1, 0], [1.0, 1.0], 0)
