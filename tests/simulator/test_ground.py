"""The ground: slopes, waves, kerbs and streets against geometry."""

import numpy as np
import pytest

from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator.ground import Ground
from r2flow.simulator.lasers import Rays, _along_rows
from r2flow.simulator.streets import Street

HDL64E = SENSORS["hdl64e"]
HEIGHT = HDL64E.height
RAYS = Rays(_along_rows(HDL64E), HDL64E.columns, HEIGHT)
STRAIGHT = Street(heading=0.0, offset=0.0, curvature=0.0, half_width=4.0, pavement=2.0)
OPEN = (STRAIGHT._replace(offset=1e6),)  # no street in sight


@pytest.mark.parametrize("lean", [(0.05, 0.0), (-0.03, 0.02), (0.0, -0.04)])
def test_a_slope_is_met_where_ray_and_plane_cross(lean):
    distance, _ = Ground(OPEN, lean=lean).meet(RAYS)
    closing = (lean[0] * RAYS.cos + lean[1] * RAYS.sin) - RAYS.slope[:, None]
    exact = HEIGHT / np.where(closing > 0.03, closing, np.nan)
    clear = exact < 85
    assert clear.mean() > 0.5
    np.testing.assert_allclose(distance[clear], exact[clear], rtol=1e-4)


def test_the_normal_of_a_slope_sets_the_angle_of_incidence():
    distance, cosine = Ground(OPEN, lean=(0.1, 0.0)).meet(RAYS)
    column = HDL64E.columns // 2  # ahead, to within a fifth of a degree
    e = RAYS.lasers.elevation
    met = np.isfinite(distance[:, column])
    np.testing.assert_allclose(cosine[met, column], np.sin(np.arctan(0.1) - e[met]), atol=1e-4)


@pytest.mark.parametrize("kerb", [0.0, 0.12])  # all is off the street, and higher by the kerb
def test_on_waves_a_ray_ends_where_it_first_meets_the_surface(kerb):
    ground = Ground(
        OPEN, waves=((0.4, 2 * np.pi / 60, 0.02, 1.0), (0.2, 0.0, 2 * np.pi / 45, 2.0)), kerb=kerb
    )
    distance, cosine = ground.meet(RAYS)
    np.testing.assert_allclose(
        cosine, Ground(OPEN, ground.waves, drop=-kerb).meet(RAYS)[1], atol=1e-3
    )
    met = np.isfinite(distance)
    s, a = np.where(met, distance, 1.0), np.broadcast_to(RAYS.azimuth, RAYS.shape)
    slope = np.broadcast_to(np.tan(RAYS.lasers.elevation)[:, None], RAYS.shape)
    for share, least, most in (
        (1.0, -0.03, 0.03),
        *((share, -0.02, np.inf) for share in (0.9, 0.6, 0.3)),
    ):
        above = (
            HEIGHT
            - kerb
            + share * s * slope
            - ground.height(share * s * np.cos(a), share * s * np.sin(a))
        )
        assert (
            (above[met] > least) & (above[met] < most)
        ).all()  # the profile's chords against the waves


def test_beside_the_street_the_ground_is_higher_by_the_kerb():
    kerb = 0.12
    distance, _ = Ground(streets=(STRAIGHT,), kerb=kerb).meet(RAYS)
    y = distance * RAYS.sin
    z = HEIGHT + distance * RAYS.slope[:, None]
    met = np.isfinite(distance)
    np.testing.assert_allclose(z[met & (np.abs(y) < 3.99)], 0, atol=1e-3)
    np.testing.assert_allclose(z[met & (np.abs(y) > 4.01) & (distance < 40)], kerb, atol=2e-3)
    assert z[met].min() > -1e-3
    on_face = met & (z > 0.01) & (z < kerb - 0.01)
    assert on_face.any()
    np.testing.assert_allclose(np.abs(y[on_face]), 4.0, atol=0.02)


def test_surfaces_are_strips_beside_a_street():
    ground = Ground(streets=(STRAIGHT._replace(lines=(0.0, 3.5)),))
    label, _, _ = ground.surface(np.full(6, 10.0), np.array([3.0, 3.5, 3.9, 4.5, 5.9, 6.5]))
    names = ["road", "lane-marking", "road", "sidewalk", "sidewalk", "terrain"]
    assert label.tolist() == [LABELS[name] for name in names]


def test_a_curved_street_keeps_its_radius():
    radius = 200.0
    street = Street(heading=0.3, offset=2.0, curvature=1 / radius, half_width=3.0, pavement=0.0)
    for u in (-30.0, 0.0, 25.0):
        x, y, _ = street.place(u, 1.5)
        np.testing.assert_allclose(street.locate(x, y), (u, 1.5), atol=1e-9)
    # the parabola departs from the circle by u^4 / (8 R^3): 5 mm at 25 m
    x, y, heading = street.place(25.0, 0.0)
    c, s = np.cos(0.3), np.sin(0.3)
    centre = -(2.0 + radius) * s, (2.0 + radius) * c
    assert np.hypot(x - centre[0], y - centre[1]) == pytest.approx(radius, abs=0.01)
    assert heading == pytest.approx(0.3 + 25 / radius, abs=1e-3)


def test_a_side_street_ends_where_it_joins():
    side = Street(
        heading=np.pi / 2, offset=-20.0, curvature=0.0, half_width=3.0, pavement=0.0, start=0.0
    )
    ground = Ground(streets=(STRAIGHT, side), corner=1e-3)
    assert ground.off_street(20.0, 15.0) == pytest.approx(-3.0)
    assert ground.off_street(20.0, -15.0) == pytest.approx(11.0, abs=1e-3)
    assert ground.off_street(20.0 + 5.0, 15.0) == pytest.approx(2.0, abs=1e-3)


def test_numbers_and_arrays_of_places_have_the_same_height():
    ground = Ground(
        waves=((0.3, 0.1, 0.05, 1.0),),
        lean=(0.01, 0.02),
        streets=(STRAIGHT,),
        banks=(1.5, -0.5),
        drop=0.03,
    )
    x, y = np.linspace(-50, 50, 21), np.linspace(-60, 40, 21)
    one_by_one = [ground.height(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(ground.height(x, y), one_by_one, atol=1e-9)
    away = [ground.off_street(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(ground.off_street(x, y), away, atol=1e-9)
