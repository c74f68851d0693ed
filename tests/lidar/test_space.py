"""Model space: what it says of its images."""

import numpy as np
import pytest
import torch

from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.lidar.space import ModelSpace

SENSOR = Sensor("two beams", (30.0, -30.0), columns=4)  # columns look to 135, 45, -45 and -135 degrees


@pytest.mark.parametrize("rays", ["centre", "reference"])
def test_points_lie_along_the_middles_of_the_pixels(rays):
    space = ModelSpace(SENSOR, Encoding(SENSOR), SENSOR.rays(rays))
    images = torch.zeros(2, 2, 2, 4)
    images[0, :, 0, 1] = torch.tensor([10.0, 0.25])
    empty, (point,) = space.points(images)[1], space.points(images)[0]
    flat = 10 * np.cos(np.pi / 6) * np.sqrt(0.5)  # x = y at 45 degrees; z = 10 sin 30
    np.testing.assert_allclose(point, [flat, flat, 5.0, 0.25], rtol=1e-6)
    assert empty.shape == (0, 4)
    assert empty.dtype == point.dtype == np.float32


def test_points_of_range_alone_have_no_reflectance():
    space = ModelSpace(SENSOR, Encoding(SENSOR, reflectance=False), SENSOR.rays())
    (points,) = space.points(torch.full((1, 1, 2, 4), 7.0))
    np.testing.assert_allclose(np.linalg.norm(points[:, :3], axis=1), 7.0, rtol=1e-6)
    assert points.shape == (8, 4)
    assert (points[:, 3] == 0).all()


@pytest.mark.parametrize("shape", [(2, 2, 4), (1, 3, 2, 4), (1, 2, 4, 2)])
def test_images_of_another_shape_are_refused(shape):
    space = ModelSpace(SENSOR, Encoding(SENSOR), SENSOR.rays())
    with pytest.raises(InputError, match=r"range images have the shape \(B, 2 or 1, 2, 4\), found.*image_to_points"):
        space.points(torch.zeros(shape))
