import multiprocessing

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.noise import PURPOSES, generator, standard_normal


def test_a_draw_depends_on_its_index_alone():
    alone = standard_normal((2, 8, 16), 7, "training", 41)
    for index in (3, 41, 40):
        drawn = standard_normal((2, 8, 16), 7, "training", index)
    assert torch.equal(standard_normal((2, 8, 16), 7, "training", 41), alone)
    assert not torch.equal(drawn, alone)


def _draw(index):
    return standard_normal((4,), 7, "pairs", index).tolist()


def test_another_process_draws_the_same():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(_draw, [5, 6]) == [_draw(5), _draw(6)]


@pytest.mark.parametrize("purpose", PURPOSES)
def test_no_two_purposes_seeds_or_indices_share_a_draw(purpose):
    here = standard_normal((64,), 1, purpose, 1)
    others = [(1, purpose, 2), (2, purpose, 1), (1 + 2**32, purpose, 1), (1, purpose, 1 + 2**32)]
    others += [(1, other, 1) for other in PURPOSES if other != purpose]
    assert not any(torch.equal(standard_normal((64,), *key), here) for key in others)


def test_neighbouring_indices_never_overlap():
    # Philox counts blocks in its low words and the index stands in the highest: a long draw of one index
    # must not run into the next one's.
    long = generator(0, "training", 0).random(200_000)
    following = generator(0, "training", 1).random(16)
    assert not np.isin(following, long).any()


def test_the_noise_is_standard_normal():
    x = torch.cat([standard_normal((10_000,), 3, "training", k) for k in range(20)])
    # 200,000 draws: the mean has standard error 0.0022, the variance 0.0032.
    assert abs(x.mean()) < 0.01
    assert abs(x.var() - 1) < 0.015


@pytest.mark.parametrize(("seed", "purpose", "index"), [(-1, "training", 0), (0, "training", 2**64), (0, "play", 0)])
def test_what_cannot_be_a_key_is_refused(seed, purpose, index):
    with pytest.raises(ValueError, match=r"must lie in|no purpose"):
        generator(seed, purpose, index)


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_a_seed_out_of_range_is_the_user_s_to_mend(seed):
    with pytest.raises(InputError, match=f"found {seed}"):
        generator(seed, "evaluation", 0)
