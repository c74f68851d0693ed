import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.partial import open_partial
from r2flow.data.reading import Reading, read_image
from r2flow.lidar.beams import find_beams
from r2flow.lidar.estimation import estimate_sensor, steps_of_a_turn
from r2flow.lidar.projection import image_to_points, project, project_indices
from r2flow.lidar.scan_files import Points, read_points
from r2flow.lidar.sensors import SENSORS, Sensor

HDL64E = SENSORS["hdl64e"]


def random_image(sensor: Sensor, seed: int = 0, filled: float = 0.8) -> np.ndarray:
    draw = np.random.default_rng(seed)
    r = draw.uniform(sensor.min_range * 1.01, sensor.max_range * 0.99, sensor.shape)
    hit = draw.random(sensor.shape) < filled
    # A ring is told apart by points on both sides of straight ahead.
    hit[:, sensor.columns // 2 - 1 : sensor.columns // 2 + 1] = True
    return np.stack([r, draw.random(sensor.shape)]).astype(np.float32) * hit


def point(r: float, elevation: float, azimuth: float) -> list[float]:
    e, a = math.radians(elevation), math.radians(azimuth)
    return [r * math.cos(e) * math.cos(a), r * math.cos(e) * math.sin(a), r * math.sin(e)]


@pytest.mark.parametrize("projection", ["spherical", "unfolding"])
def test_points_to_image_to_points(sensor, projection):
    image = random_image(sensor)
    xyz, reflectance = image_to_points(image, sensor.rays())
    again = project(xyz, reflectance, sensor, projection)
    np.testing.assert_allclose(again[0], image[0], rtol=1e-6)
    np.testing.assert_array_equal(again[1], image[1])
    back, back_reflectance = image_to_points(again, sensor.rays().numpy())
    np.testing.assert_allclose(back, xyz, rtol=0, atol=1e-4)
    np.testing.assert_array_equal(back_reflectance, reflectance)
    np.testing.assert_array_equal(image_to_points(again, sensor.name)[0], back)
    np.testing.assert_array_equal(project(xyz, reflectance, sensor.name, projection), again)


@pytest.mark.parametrize("r", [math.nan, math.inf, -5])
def test_a_range_that_is_none_is_no_point(r):
    image = np.array([[[10, r, 20]], [[0.1, 0.2, 0.3]]], np.float32)
    xyz, reflectance = image_to_points(image, np.zeros((2, 1, 3)))
    assert sorted(xyz.tolist()) == [[10, 0, 0], [20, 0, 0]]
    np.testing.assert_array_equal(np.sort(reflectance), image[1, 0, ::2])


def test_points_on_the_edges_of_pixels_go_to_the_lower_row_and_the_later_column():
    coarse = HDL64E.resized(32, 256)
    image, expected = random_image(coarse), np.zeros((2, 64, 1024), np.float32)
    expected[:, 1::2, 2::4] = image
    np.testing.assert_allclose(
        project(*image_to_points(image, coarse), HDL64E), expected, rtol=1e-6
    )


def test_a_return_too_near_does_not_hide_what_is_behind_it():
    points = np.array([point(1.0, -5, 20), point(30, -5, 20)])
    for convention, seen in (
        ("centre", 30),
        ("reference", 0),
        ("lidm", 30),
    ):  # the reference masks after choosing
        assert project(points, np.ones(2), HDL64E, convention=convention)[0].max() == pytest.approx(
            seen, rel=1e-6
        )


@pytest.mark.parametrize("convention", ["centre", "reference", "lidargen", "lidm"])
@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_no_returns(convention, lost):
    """Neither in their own pixel nor in one that another point falls into, as the one at azimuth
    and elevation 0.
    """
    xyz = np.array([[10, 0, 0], [3, -4, 0.1], [-8, 1, -1]], dtype=np.float32)
    with_lost = np.concatenate([xyz, [[lost, 0, 0], [1, lost, 2], [lost, lost, lost]]]).astype(
        np.float32
    )
    alone, beside = (project(p, None, HDL64E, convention=convention) for p in (xyz, with_lost))
    assert (alone[0] > 0).sum() == 3
    np.testing.assert_array_equal(beside, alone)


@pytest.mark.parametrize("shape", [(5, 4), (3, 5), (5, 2), (3,)])
def test_coordinates_of_another_shape_are_refused(shape):
    for take in (lambda xyz: project(xyz, None, HDL64E), Points):
        with pytest.raises(InputError, match=re.escape(f"(N, 3), as points[:, :3]; found {shape}")):
            take(np.ones(shape, np.float32))


def test_points_out_of_view_are_dropped_not_clamped():
    points = np.array([point(10, 8, 0), point(10, -40, 0)])
    assert project(points, np.ones(2), HDL64E)[0].max() == 0
    assert project(points, None, HDL64E, convention="reference")[0, [0, 63], 512] == pytest.approx(
        [10, 10], rel=1e-6
    )


@pytest.mark.parametrize("convention", ["centre", "reference", "lidargen", "lidm"])
def test_the_seam_is_where_the_convention_has_it(convention):
    image = project(np.array([[-30, -0.0, 0], [80, 0, 0]]), None, HDL64E, convention=convention)[0]
    assert image[:, 1023 if "lid" in convention else 0].max() == 30  # at -180 degrees
    assert image[:, 512].max() == (0 if convention == "lidm" else 80)  # the limit itself


def assert_the_reference_s(points, projection, h=None):
    """facts of the reference, written as they read, in float64 where it matters little."""
    d, (x, y, z, reflectance) = np.linalg.norm(points[:, :3], axis=1), points.T
    if h is None:
        h = (
            np.floor((1 - (np.arcsin(z / d) + np.deg2rad(25)) / np.deg2rad(28)) * 64)
            .clip(0, 63)
            .astype(int)
        )
    w = np.floor((-np.arctan2(y, x) / np.pi + 1) / 2 % 1 * 1024).clip(0, 1023).astype(int)
    expected, order = np.zeros((2, 64, 1024), np.float32), np.argsort(-d)
    expected[:, h[order], w[order]] = d[order], reflectance[order]
    expected *= (expected[0] >= 1.45) & (expected[0] <= 80)
    ours = project(points[:, :3], reflectance, HDL64E, projection, "reference")
    assert (ours != expected).any(0).mean() < 1e-3


def test_the_reference_s_convention_on_real_scans(shared):
    for path in sorted((shared / "real" / "kitti360").rglob("*.bin"))[:4]:
        assert_the_reference_s(np.fromfile(path, np.float32).reshape(-1, 4), "spherical")


def test_the_reference_s_unfolding_on_real_scans(shared):
    for path in [
        path
        for name in ("raw", "odometry")
        for path in sorted((shared / "real" / name).rglob("*.bin"))[-2:]
    ]:
        whole = np.fromfile(path, np.float32).reshape(-1, 4)
        for points in (whole, whole[9000:-100], np.concatenate([whole[90000:], whole])):
            x, y = points[:, 0], points[:, 1]
            quadrant = np.select(
                [(x >= 0) & (y >= 0), (x < 0) & (y >= 0), (x < 0) & (y < 0)], [0, 1, 2], 3
            )
            ends = [len(x), *np.flatnonzero((quadrant == 0) & (np.roll(quadrant, 1) == 3))[::-1]]
            h = np.zeros(len(x), int)  # also before the first ring, and from the 66th on
            for row, (end, start) in zip([*range(63, -1, -1), 63], pairwise(ends), strict=False):
                h[start:end] = row
            assert_the_reference_s(points, "unfolding", h)
            if (
                len(ends) < 66
            ):  # ours has a row for each ring, also for one that is cut at its start
                image = project(points[:, :3], None, HDL64E, "unfolding")[0]
                assert (image > 0).any(axis=1).sum() == len(ends) - (ends[-1] == 0)


@pytest.mark.parametrize("share", [0.05, 0.95])
def test_a_point_near_an_edge_of_a_bin_is_in_its_pixel(sensor, share):
    edges = np.deg2rad(sensor.row_edges)
    turn = (np.arange(sensor.columns) + share) / sensor.columns
    e, a = np.meshgrid(edges[:-1] + share * np.diff(edges), np.pi * (1 - 2 * turn), indexing="ij")
    xyz = 20 * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    hit, chosen, _ = project_indices(xyz.reshape(-1, 3), sensor)
    assert hit.tolist() == chosen.tolist() == list(range(e.size))


def cloud(sensor: Sensor, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a random image, (W, H, 3), a firing after the other, each from the top; a fifth
    without return.
    """
    image = random_image(sensor, seed)[0]
    e, a = sensor.rays().numpy()
    xyz = np.stack(
        [image * np.cos(e) * np.cos(a), image * np.cos(e) * np.sin(a), image * np.sin(e)]
    )
    return xyz.transpose(2, 1, 0), image


def packet_order(sensor: Sensor, how: str) -> np.ndarray:
    """Row of laser 0, 1, ... of a file."""
    rows = np.arange(len(sensor.elevations))
    return {"top": rows, "bottom": rows[::-1], "firing": np.array(sensor.firing or rows)}[how]


@pytest.mark.parametrize("how", ["top", "bottom", "firing"])
@pytest.mark.parametrize("name", ["hdl32e", "vlp16", "vlp32c", "os1_64", "pandar64"])
def test_whole_firings_unfold_whatever_their_order(name, how):
    sensor = SENSORS[name].resized(columns=48)
    firings, image = cloud(sensor)
    xyz = firings[:, packet_order(sensor, how)].reshape(-1, 3)
    np.testing.assert_allclose(project(xyz, None, sensor, "unfolding")[0], image, rtol=1e-6)


def test_scans_whose_lasers_cannot_be_found_and_unknown_projections_are_refused_in_one_line():
    sensor = SENSORS["vlp32c"].resized(columns=64)
    xyz = cloud(sensor)[0][:, np.array(sensor.firing)].reshape(-1, 3)
    for wrong, words in (
        (
            {"xyz": xyz[xyz.any(axis=1)]},
            r"neither ring after ring nor in whole firings of 32.*spherical",
        ),
        (
            {"ring": np.tile(np.arange(64), 32)},
            r"ring numbers up to 63, but sensor 'vlp32c' has 32 rows",
        ),
        (
            {"ring": np.tile(np.arange(32) // 4, 64)},
            r"ring numbers up to 7, but sensor 'vlp32c' has 32 rows",
        ),
        ({"ring": np.random.default_rng(0).integers(0, 32, 2048)}, "follow neither the elevations"),
        ({"projection": "unfold"}, "no projection 'unfold'"),
    ):
        with pytest.raises(InputError, match=words) as error:
            project(
                **{
                    "xyz": xyz,
                    "reflectance": None,
                    "sensor": sensor,
                    "projection": "unfolding",
                    **wrong,
                }
            )
        assert "\n" not in str(error.value)


def test_two_exchanged_rings_are_refused():
    sensor = SENSORS["hdl32e"].resized(columns=48)
    xyz, _ = image_to_points(np.full((1, 32, 48), 9, np.float32), sensor)
    ring = np.repeat(np.arange(32), 48)
    assert (project(xyz, None, sensor, "unfolding", ring=ring)[0] > 0).all()
    for pair in ((0, 1), (17, 18), (3, 20)):
        exchanged = np.arange(32)
        exchanged[[*pair]] = pair[::-1]
        with pytest.raises(InputError, match="follow neither the elevations"):
            project(xyz, None, sensor, "unfolding", ring=exchanged[ring])


@pytest.mark.parametrize(
    "number", [lambda row: 4 * row, lambda row: 61 - 4 * row, lambda row: row**2]
)
def test_ring_numbers_with_gaps_unfold_to_their_own_sensor(number):
    sensor = SENSORS["vlp16"].resized(columns=48)
    image = np.full((1, 16, 48), 9, np.float32)
    xyz, _ = image_to_points(image, sensor)
    ring = number(np.repeat(np.arange(16), 48))
    mine = estimate_sensor([Points(xyz, None, ring.astype(np.uint16))]).sensor
    seen = ring != number(2)  # a beam without return
    found = project(xyz[seen], None, replace(mine, columns=48), "unfolding", ring=ring[seen])[0]
    image[0, 2] = 0
    np.testing.assert_allclose(found, image[0], rtol=1e-6)


@pytest.mark.parametrize("start", [0, 24, 31])
@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("upwards", [False, True])
def test_rings_unfold_from_any_azimuth_in_either_direction(start, clockwise, upwards):
    sensor = SENSORS["vlp16"].resized(columns=48)
    image = np.full((1, 16, 48), 9, np.float32)
    image[0, :3, 10:44] = 0  # the upper rings see sky
    image[0, 2, 20] = 9
    order = np.roll(np.arange(48)[:: 1 if clockwise else -1], start)
    e, a = sensor.rays().double().numpy()[:, :: -1 if upwards else 1, order]
    xyz = 9 * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1)
    kept = image[0, :: -1 if upwards else 1][:, order] > 0
    found = project(xyz[kept], None, sensor, "unfolding")[0]
    np.testing.assert_allclose(found, image[0], rtol=1e-6)


def test_lost_rays_of_whole_firings_may_be_nan(tmp_path):
    sensor = SENSORS["vlp16"].resized(columns=48)
    firings, image = cloud(sensor)
    xyz = firings[:, packet_order(sensor, "firing")].reshape(-1, 3)
    xyz[~xyz.any(axis=1)] = np.nan
    np.save(tmp_path / "0.npy", xyz)
    found = read_image(tmp_path / "0.npy", Reading(sensor, "unfolding", reflectance=False))
    np.testing.assert_allclose(found[0], image, rtol=1e-6)
    assert find_beams(read_points(tmp_path / "0.npy")).firing is not None
    (scan,), _ = open_partial(
        [str(tmp_path / "0.npy")], Reading(sensor, "unfolding"), sensor
    )  # as complete reads it
    np.testing.assert_allclose(scan.read().image[0], image, rtol=1e-6)


@pytest.mark.parametrize(
    "missing", [[], [7], [0], [31], [0, 31], [0, 1, 2, 30, 31], list(range(31))]
)
@pytest.mark.parametrize("how", ["top", "bottom", "firing"])
@pytest.mark.parametrize("first", [0, 1])
def test_ring_numbers_keep_their_rows_whichever_rings_returned(how, first, missing):
    sensor = SENSORS["vlp32c"].resized(columns=48)
    firings, image = cloud(sensor)
    laser, ring = packet_order(sensor, how), np.tile(np.arange(32), 48)
    kept = np.random.default_rng(1).permutation(np.flatnonzero(~np.isin(ring, missing)))
    ring = (ring + first).astype(np.uint16)
    again = project(
        firings[:, laser].reshape(-1, 3)[kept], None, sensor, "unfolding", ring=ring[kept]
    )
    image[laser[missing]] = 0
    np.testing.assert_allclose(again[0], image, rtol=1e-6)


@pytest.mark.parametrize("columns", [48, 63, 64, 83, 255])
def test_points_of_an_image_of_any_width_unfold_to_it(columns):
    sensor = SENSORS["vlp16"].resized(columns=columns)
    image = cloud(sensor, 5)[1][None]
    xyz, corners = (
        image_to_points(image, sensor.rays(rays))[0] for rays in ("centre", "reference")
    )
    for points in (xyz, np.insert(xyz, range(len(xyz)), np.nan, axis=0), corners):
        np.testing.assert_allclose(
            project(points, None, sensor, "unfolding")[0], image[0], rtol=1e-6
        )


def test_lost_rays_leave_every_point_its_beam(tmp_path):
    """Without ring numbers, in no order: rows of NaN are dropped, and are not counted."""
    sensor = SENSORS["vlp16"].resized(columns=480)
    row = np.tile(np.arange(16), 480)
    mixed = np.random.default_rng(2).permutation(len(row))
    xyz = cloud(sensor)[0].reshape(-1, 3)[mixed]
    xyz[lost := ~xyz.any(axis=1)] = np.nan
    np.save(tmp_path / "0.npy", xyz)
    scan = read_points(tmp_path / "0.npy")
    beams = find_beams(scan)
    np.testing.assert_array_equal(beams.of_point[0], row[mixed][~lost])
    assert steps_of_a_turn([scan], beams.of_point) == pytest.approx(480, rel=1e-3)
