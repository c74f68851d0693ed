from collections import Counter

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.loader import MixedOrder, Mixture, Permutations, RunSampler
from r2flow.data.sources import InMemory


def numbers(*values: float) -> InMemory:
    return InMemory(
        np.array(values, np.float32).reshape(-1, 1, 1, 1), [str(value) for value in values]
    )


def keys(images: int = 40, **options) -> list[tuple[int, int]]:
    return list(RunSampler(Permutations(10, 3), images, **options))


def test_every_scan_is_seen_once_an_epoch_in_another_order():
    order = [index for _, index in keys()]
    assert all(Counter(order[e * 10 : e * 10 + 10]) == Counter(range(10)) for e in range(4))
    assert order[:10] != order[10:20]


def test_a_late_start_continues_the_same_order():
    rest = keys(place=lambda: (28, 8))  # image 28 is next; this epoch of 40 began at image 20
    assert rest == keys(images=60)[28:]
    sampler = RunSampler(Permutations(10, 3), 40, place=lambda: (28, 8))
    assert len(sampler) == 40  # the length of the epoch, not of what is left


@pytest.mark.parametrize("ranks", [2, 4])
def test_ranks_share_every_global_batch(ranks):
    shares = [keys(rank=rank, ranks=ranks) for rank in range(ranks)]
    for first in range(0, 40, 8):  # global batches of 8
        own = slice(first // ranks, (first + 8) // ranks)
        assert sorted(key for share in shares for key in share[own]) == keys()[first : first + 8]


def test_validation_covers_every_scan_once_over_the_ranks():
    parts = [list(RunSampler(range(9), 9, rank, 3)) for rank in range(3)]
    assert sorted(key for part in parts for key in part) == [(i, i) for i in range(9)]
    assert parts[0] == [(0, 0), (3, 3), (6, 6)]


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
    parts = (
        np.bincount(
            np.searchsorted(np.cumsum(sizes), [order[k] for k in range(8000)], side="right")
        )
        / 8000
    )
    # standard deviation at most 0.0056
    np.testing.assert_allclose(parts, [3 / 8, 1 / 8, 4 / 8], atol=0.02)
    first = [index for k in range(8000) if (index := order[k]) < 5]
    # standard deviation 0.0073
    np.testing.assert_allclose(np.bincount(first) / len(first), [0.2] * 5, atol=0.03)
    assert [order[k] for k in (7999, 3)] == [
        MixedOrder(sizes, weights, seed=1)[k] for k in (7999, 3)
    ]


def test_what_cannot_be_mixed_is_refused():
    with pytest.raises(InputError, match="no scan left"):
        MixedOrder([1, 0], [1.0, 1.0], 0)
