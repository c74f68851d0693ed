"""Hand-made features against their values on images that can be worked out by hand."""

import math

import numpy as np
import pytest
import torch

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors.handcrafted import (
    BANDS,
    EDGE,
    FAR_OUT,
    FEW,
    FINE,
    SCALES,
    SECTORED,
    SECTORS,
    Handcrafted,
    HandcraftedRange,
)
from r2flow.metrics.scans import Scans
from r2flow.simulator import simulate
from tests.conftest import SENSOR
from tests.metrics.conftest import scans_of

BOTH, RANGE = Handcrafted(), HandcraftedRange()


def scans(r, q=0.3, sensor=SENSOR):
    r = torch.as_tensor(r, dtype=torch.float32).expand(1, 1, *sensor.shape)
    return Scans(torch.cat([r, torch.as_tensor(q, dtype=torch.float32) * (r > 0)], 1), sensor)


def by_name(rows, extractor=BOTH):
    cells = [SECTORS if name.endswith(SECTORED) else BANDS for name in extractor.scales]
    return dict(zip(extractor.scales, rows.split(cells, dim=1), strict=True))


def statistics(some):
    """Of a scan whose rays all returned: the features taken back to the statistics' own units."""
    whole = FAR_OUT * (BOTH.features(some) / FAR_OUT).sinh() * (1 + FEW)
    return {
        name: SCALES[name][0] + SCALES[name][1] * x[0].numpy() for name, x in by_name(whole).items()
    }


def test_a_constant_image():
    found = statistics(scans(7.0, 0.3))
    expected = {
        "returns": 1, "row changes": 0, "single losses": 0, "log-range": 3, "beyond 5 m": 1, "beyond 10 m": 0,
        "row "
        "edges": 0, "row equal": 1, "row step": math.log2(FINE), "row step of 64": math.log2(FINE),
        "row "
        "bend": math.log2(FINE), "row smooth": 0, "rows agree": 0, "row step, spread": 0, "log-range, spread": 0,
        "log-range, "
        "beams": 0, "reflectance": 0.3, "reflectance, spread": 0, "reflectance from 0.25": 1,
        "reflectance row "
        "step": math.log2(FINE), "log-range, sectors": 3, "reflectance, sectors": 0.3,
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(
            found[name], value, atol=2e-3 * max(1, 30 * SCALES[name][1]), err_msg=name
        )


def test_one_wall_before_another_has_two_edges_in_every_row():
    w = SENSOR.columns
    found = statistics(scans(torch.where(torch.arange(w) < w // 2, 7.0, 15.0)))
    expected = {
        "row edges": 2 / w,
        "row step": ((w - 2) * math.log2(FINE) + 2 * math.log2(8 + FINE)) / w,
        "row slant": 0,  # one step of either sign
        "log-range": (3 + 4) / 2,
        "log-range, spread": 0.5,
        "row equal": (w - 2) / w,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=2e-3, atol=1e-3, err_msg=name)
    np.testing.assert_allclose(found["log-range, sectors"], [3] * 4 + [4] * 4, atol=5e-3)
    saw = statistics(scans(7 + 8.0 * (torch.arange(w) / w)))  # rises slowly, falls at once
    steps = (w - 1) * math.tanh(8 / w / EDGE) - math.tanh(8 * (w - 1) / w / EDGE)
    np.testing.assert_allclose(saw["row slant"], steps / w, rtol=5e-3)


def test_a_turn_changes_the_sectors_alone_and_a_mirror_image_sides_and_signs():
    some = scans_of(3, sensor=SENSOR).images
    images = some, some.roll(SENSOR.columns // SECTORS, -1), some.roll(5, -1), some.flip(-1)
    own, turned, any_turn, mirrored = (by_name(BOTH.features(Scans(x, SENSOR))) for x in images)
    for name, x in own.items():
        if name.endswith(SECTORED):
            torch.testing.assert_close(turned[name], x.roll(1, -1), atol=1e-4, rtol=0)
            assert (any_turn[name] - x).abs().max() > 0.01
        else:
            torch.testing.assert_close([turned[name], any_turn[name]], [x, x], atol=1e-4, rtol=0)
        alike = name not in ("row slant", "diagonals") and not name.endswith(SECTORED)
        assert torch.allclose(mirrored[name], x, atol=1e-4) == alike, name
    slant = [FAR_OUT * (s["row slant"] / FAR_OUT).sinh() + SCALES["row slant"][0] / SCALES["row slant"][1]
             / (1 + FEW) for s in (own, mirrored)]  # fmt: skip
    torch.testing.assert_close(slant[0], -slant[1], atol=0.01, rtol=0)


def test_features_of_simulated_scans_have_the_centre_and_the_spread_of_the_table():
    images = torch.stack([torch.from_numpy(simulate("hdl64e", 4, i).image) for i in range(16)])
    for name, x in by_name(BOTH.features(Scans(images, SENSORS["hdl64e"]))).items():
        assert x.mean().abs() < 0.9, name
        assert 0.2 < x.std(0).mean() < 1.4, name


# three of the last are computed in parts
@pytest.mark.parametrize("shape", [(16, 100), (3, 5), (40, 800)])
@pytest.mark.parametrize("sensor", ["vlp16", "os1_64"])
def test_any_sensor_and_size_with_and_without_reflectance(sensor, shape):
    resized = SENSORS[sensor].resized(*shape)
    some = scans_of(3, sensor=resized)
    assert BOTH.features(some).isfinite().all()
    alone = [BOTH.features(Scans(image[None], resized)) for image in some.images]
    torch.testing.assert_close(BOTH.features(some), torch.cat(alone).view(3, BOTH.dim))
    of_range = RANGE.features(Scans(some.images[:, :1], resized))
    assert of_range.shape == (3, RANGE.dim)
    same = {
        name: x for name, x in by_name(BOTH.features(some)).items() if "reflectance" not in name
    }
    torch.testing.assert_close(of_range, torch.cat(list(same.values()), 1))
