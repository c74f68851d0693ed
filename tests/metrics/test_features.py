"""The kernel distance of features."""

from itertools import combinations, product

import numpy as np
import pytest
import torch

from r2flow.metrics.features import KernelDistance
from tests.metrics.conftest import Summary, given


def kernel_distance(real, generated):
    rows = (torch.as_tensor(x).float() for x in (real, generated))
    (found,) = given(KernelDistance(Summary()), *rows).values()
    return found


def test_the_kernel_distance_of_two_gaussians_is_that_of_their_moments():
    # k = 1 + 3 a b + 3 (a b)^2 + (a b)^3 on one feature, so that MMD^2 = sum of 3, 3, 1 times the
    # squared differences of the first three moments: mu, mu^2 + s^2, mu^3 + 3 mu s^2. The samples
    # are the quantiles of the Gaussians.
    quantiles = torch.special.ndtri((torch.arange(4000, dtype=torch.float64) + 0.5) / 4000)[:, None]
    moments = [np.array([m, m**2 + s**2, m**3 + 3 * m * s**2]) for m, s in ((0.5, 1.0), (0.0, 1.5))]
    expected = float(np.array([3, 3, 1]) @ (moments[0] - moments[1]) ** 2)
    assert kernel_distance(0.5 + quantiles, 1.5 * quantiles[::2]) == pytest.approx(
        expected, rel=0.02
    )


def test_the_kernel_distance_is_the_mean_over_all_subsets_in_blocks_of_any_size(monkeypatch):
    real, generated = (
        torch.randn(6, 3, dtype=torch.float64).float(),
        torch.randn(7, 3, dtype=torch.float64).float(),
    )
    sides = [list(combinations(range(len(rows)), 3)) for rows in (real, generated)]
    expected = np.mean(
        [kernel_distance(real[list(a)], generated[list(b)]) for a, b in product(*sides)]
    )
    for block in (2, 1000):
        monkeypatch.setattr("r2flow.metrics.base.BLOCK", block)
        assert kernel_distance(real, generated) == pytest.approx(expected, rel=1e-9)


def test_the_kernel_distance_is_the_reference_on_its_own_subsets(shared):
    for case in torch.load(
        shared / "oracle" / "distribution_metrics.pt", weights_only=True
    ).values():
        f_1, f_2 = case["f1"].double(), case["f2"].double()
        for subsets, most, expected in (
            (100, 1000, case["kid_like_mmd_seed0"]),
            (5, 100, case["kid_like_5x100_seed0"]),
        ):
            draw = np.random.RandomState(0)
            size, values = min(len(f_1), len(f_2), most), []
            for _ in range(subsets):
                x, y = (
                    f[torch.from_numpy(draw.choice(len(f), size, replace=False))]
                    for f in (f_2, f_1)
                )
                values.append(kernel_distance(x, y))
            assert np.mean(values) == pytest.approx(expected, rel=1e-6)  # theirs is float32
