"""A classifier that tells two sets apart, against what is known of Gaussians and of a direct count."""

import math

import numpy as np
import pytest
import torch

from r2flow.lidar.sensors import build_sensor
from r2flow.metrics import METRICS
from r2flow.metrics.two_sample import TwoSample, area
from r2flow.simulator import simulate

SENSOR = build_sensor("hdl64e", 32, 256)


def metric(real: torch.Tensor, generated: torch.Tensor) -> TwoSample:
    """With these features, (N, D), in the place of scans'."""
    found = METRICS["auc"]()
    found.add_rows(real, "real")
    found.add_rows(generated, "generated")
    return found


@pytest.mark.parametrize("apart", [0.0, 1.0, 3.0])
def test_gaussians_have_the_area_of_their_distance(apart):
    draw = torch.Generator().manual_seed(4)
    x, y = torch.randn(4000, 3, generator=draw), torch.randn(4000, 3, generator=draw)
    y[:, 1] += apart
    # P(N(apart, 1) > N(0, 1)) = Phi(apart / sqrt 2); the error of an area of 2 x 4,000 scores is below 0.007
    expected = (1 + math.erf(apart / 2)) / 2
    assert metric(x, y).compute()["auc"] == pytest.approx(expected, abs=0.02)


def test_chance_is_a_half_also_for_more_features_than_scans():
    draw = torch.Generator().manual_seed(5)
    values = [metric(*(torch.randn(30, 146, generator=draw) for _ in range(2))).compute()["auc"] for _ in range(20)]
    assert np.mean(values) == pytest.approx(0.5, abs=0.05)


def test_halves_are_blocks_so_that_neighbours_do_not_help():
    """Each half of the generated set differs from the real one in the other direction: nothing that generalises."""
    draw = torch.Generator().manual_seed(6)
    x, y = torch.randn(400, 2, generator=draw), torch.randn(400, 2, generator=draw)
    y[:200, 0] += 3
    y[200:, 0] -= 3
    assert metric(x, y).compute()["auc"] < 0.2


def test_the_area_is_a_count_of_pairs_and_weights_are_repeats():
    negative, positive = torch.tensor([0.1, 0.4, 0.4]).double(), torch.tensor([0.4, 0.9]).double()
    ones = [torch.ones(1, 3).double(), torch.ones(1, 2).double()]
    assert float(area(negative, positive, *ones)) == pytest.approx((1 + 0.5 + 0.5 + 3) / 6)
    twice = area(negative, positive, torch.tensor([[2.0, 0, 1]]).double(), torch.tensor([[1.0, 3]]).double())
    repeated = [negative[[0, 0, 2]], positive[[0, 1, 1, 1]]]
    alone = area(*repeated, torch.ones(1, 3).double(), torch.ones(1, 4).double())
    assert float(twice) == pytest.approx(float(alone))


def test_simulated_scans_of_two_seeds_are_alike_and_of_fewer_returns_are_not():
    images = torch.from_numpy(np.stack([simulate(SENSOR, 3, i).image for i in range(48)]))
    found = METRICS["auc"](sensor=SENSOR)
    found.update(images[:24], real=True)
    found.update(images[24:], real=False)
    assert 0.2 < found.compute()["auc"] < 0.8
    thinned = images[24:] * (torch.rand(24, 1, *SENSOR.shape, generator=torch.Generator().manual_seed(0)) > 0.1)
    other = METRICS["auc"](sensor=SENSOR)
    other.update(images[:24], real=True)
    other.update(thinned, real=False)
    assert other.compute()["auc"] > 0.95
