"""JSD, MMD and their namesakes of another toolbox, from above."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from r2flow.metrics.jsd_mmd import JSD, MMD, js_distance
from r2flow.metrics.lidm import JSDLiDM, MMDLiDM
from r2flow.metrics.scans import _birds_eye_histogram
from tests.metrics.conftest import given, measured, scans_of


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


def cells(points, size, depth=(1.0, 56.0)):
    """Cells that hold a return, by another way: a set of pairs."""
    r = np.linalg.norm(points, axis=1)
    inside = points[(r > depth[0]) & (r < depth[1]) & (np.abs(points[:, :2]) < 50).all(1)]
    return {tuple(cell) for cell in np.floor(inside[:, :2] / np.float32(size)).astype(int).tolist()}


def test_jsd_of_the_other_toolbox_counts_scans_that_hold_a_cell():
    def shares(scans):
        held = [cells(p.numpy(), 0.05) for p in scans.points]
        counts = {cell: sum(cell in one for one in held) for cell in set().union(*held)}
        total = sum(counts.values())
        return {cell: n / total for cell, n in counts.items()}

    real, generated = scans_of(4, 1, scale=3), scans_of(3, 2, scale=3)
    p, q = shares(real), shares(generated)
    divergence = 0.0
    for a, b in ((p, q), (q, p)):
        divergence += sum(x * math.log(2 * x / (x + b.get(cell, 0))) for cell, x in a.items()) / 2
    assert 0.01 < divergence < 0.69
    assert measured(JSDLiDM(), real, generated).compute()["jsd_lidm"] == pytest.approx(
        math.sqrt(divergence), rel=1e-9
    )


def test_mmd_of_the_other_toolbox_is_the_mean_distance_to_the_best_match(monkeypatch):
    monkeypatch.setattr("r2flow.metrics.base.BLOCK", 2)
    real, generated = scans_of(5, 1), scans_of(3, 2)

    def chamfer(a, b):
        d = ((a[:, None] - b) ** 2).sum(-1)
        return (d.min(0).mean() + d.min(1).mean()) / 2

    sets = [
        [np.array(sorted(cells(p.numpy(), 0.5))) / 200 for p in side.points]
        for side in (real, generated)
    ]
    expected = np.mean([min(chamfer(a, b) for b in sets[1]) for a in sets[0]])
    assert measured(MMDLiDM(), real, generated).compute()["mmd_lidm"] == pytest.approx(
        expected, rel=1e-6
    )
    assert measured(MMDLiDM(), real, real).compute()["mmd_lidm"] == 0


def test_js_distance_of_known_histograms():
    # p = (1, 0), q = (1/2, 1/2), m = (3/4, 1/4), by hand.
    expected = math.sqrt((math.log(4 / 3) + 0.5 * math.log(2 / 3) + 0.5 * math.log(2)) / 2)
    assert js_distance(np.array([5, 0]), np.array([3, 3])) == pytest.approx(expected)
    empty = np.zeros(2)
    assert js_distance(empty, np.ones(2)) == pytest.approx(math.sqrt(math.log(2)))
    assert js_distance(empty, empty) == 0
