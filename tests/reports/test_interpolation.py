import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.data.reading import Reading
from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.model.inversion import interpolate_scans, real_scans
from r2flow.reports.interpolation import interpolation
from r2flow.reports.tables import markdown
from r2flow.samplers import build_sampler
from r2flow.store import Store
from tests.conftest import SENSOR
from tests.test_sampling import GaussianFlow, flow, scans


class LostBetween(GaussianFlow):
    """NaN after the evaluations of both round trips, in four steps of rk4."""

    evaluations = 0

    def forward(self, t, x):
        self.evaluations += 1
        v = super().forward(t, x)
        return v if self.evaluations <= 2 * 16 else torch.full_like(v, math.nan)


def test_a_frame_that_is_not_solved_is_reported(tmp_path, caplog):
    page = interpolation(
        flow(LostBetween()), "ab", scans(2), 4, tmp_path / "o", build_sampler("rk4", steps=4)
    )
    assert [row["converged"] for row in page.rows] == [True, False, False, True]
    assert "not solved, so no scans of this flow: 1, 2;" in caplog.text
    assert "| no |" in markdown(*page.text[1])


def test_an_end_without_its_noise_is_refused():
    bad = scans(2)
    bad[1, 0, 0, 0] = math.nan
    with pytest.raises(InputError, match="the last scan cannot be carried to its noise"):
        interpolate_scans(flow(), bad, 3, build_sampler("rk4", steps=4))
    with pytest.raises(InputError, match="the first scan cannot be carried to its noise"):
        interpolate_scans(flow(), bad.flip(0), 3)


def test_a_range_image_is_limited_to_the_range_of_the_sensor(tmp_path):
    image = np.array(
        [[1.0, 1.45, 40, 80, 81, np.inf, np.nan, -3], [2, 0.5, -1, 1, 1, 1, 1, 1]], np.float32
    )
    sensor = SENSORS["hdl64e"].resized(2, 4)
    np.save(tmp_path / "image.npy", image.reshape(2, 2, 4))
    checkpoint = flow()
    checkpoint.generator.space = ModelSpace(sensor, Encoding(sensor), sensor.rays())
    (name,), (seen,) = real_scans(checkpoint, [tmp_path / "image.npy"])
    assert name == "image"
    np.testing.assert_allclose(seen[0].flatten(), [0, 1.45, 40, 80, 0, 0, 0, 0])
    np.testing.assert_allclose(seen[1].flatten(), [0, 0.5, 0, 1, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("of_sensor", "trained"), [(255.0, 1.0), (255.0, 255.0), (None, 255.0), (100.0, 255.0)]
)
def test_reflectance_is_scaled_by_who_wrote_the_file(tmp_path, of_sensor, trained):
    image, checkpoint = scans(1)[0], flow()
    own, raw = tmp_path / "own" / "a.ply", tmp_path / "raw" / "a.ply"
    Store(own.parent, "samples", {"reading": Reading(SENSOR).described()}).begin()
    xyz, reflectance = image_to_points(image.numpy(), SENSOR.rays())
    write_points(own, xyz, reflectance)
    write_points(raw, xyz, 255 * reflectance)
    sensor = replace(SENSOR, reflectance_scale=of_sensor)
    checkpoint.generator.space = ModelSpace(sensor, Encoding(sensor), sensor.rays())
    checkpoint.config.stored["data"] = {"name": "folder", "reading": {"reflectance_scale": trained}}
    found = real_scans(checkpoint, [raw, own])[1]
    torch.testing.assert_close(found, image.expand_as(found), atol=1e-3, rtol=1e-4)
