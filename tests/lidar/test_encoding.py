import math

import numpy as np
import pytest
import torch

from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.range_formats import FORMATS
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor

HDL64E = SENSORS["hdl64e"]


@pytest.mark.parametrize("format", list(FORMATS))
@pytest.mark.parametrize("reflectance", [True, False])
def test_encode_then_decode_is_exact_to_a_millimetre_or_to_float32(sensor, format, reflectance):
    near, far = sensor.min_range, sensor.max_range
    r = (
        torch.linspace(0.9 * near, 1.1 * far, math.prod(sensor.shape))
        .view(1, *sensor.shape)
        .clamp(near, far)
    )
    r[:, ::5, ::7] = 0
    image = torch.cat([r, torch.rand(r.shape) * (r > 0)]) if reflectance else r
    if (
        format == "inverse_depth"
    ):  # which has no tolerance at the limits, where float32 may lose a range
        image[0] = image[0].clamp(near * (1 + 2e-5), far * (1 - 2e-5)) * (image[0] > 0)
    encoding = Encoding(sensor, format, reflectance)
    x = encoding.encode(image[None])
    assert x.shape == (1, encoding.channels, *sensor.shape)
    assert x.abs().max() <= 1
    decoded = encoding.decode(x)[0]
    # x in float32 tells y = r_min / r apart to 2^-26, hence r to r^2 / r_min of that: 2 mm at the
    # pandar64's 200 m.
    held = (
        image[0] ** 2 / sensor.min_range * 2**-26 + 1e-4
        if format.startswith("inverse")
        else torch.zeros(())
    )
    assert ((decoded[0] - image[0]).abs() < held.clamp(min=1e-3)).all()
    assert torch.equal(decoded[0] == 0, image[0] == 0)
    np.testing.assert_array_equal(
        project(*image_to_points(decoded.numpy(), sensor), sensor)[0] == 0, image[0] == 0
    )
    if reflectance:
        assert (decoded[1] - image[1]).abs().max() < 1e-6


@pytest.mark.parametrize("format", list(FORMATS))
@pytest.mark.parametrize("limits", ["closed", "open"])
def test_ranges_beyond_the_sensor_are_no_returns(format, limits):
    encoding = Encoding(HDL64E, format, limits=limits)
    beyond = torch.tensor([1e-38, 0.3, 1.4, 81, 160, 1e30, 20])
    image = torch.stack([beyond, torch.full_like(beyond, 0.5)])[:, None]
    x = encoding.encode(image)
    no_return = encoding.encode(torch.zeros(2, 1, 1))
    torch.testing.assert_close(x[..., :6], no_return.expand(2, 1, 6), rtol=0, atol=0)
    expected = torch.tensor([[0, 0, 0, 0, 0, 0, 20], [0, 0, 0, 0, 0, 0, 0.5]])[:, None]
    torch.testing.assert_close(encoding.decode(x), expected, rtol=1e-4, atol=0)


def test_logscale_is_the_paper_s():
    encoding = Encoding(HDL64E)
    image = torch.zeros(2, *HDL64E.shape)
    image[:, 0, :2] = torch.tensor([[1.45, 80.0], [0.25, 1.0]])
    x = encoding.encode(image)
    assert x[:, 5, 5].tolist() == [-1, -1]  # a dropped ray is exactly -1
    assert x[:, 0, 0].tolist() == pytest.approx(
        [2 * math.log2(2.45) / math.log2(81) - 1, -0.5], abs=1e-6
    )
    assert x[:, 0, 1].tolist() == pytest.approx([1, 1])


def test_returns_outside_the_range_limits_are_dropped_and_reflectance_is_clamped():
    x = torch.full((2, *HDL64E.shape), 0.3)
    x[0, 0, :5] = torch.tensor([-1.0, -0.6, 1.01, 7.0, math.nan])  # none, 1.41 m, 82 m, absurd
    x[1, 0, 5:7] = torch.tensor([-3.0, 3.0])
    decoded = Encoding(HDL64E).decode(x)
    assert decoded[:, 0, :5].abs().max() == 0
    assert decoded[1, 0, 5:7].tolist() == [0, 1]
    assert (decoded[0, 0, 5:] > 0).all()
    assert (decoded[:, 0, 7:] > 0).all()
    assert (
        Encoding(build_sensor("hdl64e", max_range=63), "shifted_log").decode(x)[0, 0, 2:4] - 63
    ).abs().max() < 1e-3


def test_decoded_reflectance_has_the_sensors_levels():
    encoding = Encoding(HDL64E.resized(8, 64), levels=100)
    image = torch.rand(2, 8, 64, generator=torch.Generator().manual_seed(0))
    image[0] = 10 * image[0] + 2
    decoded = encoding.decode(encoding.encode(image))[1]
    torch.testing.assert_close(decoded, (100 * image[1]).round() / 100, rtol=0, atol=1e-6)
    assert [encoding.through(other).levels for other in (HDL64E, SENSORS["vlp16"])] == [100, None]


SENSOR = Sensor(
    "two beams", (30.0, -30.0), columns=4
)  # columns look to 135, 45, -45 and -135 degrees


@pytest.mark.parametrize("rays", ["centre", "reference"])
def test_points_lie_along_the_middles_of_the_pixels(rays):
    space = ModelSpace(SENSOR, Encoding(SENSOR), SENSOR.rays(rays))
    images = torch.zeros(2, 2, 2, 4)
    images[0, :, 0, 1] = torch.tensor([10.0, 0.25])
    empty, (point,) = space.points(images.requires_grad_())[1], space.points(images)[0]
    flat = 10 * np.cos(np.pi / 6) * np.sqrt(0.5)  # x = y at 45 degrees; z = 10 sin 30
    np.testing.assert_allclose(point, [flat, flat, 5.0, 0.25], rtol=1e-6)
    np.testing.assert_allclose(
        space.points(images[:1, :1])[0], [[flat, flat, 5.0, 0]], rtol=1e-6
    )  # of range alone
    assert empty.shape == (0, 4)
    assert empty.dtype == point.dtype == np.float32
