"""Intervals from resampled scans."""

import math

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.metrics import METRICS
from r2flow.metrics.beams import DropRate
from r2flow.metrics.bootstrap import bootstrap
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import one_of_each_class

EXACT = ["frechet_embedded", "jsd", "mmd", "beams", "drop_rate"]  # where a scan of weight 2 is one that is there twice


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("many", [False, True])
def test_a_weight_is_how_often_a_scan_is_there(name, many, scans_of, summary):
    sets = {"real": scans_of(15 if many else 5, 1), "generated": scans_of(14 if many else 6, 2)}
    draw = np.random.default_rng(0)
    copies = {side: torch.from_numpy(draw.integers(0, 3, (2, len(scans)))) for side, scans in sets.items()}
    metric = METRICS[name](keep=True)
    for side, scans in sets.items():
        metric.update(scans, side == "real")
    found = metric.resampled({side: weights.double() for side, weights in copies.items()})
    for r in range(2):
        again = METRICS[name]()
        for side, scans in sets.items():
            again.update(Scans(scans.images.repeat_interleave(copies[side][r], 0), scans.sensor), side == "real")
        drawn = {figure: float(values[r]) for figure, values in found.items()}
        assert drawn == pytest.approx(again.compute(), rel=1e-9)


def test_the_interval_of_a_mean_is_as_wide_as_statistics_say(scans_of):
    # Scans that drop all or nothing: rates 0.3 of 100 and 0.7 of 60, whose difference spreads by a known amount.
    sensor = scans_of(1).sensor
    metric = DropRate(keep=True)
    for real, n, dropped in ((True, 100, 30), (False, 60, 42)):
        images = torch.full((n, 1, *sensor.shape), 10.0)
        images[:dropped] = 0
        metric.update(Scans(images, sensor), real)
    low, high = bootstrap(metric, draws=2000, level=0.95)["drop_rate"]
    spread = 1.96 * math.sqrt(0.3 * 0.7 / 100 + 0.3 * 0.7 / 60)
    assert low == pytest.approx(0.4 - spread, abs=0.1 * spread)
    assert high == pytest.approx(0.4 + spread, abs=0.1 * spread)


def test_every_metric_has_an_interval_around_its_figure_or_says_that_it_has_none(scans_of, summary, coarse):
    for name in one_of_each_class():
        metric = METRICS[name](keep=True)
        metric.update(scans_of(20, 1), real=True)
        metric.update(scans_of(20, 2, scale=25), real=False)
        found = bootstrap(metric, draws=20)
        assert set(found) == (set(metric.compute()) if metric.resamples else set()), name
        for figure, (low, high) in found.items():
            assert 0 <= low <= metric.compute()[figure] <= high, figure


def test_draws_depend_on_the_seed_only(scans_of):
    def intervals(**options):
        metric = METRICS["jsd"](keep=True)
        metric.update(scans_of(9, 1), real=True)
        metric.update(scans_of(9, 2), real=False)
        return bootstrap(metric, draws=25, **options)

    counted = []
    assert intervals(advance=lambda: counted.append(1)) == intervals()
    assert len(counted) == 25
    assert intervals() != intervals(seed=1)


def test_what_cannot_be_resampled_is_refused(scans_of):
    with pytest.raises(InputError, match="keep=True"):
        bootstrap(METRICS["jsd"]())
    with pytest.raises(InputError, match="found 1 and 0.95"):
        bootstrap(METRICS["jsd"](keep=True), draws=1)
    metric = METRICS["mmd"]()
    metric.update(scans_of(3), real=True)
    assert bootstrap(metric) == {}  # no figure, no interval
