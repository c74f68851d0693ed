import math

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor, evenly_spaced


def test_hdl64e_is_the_paper_s_image():
    sensor = SENSORS["hdl64e"]
    assert sensor.shape == (64, 1024)
    assert (sensor.min_range, sensor.max_range) == (1.45, 80.0)
    np.testing.assert_allclose(sensor.row_edges, 3 - 28 * np.arange(65) / 64, atol=1e-12)


def test_rays_look_through_the_middle_of_their_bins(sensor):
    e, a = sensor.rays()
    height, width = sensor.shape
    torch.testing.assert_close(torch.rad2deg(e[:, 0]), torch.tensor(sensor.elevations), rtol=0, atol=1e-5)
    # Half a bin from +180 degrees on, falling: and so symmetric about straight ahead.
    assert math.degrees(a[0, 0]) == pytest.approx(180 - 180 / width, abs=1e-4)
    torch.testing.assert_close(a, -a.flip(1), rtol=0, atol=1e-6)
    assert (a.diff(dim=1) < 0).all()


def test_the_reference_s_rays_are_bin_corners(shared):
    # el = 3 - 28 h / H, az = 180 - 360 w / W degrees (facts of the reference), and its tensor itself.
    reference = torch.load(shared / "oracle" / "units_encodings.pt", weights_only=False)["hdl_16x64"][0]
    rays = SENSORS["hdl64e"].resized(16, 64).rays("reference")
    torch.testing.assert_close(rays, reference, rtol=0, atol=1e-6)


def test_resizing_keeps_the_field_of_view(sensor):
    height = sensor.shape[0]
    for rows in (height // 2, height, height * 2, height + 3):
        smaller = sensor.resized(rows, 256)
        assert smaller.shape == (rows, 256)
        edges = smaller.row_edges
        gap = abs(np.diff(edges)).max()
        assert abs(edges[[0, -1]] - sensor.row_edges[[0, -1]]).max() < gap / 2
    # Evenly spaced beams stay so: the edges are exact.
    even = Sensor("even", evenly_spaced(10, -30, 40)).resized(10)
    np.testing.assert_allclose(even.row_edges, np.linspace(10, -30, 11), atol=1e-12)


def test_impossible_sensors_are_refused():
    with pytest.raises(InputError, match="fall from the top"):
        Sensor("s", (0.0, 1.0))
    with pytest.raises(InputError, match="min_range < max_range"):
        Sensor("s", (1.0, 0.0), min_range=5, max_range=4)
    with pytest.raises(InputError, match="columns"):
        Sensor("s", (1.0, 0.0), columns=0)
    with pytest.raises(InputError, match="Did you mean 'hdl64e'"):
        build_sensor("hdl64")
