"""JSD, MMD and their namesakes of another toolbox, from above."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from r2flow.metrics.jsd_mmd import JSD, MMD, js_distance
from r2flow.metrics.scans import _birds_eye_histogram
from tests.metrics.conftest import given


def test_reference_figures(shared):
    case = torch.load(shared / "oracle" / "bev_metrics.pt", weights_only=True)
    seen = np.stack([_birds_eye_histogram(points.numpy()) for points in case["point_clouds"]])
    np.testing.assert_array_equal(seen, case["hists"])
    real, generated = seen[:12].astype(float), seen[12:].astype(float)
    # made of float32 histograms
    assert given(JSD(), real, generated)["jsd"] == pytest.approx(case["jsd"], rel=1e-7)
    assert given(MMD(), real, generated)["mmd"] == pytest.approx(case["mmd_float64"], rel=1e-10)
    assert given(JSD(), real, real)["jsd"] == case["jsd_same"]
    assert given(MMD(), real, real)["mmd"] == pytest.approx(case["mmd_same"], abs=1e-15)


def test_mmd_is_the_mean_over_all_pairs_in_blocks_of_any_size(monkeypatch):
    counts = np.random.default_rng(0).poisson(0.02, (17, 100, 100))
    p = counts.reshape(17, -1) / counts.sum((1, 2))[:, None]

    def mean(a, b):
        # 1 / (2 sigma^2) = 2
        return np.mean([math.exp(-2 * ((x - y) ** 2).sum()) for x, y in product(a, b)])

    expected = mean(p[:10], p[:10]) + mean(p[10:], p[10:]) - 2 * mean(p[:10], p[10:])

    for block in (3, 1000):
        monkeypatch.setattr("r2flow.metrics.base.BLOCK", block)
        sets = counts[:10].astype(float), counts[10:].astype(float)
        assert given(MMD(), *sets)["mmd"] == pytest.approx(expected, rel=1e-9)


def test_js_distance_of_known_histograms():
    # p = (1, 0), q = (1/2, 1/2), m = (3/4, 1/4), by hand.
    expected = math.sqrt((math.log(4 / 3) + 0.5 * math.log(2 / 3) + 0.5 * math.log(2)) / 2)
    assert js_distance(np.array([5, 0]), np.array([3, 3])) == pytest.approx(expected)
    empty = np.zeros(2)
    assert js_distance(empty, np.ones(2)) == pytest.approx(math.sqrt(math.log(2)))
    assert js_distance(empty, empty) == 0
