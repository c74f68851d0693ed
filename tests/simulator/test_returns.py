"""From hits to an image: rows, noise, lost pulses, reflectance, the own car."""

import numpy as np
import pytest

from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import _observe
from r2flow.simulator.ground import Ground
from r2flow.simulator.lasers import HDL64E, RIGS, _along_rows, hidden, lasers_of, rows_of
from r2flow.simulator.materials import ALBEDO, INDEX, SWALLOW
from r2flow.simulator.scene import SceneBuilder
from r2flow.simulator.shapes import Boxes, Cylinders
from r2flow.simulator.streets import Street

SENSOR = SENSORS["hdl64e"]
VLP16 = SENSORS["vlp16"]
OPEN = Ground((Street(0.0, 1e6, 0.0, 4.0, 2.0),))  # flat, without a street in sight


def builder() -> SceneBuilder:
    b = SceneBuilder(np.random.default_rng(0))
    b.ground = OPEN
    return b


def wall(material: str, distance: float = 10.0, sensor=VLP16, albedo: float | None = None):
    """The scan of a wall ahead of the sensor, and the pixels that look at it within 30 degrees."""
    b = builder()
    usual = float(ALBEDO[INDEX[material]]) if albedo is None else albedo
    b.add(Boxes(distance + 5, 0, 0, 10, 200, -1, 100), 0.0, "building", material, usual)
    return _observe(b.build(), sensor, np.random.default_rng(1)), np.abs(
        sensor.rays().numpy()[1]
    ) < np.pi / 6


def test_rows_and_edges_of_the_image_agree():
    middle, edges = np.deg2rad(SENSOR.elevations), np.deg2rad(SENSOR.row_edges)
    np.testing.assert_array_equal(rows_of(SENSOR, np.tan(middle).astype(np.float32)), np.arange(64))
    just_below = np.tan(edges[:-1] - 1e-5).astype(np.float32)
    np.testing.assert_array_equal(rows_of(SENSOR, just_below), np.arange(64))
    outside = np.tan(np.deg2rad([3.01, -25.01])).astype(np.float32)
    np.testing.assert_array_equal(rows_of(SENSOR, outside), [-1, -1])


def test_lasers_of_an_hdl64e_fall_by_a_third_of_a_degree_above_and_half_below():
    steps = -np.diff(np.rad2deg(HDL64E.elevation))
    assert (steps > 0).all()
    assert steps[:31].mean() == pytest.approx(1 / 3, abs=0.03)
    assert steps[32:].mean() == pytest.approx(1 / 2, abs=0.03)
    assert lasers_of(SENSOR.resized(32, 256)) is HDL64E


def test_a_wall_is_measured_to_within_the_noise_in_steps():
    scan, ahead = wall("plaster")
    e, a = VLP16.rays().numpy().astype(float)
    exact = 10.0 / np.cos(a) / np.cos(e)
    seen = ahead & (scan.labels == LABELS["building"])
    error = (scan.image[0] - exact)[seen]
    assert seen.sum() > 1000
    assert abs(error.mean()) < 0.002
    assert 0.003 < error.std() < 0.025
    r, reflectance = scan.image.astype(float)
    np.testing.assert_allclose(r / 0.002, np.round(r / 0.002), atol=0.05)
    np.testing.assert_allclose(reflectance * 100, np.round(reflectance * 100), atol=1e-3)


@pytest.mark.parametrize(
    ("material", "low", "high"),
    [("retro", 0.85, 1.0), ("plaster", 0.35, 0.5), ("rubber", 0.0, 0.1)],
)
def test_materials_have_their_albedo(material, low, high):
    scan, ahead = wall(material)
    seen = ahead & (scan.image[0] > 0) & (scan.labels == LABELS["building"])
    assert low <= scan.image[1][seen].mean() <= high


def test_glass_swallows_its_share_of_pulses():
    scan, ahead = wall("pane", albedo=0.5)
    share = SWALLOW[INDEX["pane"]]
    looked = ahead & (VLP16.rays().numpy()[0] > 0.01)
    lost = (scan.image[0][looked] == 0).mean()
    assert lost == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / looked.sum()))


def test_dark_walls_lose_more_returns_the_farther_they_are():
    lost = []
    for distance in (6.0, 25.0, 60.0):
        scan, ahead = wall("rubber", distance, albedo=0.0)
        upwards = ahead & (VLP16.rays().numpy()[0] > 0.01)
        lost.append((scan.image[0][upwards] == 0).mean())
    assert lost[0] < lost[1] < lost[2]


def test_grazing_incidence_darkens_a_glossy_wall():
    scan, _ = wall("metal", albedo=0.6)
    a = np.abs(VLP16.rays().numpy()[1])
    wall_seen = scan.labels == LABELS["building"]
    facing = scan.image[1][wall_seen & (a < 0.2)].mean()
    assert scan.image[1][wall_seen & (a > 1.2) & (a < 1.4)].mean() < 0.7 * facing


@pytest.mark.parametrize("rig", range(len(RIGS)))
def test_the_own_car_hides_only_what_is_below(rig):
    lasers = _along_rows(SENSOR)
    mask = hidden(lasers, 1024, rig)
    assert not mask[lasers.elevation > np.deg2rad(-10)].any()
    assert mask[-1].mean() > 0.3
    assert mask[:, 512][-4:].all()  # the roof ahead


def test_neighbouring_lasers_see_the_own_car_from_either_side():
    instrument = hidden(HDL64E, 1024, 0)[:, 640:780]
    rows = np.flatnonzero(instrument.sum(1) > 30)
    middle = np.array([np.flatnonzero(instrument[row]).mean() for row in rows])
    assert (
        np.sign(np.diff(middle)) == -np.sign(np.diff(middle))[0] * (-1) ** np.arange(1, len(rows))
    ).all()


def test_a_pixel_keeps_the_nearest_of_several_lasers():
    # at 16 rows about four lasers share a row: a thin near bar must not be overwritten by what is
    # behind
    coarse = SENSOR.resized(16, 1024)
    b = builder()
    b.add(Boxes(20, 0, 0, 1, 200, -1, 50), 0.0, "building", "plaster", 0.4)
    bar = Cylinders(10, 0, 0.5, 1.6, 1.7)  # seen by two lasers at most
    b.add(bar, 0.0, "pole", "plaster", 0.4)
    assert (
        _observe(b.build(), coarse, np.random.default_rng(1)).labels[:, 512] == LABELS["pole"]
    ).any()
