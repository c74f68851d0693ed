"""Intervals from resampled scans."""

import math

import numpy as np
import pytest
import torch

from r2flow.metrics import METRICS
from r2flow.metrics.bootstrap import bootstrap
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric
from tests.metrics.conftest import measured, one_of_each_class, scans_of

EXACT = ["frechet_handcrafted", "jsd", "mmd"]  # where a scan of weight 2 is one that is there twice


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("many", [False, True])
def test_a_weight_is_how_often_a_scan_is_there(name, many, summary):
    sets = {"real": scans_of(15 if many else 5, 1), "generated": scans_of(14 if many else 6, 2)}
    draw = np.random.default_rng(0)
    copies = {side: torch.from_numpy(draw.integers(0, 3, (2, len(scans)))) for side, scans in sets.items()}
    metric = measured(METRICS[name](keep=True), *sets.values())
    found = metric.resampled({side: weights.double() for side, weights in copies.items()})
    for r in range(2):
        repeated = (Scans(x.images.repeat_interleave(copies[side][r], 0), x.sensor) for side, x in sets.items())
        expected = measured(METRICS[name](), *repeated).compute()
        assert {figure: float(values[r]) for figure, values in found.items()} == pytest.approx(
            {figure: expected[figure] for figure in found}, rel=1e-9
        )


class SquaredMeanDistance(SumMetric):
    """|mean x - mean y|^2 of vectors; the last number of a row is 1 and counts them."""

    name, representation, width = "squared", "vectors", 33

    def figures_of(self, real, generated):
        return {"squared": float(np.square(real[:-1] / real[-1] - generated[:-1] / generated[-1]).sum())}


@pytest.mark.parametrize("apart", [0.0, 2.0])
def test_intervals_are_as_wide_as_statistics_say_near_equal_sets_too(apart):
    """N(0, 1) in D = 32 and N(apart, 1): the variance is 4 apart^2 s + 2 D s^2, s = 1 / n + 1 / m.

    Scans drawn with repetition would spread the second term by three times as much.
    """
    draw, n, m, variances = np.random.default_rng(0), 60, 40, []
    metric = SquaredMeanDistance(keep=True)
    for _ in range(60):
        metric.reset()
        for side, count, shift in (("real", n, 0.0), ("generated", m, apart)):
            x = draw.standard_normal((count, 32))
            x[:, 0] += shift
            metric.add_rows(torch.from_numpy(np.hstack([x, np.ones((count, 1))])), side)
        value = metric.compute()["squared"]
        _, high = bootstrap(metric, draws=60)["squared"]
        sigma = max(value * math.log(high / value), high - value if high > 2.71 * value else 0) / 2.042  # t of 30
        variances.append(sigma**2)
    s = 1 / n + 1 / m
    assert np.mean(variances) == pytest.approx(4 * apart**2 * s + 2 * 32 * s**2, rel=0.2)


def test_every_metric_has_an_interval_around_its_figure_or_says_that_it_has_none(summary, coarse):
    for name in one_of_each_class():
        metric = measured(METRICS[name](keep=True), scans_of(20, 1), scans_of(20, 2, scale=25))
        found = bootstrap(metric, draws=20)
        expected = set(metric.compute()) if metric.resamples and metric.fewest <= 20 else set()
        assert set(found) == expected, name
        for figure, (low, high) in found.items():
            assert 0 <= low <= metric.compute()[figure] <= high <= metric.highest, figure


class MeanDifference(SumMetric):
    """mean x - mean y of numbers; the second number of a row counts them."""

    name, representation, width = "difference", "numbers", 2

    def figures_of(self, real, generated):
        return {"difference": float(generated[0] / generated[1] - real[0] / real[1])}


def test_the_interval_of_a_negative_figure_lies_around_it():
    metric, draw = MeanDifference(keep=True), np.random.default_rng(0)
    for side, shift in (("real", 1.0), ("generated", 0.0)):
        metric.add_rows(torch.from_numpy(np.stack([draw.normal(shift, 1, 50), np.ones(50)], 1)), side)
    low, high = bootstrap(metric, draws=200)["difference"]
    middle, sigma = metric.compute()["difference"], math.sqrt(2 / 50)
    assert (low, high) == pytest.approx((middle - 1.96 * sigma, middle + 1.96 * sigma), abs=0.25 * sigma)


def test_draws_depend_on_the_seed_only():
    def intervals(**options):
        metric = measured(METRICS["jsd"](keep=True), scans_of(9, 1), scans_of(9, 2))
        return bootstrap(metric, draws=26, **options)

    counted = []
    assert intervals(advance=counted.append) == intervals()
    assert sum(counted) == 26
    assert intervals() != intervals(seed=1)


def test_what_cannot_be_resampled_is_refused():
    with pytest.raises(AssertionError, match="found 3"):
        bootstrap(METRICS["jsd"](keep=True), draws=3)
    metric = METRICS["mmd"]()
    metric.update(scans_of(3), real=True)
    assert bootstrap(metric) == {}  # no figure, no interval
