"""Histograms of single beams and the share of rays that nothing came back from."""

import math

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.beams import BeamHistograms, DropRate
from r2flow.metrics.scans import Scans

SENSOR = SENSORS["hdl64e"].resized(8, 32)
FARTHEST = math.sqrt(math.log(2))


def images(n=3, r=10.0, reflectance=0.5, sensor=SENSOR):
    h, w = sensor.shape
    return torch.tensor([r, reflectance]).view(1, 2, 1, 1).repeat(n, 1, h, w)


def figures(metric, real, generated, sensor=SENSOR):
    metric.update(Scans(real, sensor), real=True)
    metric.update(Scans(generated, sensor), real=False)
    return metric.compute()


def test_one_beam_of_eight_that_measures_otherwise_is_an_eighth_of_the_distance():
    generated = images()
    generated[:, 0, 5] = 20
    assert figures(BeamHistograms(), images(), images()) == {"beam_range": 0, "beam_reflectance": 0}
    found = figures(BeamHistograms(), images(), generated)
    assert found == {"beam_range": pytest.approx(FARTHEST / 8), "beam_reflectance": 0}
    generated[:, 1, :4] = 0.9
    assert figures(BeamHistograms(), images(), generated)["beam_reflectance"] == pytest.approx(FARTHEST / 2)


def test_beams_that_swap_their_ranges_are_seen():
    real, generated = images(), images()
    real[:, 0, ::2], generated[:, 0, 1::2] = 30, 30  # the same ranges, altogether
    assert figures(BeamHistograms(), real, generated)["beam_range"] == pytest.approx(FARTHEST)


def test_without_reflectance_its_distance_does_not_exist():
    metric = BeamHistograms()
    assert math.isnan(figures(metric, images()[:, :1], images())["beam_reflectance"])
    assert any("has no reflectance" in said for said in metric.remarks())


def test_drop_rate_is_off_by_the_share_that_is_missing():
    generated = images()
    generated[:, :, :, :8] = 0  # a quarter of every beam
    assert figures(DropRate(), images(), generated) == {"drop_rate": 0.25, "drop_rate_beams": 0.25}


def test_beams_that_drop_too_much_do_not_make_up_for_others():
    real, generated = images(), images()
    real[:, :, :4, :8] = 0
    generated[:, :, 4:, :8] = 0
    assert figures(DropRate(), real, generated) == {"drop_rate": 0, "drop_rate_beams": 0.25}


def test_an_empty_scan_has_dropped_all_of_its_rays():
    generated = images(4)
    generated[0] = 0
    metric = DropRate()
    assert figures(metric, images(), generated) == {"drop_rate": 0.25, "drop_rate_beams": 0.25}
    assert metric.remarks() == []  # it counts like any other


def test_a_value_on_an_edge_is_in_the_bin_above_and_beyond_the_ends_in_the_last():
    scans = images(1)
    scans[0, 0, 2] = torch.linspace(0.6, 62, 32)
    scans[0, 1, 2] = torch.from_numpy(np.linspace(0, 1, 26)[:25]).float().repeat(2)[:32]
    scans[0, 1, 3] = 1.0005  # rounding, not another scale
    rows = BeamHistograms().rows(Scans(scans, SENSOR)).view(8, 57)
    r = scans[0, 0, 2].double().numpy()
    assert rows[2, :32].tolist() == np.histogram(r, np.geomspace(0.5, 63, 33))[0].tolist()
    assert rows[2, 32:].tolist() == [2] * 7 + [1] * 18
    assert rows[3, 32:].tolist() == [0] * 24 + [32]


def test_scans_of_two_sensors_are_not_compared():
    other = SENSORS["hdl64e"].resized(4, 32)
    metric = DropRate()
    metric.update(Scans(images(), SENSOR), real=True)
    metric.update(Scans(images(sensor=other), other), real=False)
    with pytest.raises(InputError, match="two sensors"):
        metric.compute()
    with pytest.raises(InputError, match="two sensors"):
        metric.update(Scans(images(), SENSOR), real=False)
