"""Things in known scenes: rays cast against rooms, poles and parked boxes, at both sizes, exact and
with 2 cm noise.
"""

import math

import numpy as np
import pytest
import torch

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics import METRICS
from r2flow.metrics.scans import Scans
from r2flow.metrics.things import LINES, Returns, cars, poles
from tests.metrics.conftest import measured

CAR = (4.2, 1.8, 1.5)  # length, width, height


@pytest.fixture(params=[(64, 1024), (32, 256)], ids=["64x1024", "32x256"])
def sensor(request):
    return SENSORS["hdl64e"].resized(*request.param)


@pytest.fixture(params=[0, 0.02], ids=["exact", "2cm"])
def noise(request):
    return request.param


def rays(sensor):
    e, a = sensor.rays().double().numpy()
    return np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)


def plane(sensor, slope=0.0):
    """z = -1.73 + slope x."""
    x, _, z = rays(sensor)
    down = slope * x - z
    return np.where(down > 1e-3, 1.73 / np.maximum(down, 1e-3), np.inf)


def box(sensor, x, y, yaw, length, width, height):
    """Ranges of a box that stands on the ground, by slabs; from inside, of its far walls."""
    dx, dy, dz = rays(sensor)
    c, s = math.cos(yaw), math.sin(yaw)
    middle = (c * x + s * y, c * y - s * x, -1.73 + height / 2)
    near, far = np.full(sensor.shape, -np.inf), np.full(sensor.shape, np.inf)
    for d, at, side in zip(
        (c * dx + s * dy, c * dy - s * dx, dz), middle, (length, width, height), strict=True
    ):
        with np.errstate(divide="ignore"):
            ends = np.stack([(at - side / 2) / d, (at + side / 2) / d])
        near, far = np.maximum(near, ends.min(0)), np.minimum(far, ends.max(0))
    return np.where(far < np.maximum(near, 0), np.inf, np.where(near > 0, near, far))


def cylinder(sensor, x, y, radius, height=30.0):
    """Ranges of an upright cylinder on the ground; from inside, of its wall."""
    dx, dy, dz = rays(sensor)
    flat = np.hypot(dx, dy)
    along, across = (x * dx + y * dy) / flat, (x * dy - y * dx) / flat
    half = np.sqrt(np.maximum(radius**2 - across**2, 0))
    r = np.where(along - half > 0, along - half, along + half) / flat
    return np.where((np.abs(across) < radius) & (r > 0) & (r * dz < height - 1.73), r, np.inf)


def scan(sensor, noise, *things, ground=None):
    r = np.minimum.reduce([plane(sensor) if ground is None else ground, *things])
    r = np.where(r < 62, r + noise * np.random.default_rng(0).standard_normal(r.shape), 0)
    return Scans(torch.from_numpy(r[None, None]), sensor)


def figures(*scans):
    return measured(METRICS["things"](), scans[-1], scans[0]).compute()


def found(finder, scans):
    return finder(Returns(scans.xyz[0].numpy(), scans.returned[0, 0].numpy(), scans.sensor))


@pytest.mark.parametrize("yaw", [0, 0.3, 0.7])
def test_a_box_room_is_straight_and_square_however_it_is_turned(sensor, noise, yaw):
    values = figures(scan(sensor, noise, box(sensor, 2, -1, yaw, 24, 16, 30)))
    # 2 cm over a piece of 4 m and 10 returns: a direction is known to 0.02 x sqrt(12 / 10) / 4 =
    # 0.006 rad
    assert [values[line] for line in LINES] == pytest.approx([1, 1, 0, 0], abs=0.01)


def test_the_directions_of_a_hexagon_add_up_to_nothing(sensor, noise):
    walls = [box(sensor, 0, 0, math.radians(turn), 20, 300, 60) for turn in (0, 60, 120)]
    values = figures(scan(sensor, noise, *walls))
    assert [values["straight walls"], values["right angles"]] == pytest.approx([1, 0], abs=0.02)


def test_a_round_room_is_nowhere_straight(sensor, noise):
    """An arc of 4 m, radius 10 m, is 0.2 m deep and so 0.2 x sqrt(4 / 45) = 0.06 m rms off its
    line.
    """
    values = figures(scan(sensor, noise, cylinder(sensor, 0, 0, 10)))
    assert [values["straight walls"], values["right angles"]] == pytest.approx([0, 0], abs=0.05)


@pytest.mark.parametrize("slope", [0, 0.05, -0.05])
def test_an_empty_plane_holds_nothing_level_or_not(sensor, noise, slope):
    assert set(figures(scan(sensor, noise, ground=plane(sensor, slope))).values()) == {0}


def test_poles_are_counted_and_what_is_wide_low_far_or_at_a_wall_is_not(sensor, noise):
    # one in the first and the last column
    row = [(-10, 5), (-8, 0), (-6, 5), (-2, 5), (2, 5), (6, 5), (10, 5)]
    others = [
        box(sensor, 0, -7, 0.2, 1.2, 1.2, 3), cylinder(sensor, 6, -6, 0.15, 0.6), cylinder(sensor, -25, 3, 0.6, 3),
        box(sensor, 0, 11, 0, 60, 1, 6), cylinder(sensor, 3, 10.3, 0.15, 6), box(sensor, -8, -6, 0.4, *CAR),
    ]  # fmt: skip
    scans = scan(sensor, noise, *(cylinder(sensor, x, y, 0.15, 3) for x, y in row), *others)
    at = found(poles, scans)
    np.testing.assert_allclose(at[np.argsort(at[:, 0])], row, atol=0.3)
    assert figures(scans)["poles"] == len(row)


def test_parked_cars_are_counted_from_every_side_and_other_boxes_are_not(sensor, noise):
    parked = [
        (-9, 4, 0),
        (-1, 5, 0.05),
        (7, 4, 0),
        (13, -2, 0),
        (3, -8, math.pi / 2),
        (-6, -7, 0.8),
        (-13, 0, 1.5),
    ]
    others = [
        box(sensor, 6, -13, 0, 12, 2.5, 3.5), box(sensor, -2, -6, 0, 0.5, 0.5, 1.7), box(sensor, 2, 11, 0, 14, 1, 1.5),
        cylinder(sensor, 8, -6, 0.15, 4), box(sensor, 32, 8, 0, *CAR), box(sensor, 9, 9, 0, 4, 1.8, 0.4),
    ]  # fmt: skip
    scans = scan(sensor, noise, *(box(sensor, x, y, yaw, *CAR) for x, y, yaw in parked), *others)
    at = found(cars, scans)
    distance = np.linalg.norm(at[:, None, :2] - np.array(parked)[:, :2], axis=2)
    assert sorted(distance.argmin(1)) == [*range(len(parked))]
    # half a diagonal: the middle of what is seen lies in the car
    assert distance.min(1).max() < 2.3
    assert (np.abs(at[:, 4] - 1.4) < 0.2).all()
    assert figures(scans)["cars"] == len(parked)


def test_a_car_that_is_half_hidden_still_counts(sensor, noise):
    hidden = scan(sensor, noise, box(sensor, 0, 9, 0, *CAR), box(sensor, -1.2, 5, 0, 1.2, 0.3, 4))
    assert len(found(cars, hidden)) == 1


def test_figures_of_both_sets_stand_side_by_side(sensor, noise):
    values = figures(
        scan(sensor, noise, cylinder(sensor, 6, 2, 0.15, 3)),
        scan(sensor, noise, box(sensor, 2, -1, 0.3, 24, 16, 30), box(sensor, 0, 5, 0, *CAR)),
    )
    assert [values["poles"], values["poles, real"], values["cars"], values["cars, real"]] == [
        1,
        0,
        0,
        1,
    ]
    assert values["straight walls"] < 0.1 < 0.9 < values["straight walls, real"]
