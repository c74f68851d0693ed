from collections import Counter

import numpy as np
import pytest

from r2flow.data.loader import MixedOrder, Mixture, Permutations, RunSampler
from r2flow.data.sources import InMemory
from r2flow.errors import InputError


def numbers(*values: float) -> InMemory:
    return InMemory(np.array(values, np.float32).reshape(-1, 1, 1, 1), [str(value) for value in values])


def keys(**options) -> list[list[tuple[int, int]]]:
    return list(RunSampler(Permutations(10, 3), **{"batch_size": 4, "images": 40, **options}))


def test_every_scan_is_seen_once_an_epoch_in_another_order():
    order = [index for batch in keys() for _, index in batch]
    assert all(Counter(order[e * 10 : e * 10 + 10]) == Counter(range(10)) for e in range(4))
    assert order[:10] != order[10:20]


def test_a_late_start_continues_the_same_order():
    sampler = RunSampler(Permutations(10, 3), 4, 40)
    sampler.first_batch = 7
    assert list(sampler) == keys()[7:]
    assert len(sampler) == 10  # the length of the run, not of what is left


@pytest.mark.parametrize("ranks", [2, 4])
def test_ranks_share_every_global_batch(ranks):
    for whole, *shares in zip(keys(), *(keys(rank=rank, ranks=ranks) for rank in range(ranks)), strict=True):
        assert sorted(k for share in shares for k in share) == sorted(whole)
        assert len({len(share) for share in shares}) == 1


def test_validation_covers_every_scan_once_over_the_ranks():
    parts = [list(RunSampler(range(10), 6, 10, rank, 3)) for rank in range(3)]
    assert sorted(key for batches in parts for batch in batches for key in batch) == [(i, i) for i in range(10)]
    assert parts[0] == [[(0, 0), (3, 3)], [(6, 6), (9, 9)]]


def values(source) -> list[int]:
    return [int(source[i][0, 0, 0]) for i in range(len(source))]


def test_parts_lie_end_to_end():
    mixture = Mixture([numbers(1, 2), numbers(), numbers(7, 8, 9)])
    assert values(mixture) == [1, 2, 7, 8, 9]
    assert mixture.names == ["1", "2", "7", "8", "9"]
    some = mixture.subset([1, 2, 4])
    assert values(some) == [2, 7, 9]
    assert [len(part) for part in some.parts] == [1, 0, 2]
    with pytest.raises(IndexError):
        mixture[5]


def test_weights_are_the_shares_of_the_images():
    sizes, weights = [5, 40, 3], [3.0, 1.0, 4.0]
    order = MixedOrder(sizes, weights, seed=1)
    parts = np.bincount(np.searchsorted(np.cumsum(sizes), [order[k] for k in range(8000)], side="right")) / 8000
    np.testing.assert_allclose(parts, [3 / 8, 1 / 8, 4 / 8], atol=0.02)  # standard deviation at most 0.0056
    first = [index for k in range(8000) if (index := order[k]) < 5]
    np.testing.assert_allclose(np.bincount(first) / len(first), [0.2] * 5, atol=0.03)  # standard deviation 0.0073
    assert [order[k] for k in (7999, 3)] == [MixedOrder(sizes, weights, seed=1)[k] for k in (7999, 3)]


def test_what_cannot_be_mixed_is_refused():
    with pytest.raises(InputError, match="no scan left"):
        MixedOrder([1, 0], [1.0, 1.0], 0)
