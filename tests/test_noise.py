import multiprocessing
import zlib

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.noise import PURPOSES, Draws, generator, standard_normal


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
    others += [(1, purpose, 1, 1), (1, purpose, 1, 2)]
    others += [(1, other, 1) for other in PURPOSES if other != purpose]
    assert not any(torch.equal(standard_normal((64,), *key), here) for key in others)


def test_neighbouring_indices_never_overlap():
    # Philox counts blocks in its low words and the index stands in the highest: a long draw of one index
    # must not run into the next one's.
    long = generator(0, "training", 0).random(200_000)
    for following in (generator(0, "training", 1), generator(0, "training", 0, step=1)):
        assert not np.isin(following.random(16), long).any()


@pytest.mark.parametrize("seed", [-1, 2**64])
def test_a_seed_out_of_range_is_an_input_error(seed):
    with pytest.raises(InputError, match=f"found {seed}"):
        generator(seed, "evaluation", 0)


def test_step_j_of_scan_i_starts_philox_at_its_own_counter():
    key = np.array([7, zlib.crc32(b"evaluation")], dtype=np.uint64)
    expected = np.random.Generator(np.random.Philox(key=key, counter=5 * 2**128 + 3 * 2**192))
    noise = Draws(7, [3]).step((2, 4, 8), 5)
    assert torch.equal(noise, torch.from_numpy(expected.standard_normal((1, 2, 4, 8), dtype=np.float32)))


def test_the_start_is_the_standard_normal_of_each_number():
    noise = Draws(7, [4, 0, 2**40], "pairs").start((2, 4, 8))
    expected = [standard_normal((2, 4, 8), 7, "pairs", number) for number in (4, 0, 2**40)]
    assert noise.shape == (3, 2, 4, 8)
    assert torch.equal(noise, torch.stack(expected))


def test_noise_of_steps_is_standard_normal_and_uncorrelated_with_its_neighbours():
    n = 10_000
    x = torch.stack([Draws(3, range(5)).step((n,), j) for j in range(1, 6)]).double()  # (step, scan, n)
    # 250,000 draws: the mean has standard error 0.002, the variance 0.0028. Five of each are allowed.
    assert abs(x.mean()) < 0.01
    assert abs(x.var() - 1) < 0.014
    # A correlation of n pairs has standard error 1 / sqrt(n).
    for a, b in ((x[:-1], x[1:]), (x[:, :-1], x[:, 1:]), (x[1:, :-1], x[:-1, 1:])):
        assert (a * b).mean(-1).abs().max() < 5 / n**0.5
