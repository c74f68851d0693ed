"""Rays of one sensor against a wall whose range is known, as another sensor's image."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from r2flow.lidar.known import Ray
from r2flow.lidar.other_sensors import (
    image_of_same,
    image_through,
    points_of_same,
    points_through,
    rows_of,
    sensor_of,
)
from r2flow.lidar.projection import project
from r2flow.lidar.scan_files import Points
from r2flow.lidar.sensors import SENSORS, Sensor

TARGET = SENSORS["hdl64e"].resized(32, 256)
VLP16 = SENSORS["vlp16"]
BEAMS = tuple(e + 0.1 for e in VLP16.elevations)  # none of which looks along an edge of the rows
RADIUS = 10.0  # of the wall, a cylinder around the sensor


def fired(elevations=BEAMS, steps: int = 1800) -> Sensor:
    return Sensor("fired", tuple(elevations), steps)


def azimuths(
    steps: int, jitter: float
) -> np.ndarray:  # every eighth and the next one are off by shares of a step
    shift = jitter * np.resize([-0.4, 0.3, 0, 0, 0, 0, 0, 0], steps)
    return 2 * math.pi * (np.arange(steps) + 0.37 + shift) / steps - math.pi


def wall(firing: Sensor, lost=None, radius: float = RADIUS, jitter: float = 0.0) -> Points:
    """The returns of every ray, but for those that `lost`, (beams, steps) bool, holds."""
    e, a = np.broadcast_arrays(
        np.deg2rad(firing.elevations)[:, None], azimuths(firing.columns, jitter)
    )
    xyz = np.stack([radius * np.cos(a), radius * np.sin(a), radius * np.tan(e)], -1)
    return Points(xyz[np.ones(a.shape, bool) if lost is None else ~lost].astype(np.float32))


def rows_with_beams(elevations, target: Sensor) -> set[int]:
    """By the definition of a bin, one beam and one row at a time."""
    edges = target.row_edges
    return {
        h
        for h, e in itertools.product(range(target.shape[0]), elevations)
        if edges[h] >= e > edges[h + 1]
    }


@pytest.mark.parametrize(
    "target", [TARGET, SENSORS["hdl64e"], SENSORS["vlp32c"]], ids=lambda s: s.name
)
@pytest.mark.parametrize("source", list(SENSORS))
def test_the_rows_are_measured_that_a_beam_looks_into(source, target):
    beams = SENSORS[source].elevations
    firing = fired(beams, 600)
    seen = points_through(wall(firing), firing, target)
    expected = rows_with_beams(beams, target)
    measured = np.flatnonzero((seen.state != Ray.UNKNOWN).any(axis=1))
    # float32 coordinates may put a beam that looks along an edge to either side of it
    edge = {h + d for h in range(len(target.row_edges)) for d in (-1, 0)
            if np.abs(np.asarray(beams) - target.row_edges[h]).min() < 1e-4}  # fmt: skip
    assert set(measured.tolist()) ^ expected <= edge
    found = rows_of(np.asarray(beams), target)
    assert set(found[found >= 0].tolist()) == expected


def test_a_measured_row_has_the_range_of_its_beam_in_every_column():
    strength = np.repeat(np.arange(16) / 16, 1800)  # of each beam another
    seen = points_through(
        wall(fired()), fired(VLP16.elevations), TARGET, strength
    )  # its beams are 0.1 degrees off
    for beam, (e, row) in enumerate(zip(BEAMS, rows_of(np.asarray(BEAMS), TARGET), strict=True)):
        if row >= 0:
            assert (seen.image[1, row] == beam / 16).all()
            np.testing.assert_allclose(
                seen.image[0, row], RADIUS / math.cos(math.radians(e)), rtol=1e-5
            )
            np.testing.assert_allclose(
                seen.xyz[2, row], RADIUS * math.tan(math.radians(e)), rtol=1e-5
            )
            assert (seen.state[row] == Ray.RETURN).all()
    np.testing.assert_allclose(np.linalg.norm(seen.xyz, axis=0), seen.image[0], rtol=1e-6)


@pytest.mark.parametrize(("jitter", "returns"), [(0.0, 1), (1.0, 1), (0.0, 2)])
def test_a_ray_that_did_not_come_back_is_empty_and_one_that_was_not_fired_is_unknown(
    jitter, returns
):
    steps = 128  # half as many as the image has columns
    firing = fired(np.asarray(BEAMS) - 0.2, steps)  # one of them in row 0
    lost = np.zeros((16, steps), bool)
    lost[:, 40:44] = lost[:, 20] = True
    lost[6, 60] = lost[12, 83:86] = True  # of beams in the target's view, the first in row 0
    lost[8] = True  # a beam without any return
    seen = points_through(
        Points(np.repeat(wall(firing, lost, jitter=jitter).xyz, returns, 0)), firing, TARGET
    )
    column = np.floor((1 - azimuths(steps, jitter) / math.pi) / 2 * 256).astype(int) % 256
    for beam, row in enumerate(rows_of(firing.elevations, TARGET)):
        if row < 0:
            continue
        if (
            beam == 8
        ):  # where its rays went is not known exactly, but that they did not come back is
            assert (seen.state[row] != Ray.RETURN).all()
            assert (seen.state[row] == Ray.EMPTY).mean() > 0.4
            continue
        expected = np.where(np.isin(np.arange(256), column), int(Ray.RETURN), int(Ray.UNKNOWN))
        expected[column[lost[beam]]] = Ray.EMPTY
        expected[np.isin(np.arange(256), column[40:44])] = (
            Ray.UNKNOWN
        )  # 11 degrees in which no beam returned
        assert (seen.state[row] == expected).all()


def test_where_empty_rays_are_kept_a_sector_without_returns_was_measured():
    firing = fired()
    lost = np.zeros((16, 1800), bool)
    lost[:, 300:400] = True  # 20 degrees
    some = wall(firing, lost)
    cut = points_through(some, firing, TARGET).state
    kept = points_through(
        Points(np.vstack([some.xyz, np.zeros((1600, 3), np.float32)])), firing, TARGET
    ).state
    rows = (cut == Ray.RETURN).any(axis=1)
    assert 12 <= (cut[rows] == Ray.UNKNOWN).all(axis=0).sum() <= 15
    assert (kept[rows] != Ray.UNKNOWN).all()
    below = Points(
        np.vstack([some.xyz, [[0.5, 0, -2]]]).astype(np.float32), dropped=1
    )  # the vehicle, and damage
    assert (points_through(below, firing, TARGET).state == cut).all()


def test_what_is_too_near_hides_and_what_is_too_far_does_not_come_back():
    firing = fired()
    walls = [wall(firing, radius=radius).xyz for radius in (0.8, 90.0)]
    near, far, both = (
        points_through(Points(xyz), firing, TARGET) for xyz in (*walls, np.vstack(walls))
    )
    assert (np.stack([near.state, both.state]) == Ray.UNKNOWN).all()
    assert (far.state[sorted(rows_with_beams(BEAMS, TARGET))] == Ray.EMPTY).all()
    np.testing.assert_array_equal([near.image, far.image], np.zeros((2, 1, 32, 256)))


@pytest.mark.parametrize("named", [replace(VLP16, elevations=BEAMS), None])
def test_beams_and_steps_are_found(named):
    found = sensor_of([wall(fired())], named)
    np.testing.assert_allclose(found.elevations, BEAMS, atol=1e-3)
    assert found.columns == pytest.approx(1800, rel=1e-3)


def test_an_image_of_another_sensor_says_its_empty_rays():
    source = replace(
        VLP16, elevations=tuple(e - 0.2 for e in BEAMS), columns=512
    )  # one of them in row 0
    image = project(wall(fired()).xyz, np.repeat(np.arange(16) / 16, 1800), source)
    image[:, :, 100:104] = 0
    seen = image_through(image, source, TARGET)
    inside = sorted(rows_with_beams(source.elevations, TARGET))
    assert (seen.state[inside, 50:52] == Ray.EMPTY).all()
    assert (np.delete(seen.state[inside], [50, 51], axis=1) == Ray.RETURN).all()
    strength = (
        np.flatnonzero(rows_of(source.elevations, TARGET) >= 0)[:, None] / 16
    )  # n / 16 of beam n
    assert (np.delete(seen.image[1, inside], [50, 51], axis=1) == strength).all()
    assert (np.delete(seen.state, inside, axis=0) == Ray.UNKNOWN).all()


def test_a_scan_of_the_same_sensor_is_measured_everywhere_but_where_it_was_cut():
    firing = fired(TARGET.elevations, 2000)
    lost = np.zeros((32, 2000), bool)
    lost[:, 1000:] = True  # azimuth 0 to 180
    lost[3, 100:130] = True
    seen = points_of_same(wall(firing, lost), TARGET)
    assert (seen.state[:, 1:126] == Ray.UNKNOWN).all()
    assert (seen.state[3] == Ray.EMPTY).sum() >= 3
    assert (np.delete(seen.state, 3, axis=0)[:, 130:] == Ray.RETURN).all()
    for gap, state in (
        (65, Ray.EMPTY),
        (66, Ray.UNKNOWN),
    ):  # gap + 1 of 2,000 steps; three of 90 columns are 66.7
        cut = wall(firing, np.broadcast_to(np.arange(2000) >= 2000 - gap, (32, 2000)))
        assert (points_of_same(cut, TARGET.resized(32, 90)).state[:, 1] == state).all()


def test_what_is_behind_a_near_return_of_the_same_sensor_was_not_measured():
    near, away = 100, (30, 200)  # columns, of 0.5 m and of 10 m; the others came back empty
    e, a = TARGET.rays().double().numpy()[:, :, [near, *away]]
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    xyz = rays * np.array([0.5, 10, 10])[None, :, None]
    every = np.pi * (1 - 2 * (np.arange(256) + 0.5) / 256)
    ring = 10 * np.stack(
        [np.cos(every), np.sin(every), np.full(256, np.tan(e[0, 0]))], -1
    )  # no sector is blind
    points = np.concatenate([xyz[1:].reshape(-1, 3), ring, np.zeros((5, 3))]).astype(np.float32)
    seen = points_of_same(Points(points), TARGET)
    assert (seen.state[0] == Ray.RETURN).all()
    assert (seen.state[1:, near] == Ray.UNKNOWN).all()
    assert (seen.state[1:, list(away)] == Ray.RETURN).all()
    assert (np.delete(seen.state[1:], [near, *away], axis=1) == Ray.EMPTY).all()


def test_a_range_image_says_all_its_rays():
    image = np.array(
        [[[5.0, 0.0, 0.7, 90.0, 1.45, 80.0]], [[1.2, 0.0, 0.2, 1.3, 0.5, 0.25]]], np.float32
    )
    seen = image_of_same(image, TARGET)
    assert seen.state.tolist() == [
        [Ray.RETURN, Ray.EMPTY, Ray.UNKNOWN, Ray.EMPTY, Ray.RETURN, Ray.RETURN]
    ]
    assert seen.image.tolist() == [
        [[5.0, 0, 0, 0, image[0, 0, 4], 80]],
        [[1.0, 0, 0, 0, 0.5, 0.25]],
    ]  # with the limits


def test_one_damaged_row_does_not_make_a_cut_sector_measured():
    firing = fired()
    lost = np.zeros((16, 1800), bool)
    lost[:, 300:1200] = True
    some = wall(firing, lost)
    clean = points_through(some, firing, TARGET).state
    for dropped in (1, len(some.xyz) // 10):  # the latter are lost rays of the half turn alone
        assert (points_through(replace(some, dropped=dropped), firing, TARGET).state == clean).all()
    assert (clean == Ray.UNKNOWN).sum() > (clean == Ray.EMPTY).sum()
