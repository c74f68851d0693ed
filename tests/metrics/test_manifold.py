"""Precision, recall, density, coverage and the kernel distance of features."""

import numpy as np
import pytest
import torch

from r2flow.metrics import kid, manifold
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.kid import KernelDistance, cubic_mmd
from r2flow.metrics.manifold import Manifold
from r2flow.metrics.scans import Scans


class Given(Extractor):
    """Features that are handed in as if they were scans."""

    name = "given"
    layer = "as they are"
    dim = 3
    weights = "0123456789ab"

    def features(self, scans):
        return scans.rows


class Rows(Scans):
    has_reflectance = False

    def __init__(self, rows):
        self.rows = torch.as_tensor(rows, dtype=torch.float32)


def figures(real, generated):
    metric = Manifold(Given())
    metric.update(Rows(real), real=True)
    metric.update(Rows(generated), real=False)
    return [value for _, value in metric.compute().items()], metric.remarks()


def brute_force(real, generated, k):
    """The papers' definitions, one pair after the other."""

    def radius(rows, i):
        return np.sort(np.linalg.norm(np.delete(rows, i, 0) - rows[i], axis=1))[k - 1]

    r_real, r_generated = ([radius(rows, i) for i in range(len(rows))] for rows in (real, generated))
    inside = [[np.linalg.norm(g - r) <= r_real[i] for i, r in enumerate(real)] for g in generated]
    recalled = [any(np.linalg.norm(g - r) <= r_generated[j] for j, g in enumerate(generated)) for r in real]
    return [np.any(inside, 1).mean(), np.mean(recalled), np.sum(inside) / k / len(generated), np.any(inside, 0).mean()]


@pytest.mark.parametrize(("k", "block"), [(1, 7), (3, 2000), (5, 10)])
def test_as_pair_by_pair(k, block, monkeypatch):
    monkeypatch.setattr(manifold, "BLOCK", block)
    monkeypatch.setattr(manifold, "NEIGHBOURS", k)
    draw = np.random.default_rng(k)
    real, generated = draw.normal(size=(31, 3)).astype("f4"), draw.normal(0.7, 0.6, size=(24, 3)).astype("f4")
    found, _ = figures(real, generated)
    assert found == pytest.approx(brute_force(real.astype(float), generated.astype(float), k), abs=1e-12)
    assert 0 < found[1] < found[0] < 1


def test_a_set_covers_itself_and_nothing_far_away():
    rows = np.random.default_rng(0).normal(size=(40, 3))
    # Every ball holds its middle and the k nearest: density (k + 1) / k.
    assert figures(rows, rows)[0] == pytest.approx([1, 1, 6 / 5, 1])
    assert figures(rows, rows + 1000)[0] == [0, 0, 0, 0]


def test_repeated_scans_lie_on_each_other_however_far_from_zero():
    rows = np.repeat(1e3 + np.random.default_rng(0).normal(size=(10, 301)), 6, axis=0)
    # Every ball has the radius 0, and holds the six that are one.
    assert figures(rows, rows)[0] == pytest.approx([1, 1, 6 / 5, 1])
    x = torch.from_numpy(rows)
    assert not manifold.squared_distances(x, x).diagonal().any()  # where two ways to add up are rounded differently


def test_one_mode_of_two_is_precise_and_recalls_half():
    draw = np.random.default_rng(0)
    mode = draw.normal(size=(50, 3))
    precision, recall, _, coverage = figures(np.concatenate([mode, mode + 100]), draw.normal(size=(200, 3)))[0]
    assert precision > 0.8
    assert recall < 0.55
    assert coverage < 0.55


def test_too_few_scans_have_no_neighbours():
    found, said = figures(np.zeros((5, 3)), np.zeros((9, 3)))
    assert np.isnan(found).all()
    assert any("too few real scans to have 5 neighbours each" in one for one in said)


def test_the_name_is_that_of_its_network():
    assert Manifold(Given()).protocol.metric == "manifold_given"


@pytest.mark.parametrize("dead", [0, 4, 5, 8])
def test_the_kernel_distance_does_not_depend_on_the_order_of_scans_whichever_channels_are_0(dead, monkeypatch):
    monkeypatch.setattr(kid, "SUBSETS", 3)
    monkeypatch.setattr(kid, "SUBSET_SIZE", 7)
    real, generated = torch.randn(2, 20, 8)
    real[:, :dead], generated[:, :dead] = 0, 0
    values = []
    for order in (slice(None), torch.randperm(20)):
        metric = KernelDistance(Given())
        metric.update(Rows(real[order]), real=True)
        metric.update(Rows(generated), real=False)
        values += metric.compute().values()
    assert values[1] == pytest.approx(values[0], rel=1e-10, abs=1e-14)


def test_the_kernel_distance_is_the_reference_on_its_own_subsets(shared):
    for case in torch.load(shared / "oracle" / "distribution_metrics.pt", weights_only=True).values():
        f_1, f_2 = case["f1"].double(), case["f2"].double()
        for subsets, most, expected in (
            (100, 1000, case["kid_like_mmd_seed0"]),
            (5, 100, case["kid_like_5x100_seed0"]),
        ):
            draw = np.random.RandomState(0)
            size, values = min(len(f_1), len(f_2), most), []
            for _ in range(subsets):
                x, y = (f[torch.from_numpy(draw.choice(len(f), size, replace=False))] for f in (f_2, f_1))
                values.append(cubic_mmd(x, y))
            assert np.mean(values) == pytest.approx(expected, rel=1e-6)  # theirs is float32
