"""Frechet distances with known answers."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.features import FrechetDistance, _frechet_distance, gaussian
from tests.metrics.conftest import Summary, measured, scans_of


def positive(d, seed, rank=None):
    a = torch.randn(
        d, rank or d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return a @ a.T / d


@pytest.mark.parametrize(
    ("d", "rank_1", "rank_t", "tolerance"),
    # Full rank, but eigenvalues down to 1e-13 of the largest, whose roots are known to that much
    # less.
    [
        (20, 20, 20, 1e-6),
        (60, 60, 60, 1e-6),
        (40, 7, 40, 1e-11),
        (40, 40, 5, 1e-11),
        (40, 9, 12, 1e-11),
    ],
)
def test_non_commuting_and_singular_covariances_cost_what_the_optimal_map_costs(
    d, rank_1, rank_t, tolerance
):
    # A positive T carries N(0, S_1) to N(0, T S_1 T) optimally (Brenier): at the cost tr (I - T)
    # S_1 (I - T).
    s_1, t = positive(d, 1, rank_1), positive(d, 2, rank_t)
    move = torch.eye(d, dtype=torch.float64) - t
    expected = float((move @ s_1 @ move).trace())
    zero = torch.zeros(d, dtype=torch.float64)
    assert _frechet_distance(zero, s_1, zero, t @ s_1 @ t) == pytest.approx(expected, abs=tolerance)
    assert _frechet_distance(zero, t @ s_1 @ t, zero, s_1) == pytest.approx(expected, abs=tolerance)


def test_equal_and_degenerate_gaussians():
    zero, s = torch.zeros(50, dtype=torch.float64), positive(50, 3, 20)
    assert _frechet_distance(zero, s, zero, s) == pytest.approx(0, abs=1e-10)
    assert _frechet_distance(zero, 0 * s, zero, s) == pytest.approx(float(s.trace()), rel=1e-12)
    assert _frechet_distance(zero, 0 * s, zero + 3, 0 * s) == 50 * 9


def test_reference_figures(shared):
    for case in torch.load(
        shared / "oracle" / "distribution_metrics.pt", weights_only=True
    ).values():
        found = _frechet_distance(*gaussian(case["f1"]), *gaussian(case["f2"]))
        assert found == pytest.approx(case["frechet"], rel=1e-9)


def test_float32_features_far_from_zero_lose_nothing(monkeypatch):
    monkeypatch.setattr("r2flow.metrics.base.BLOCK", 400)  # 999 rows in three blocks
    far = (1e4 + 1e-2 * torch.randn(999, 12, dtype=torch.float64)).float()
    x = far.double().numpy()
    expected = np.cov(x, rowvar=False)
    mean, covariance = gaussian(far)
    np.testing.assert_allclose(mean, x.mean(0), rtol=1e-14)
    np.testing.assert_allclose(covariance, expected, rtol=0, atol=1e-10 * expected.max())


def test_fewer_scans_than_dimensions_is_exact_and_said(summary):
    real, generated = scans_of(4, 1), scans_of(5, 2)
    metric = measured(FrechetDistance(summary), real, generated)
    # tr (S_1 S_2)^(1/2) is the nuclear norm of the centred features' product: no covariance is
    # made.
    x, y = (summary.features(s).double().numpy() for s in (real, generated))
    a, b = (z - z.mean(0) for z in (x, y))
    common = np.linalg.norm(a @ b.T, "nuc") / math.sqrt(3 * 4)
    expected = (
        ((x.mean(0) - y.mean(0)) ** 2).sum() + (a**2).sum() / 3 + (b**2).sum() / 4 - 2 * common
    )
    assert metric.compute() == {"frechet_summary": pytest.approx(expected, rel=1e-9)}
    assert any(
        "fewer scans than features" in said and "too large" in said for said in metric.remarks
    )


def test_random_weights_never_have_the_field_s_name(summary):
    metric = FrechetDistance("rangenet53")
    assert metric.protocol.metric == "frd"
    metric.extractor.weights = "random"
    assert FrechetDistance(metric.extractor).protocol.metric == "frechet_rangenet53_random"


def test_a_plugin_s_network_is_known_by_its_weights(monkeypatch):
    def trained():
        network = Summary("mine")
        network.weights, network.scale = "random", nn.Parameter(torch.rand(1))
        return network

    monkeypatch.setattr(EXTRACTORS, "_entries", {"mine": SimpleNamespace(trained=trained)})
    one, other = (FrechetDistance("mine").protocol for _ in range(2))
    assert one.metric == other.metric == "frechet_mine"
    assert one.weights != other.weights
