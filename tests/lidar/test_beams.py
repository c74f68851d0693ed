"""Sensors told by their scans: every sensor with its own scans and with every other one's."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.described import describe
from r2flow.data.reading import Reading
from r2flow.data.reflectance import scaled_reflectance
from r2flow.data.sensor_checks import warn_of_frame, warn_of_other_sensor
from r2flow.lidar.beams import FIRINGS, RING_AFTER_RING, RINGS, UNORDERED, find_beams
from r2flow.lidar.estimation import estimate_sensor, full_reflectance
from r2flow.lidar.matching import differing, is_tilted, nearest_sensor, other_sensor
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.scan_files import Points, read_points, write_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of
from r2flow.simulator import simulate
from tests.conftest import refused

HEIGHT, WALL = 1.6, 25.0


def street(sensor: Sensor, seed: int) -> np.ndarray:
    """Ground HEIGHT below the sensor and a round wall about it, with holes: range and reflectance,
    (2, H, W).
    """
    draw = np.random.default_rng(seed)
    e = sensor.rays().numpy().astype(np.float64)[0]
    ground = np.where(e < 0, HEIGHT / np.sin(np.maximum(-e, 1e-9)), np.inf)
    r = np.minimum(ground, WALL / np.cos(e)) * (draw.random(e.shape) < 0.8)
    r[:seed] = 0  # only sky: rings missing at the top
    return np.stack([r, np.where(r > 0, draw.random(e.shape), 0)]).astype(np.float32)


def scan(sensor: Sensor, how: str, seed: int = 0) -> Points:
    image = street(sensor, seed)
    if how == RING_AFTER_RING:
        return Points(*image_to_points(image, sensor.rays()))
    e, a = sensor.rays().numpy().astype(np.float64)
    rows = np.arange(len(e)) if sensor.firing is None else np.array(sensor.firing)
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    xyz = (image[0] * direction)[:, rows].transpose(2, 1, 0).reshape(-1, 3).astype(np.float32)
    reflectance, ring = image[1][rows].T.ravel(), np.tile(rows, sensor.columns)
    if how == FIRINGS:
        return Points(xyz, reflectance)
    kept = np.flatnonzero(xyz.any(axis=1))
    if how in (RINGS, UNORDERED):
        kept = np.random.default_rng(seed).permutation(kept)
    return Points(
        xyz[kept], reflectance[kept], ring[kept].astype(np.uint16) * (how == RINGS)
    )  # 0: as not numbered


MINE = Sensor("mine", (21.0, 12.5, 3.0, 2.0, 1.25, -0.5, -4.0, -9.0, -17.5))


@pytest.mark.parametrize("how", [RINGS, FIRINGS, RING_AFTER_RING, UNORDERED])
@pytest.mark.parametrize("name", ["vlp16", "hdl32e", "vlp32c", "os1_64", "pandar64", "mine"])
def test_a_sensor_is_found_again(name, how):
    sensor = (MINE if name == "mine" else SENSORS[name]).resized(columns=192)
    found = estimate_sensor([scan(sensor, how, seed) for seed in range(2)])
    assert found.beams.order == how
    np.testing.assert_allclose(found.beams.elevations, sensor.elevations, atol=1e-3)
    assert found.steps == pytest.approx(192, rel=1e-4)
    assert found.sensor.columns == 192
    assert found.sensor.height == pytest.approx(HEIGHT, abs=0.01)
    nearest, distance = nearest_sensor(found.beams.elevations)
    assert (
        nearest is None
        if name == "mine"
        else (nearest, distance) == (name, pytest.approx(0, abs=1e-3))
    )
    assert found.beams.firing == (sensor.firing if how == FIRINGS else None)


@pytest.mark.parametrize("start", [-60.0, 133.7])
@pytest.mark.parametrize("y", [1, -1])  # axes with y to the left, and to the right
@pytest.mark.parametrize("rows", [4, 32, 128])
def test_rings_may_begin_at_any_azimuth_and_turn_either_way(start, y, rows):
    sensor = Sensor("tall", tuple(np.linspace(12, -25, rows).tolist()), columns=360)
    image = street(sensor, 0)[0]
    azimuth = np.radians(start + np.arange(360))
    e = np.radians(sensor.elevations)[:, None]
    direction = [
        np.cos(e) * np.cos(azimuth),
        y * np.cos(e) * np.sin(azimuth),
        np.sin(e) + 0 * azimuth,
    ]
    xyz = (image * np.stack(direction)).transpose(1, 2, 0)[image > 0].astype(np.float32)
    beams = find_beams(Points(xyz))
    assert beams.order == RING_AFTER_RING
    np.testing.assert_allclose(beams.elevations, sensor.elevations, atol=1e-3)
    np.testing.assert_array_equal(beams.of_point[0], np.nonzero(image)[0])


def test_beams_of_one_elevation_are_no_rings():
    """Each ring is stored as two halves of a turn, apart: 32 rings, but 16 beams."""
    image = street(SENSORS["vlp16"].resized(columns=192), 0)
    xyz, _ = image_to_points(image, SENSORS["vlp16"].resized(columns=192).rays())
    ring = find_beams(Points(xyz)).of_point[0]
    twice = np.concatenate([xyz[ring == row // 2] for row in range(32)])
    found = find_beams(Points(twice))
    np.testing.assert_allclose(found.elevations, SENSORS["vlp16"].elevations, atol=1e-3)


def test_the_distance_of_most_points_is_told():
    """One point in ten a degree off its beam: the median does not tell it."""
    points = scan(MINE, RINGS)
    off = np.random.default_rng(0).random(len(points.xyz)) < 0.1
    distance = np.linalg.norm(points.xyz, axis=1)
    e = np.arcsin(points.xyz[:, 2] / distance) + np.radians(off)
    azimuth = np.arctan2(points.xyz[:, 1], points.xyz[:, 0])
    moved = distance * [np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)]
    found = estimate_sensor([Points(moved.T.astype(np.float32), None, points.ring)])
    assert found.off == (pytest.approx(0, abs=1e-3), pytest.approx(1, abs=1e-3))


@pytest.mark.parametrize("share", [0.3, 0.0])  # of the rays with two returns
def test_two_returns_of_each_ray_are_of_one_beam(share):
    points = scan(SENSORS["vlp16"].resized(columns=192), FIRINGS)
    xyz = np.repeat(points.xyz, 2, axis=0)
    xyz[1::2] *= 0.9 * (np.random.default_rng(1).random((len(points.xyz), 1)) < share)
    found = find_beams(Points(xyz))
    np.testing.assert_allclose(found.elevations, SENSORS["vlp16"].elevations, atol=1e-3)
    assert not share or found.firing == SENSORS["vlp16"].firing


@pytest.mark.parametrize("first", [0, 1])
def test_ring_numbers_by_laser_give_the_firing_order(first):
    sensor = SENSORS["vlp16"].resized(columns=192)
    whole = scan(sensor, FIRINGS)
    laser = np.tile(np.arange(16) + first, sensor.columns).astype(np.uint16)
    returned = whole.xyz.any(axis=1)
    points = Points(whole.xyz[returned], whole.reflectance[returned], laser[returned])
    mine = estimate_sensor([points]).sensor
    assert mine.firing == sensor.firing
    image = project(points.xyz, points.reflectance, mine, "unfolding", ring=points.ring)
    np.testing.assert_array_equal(image, project(points.xyz, points.reflectance, sensor))


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        (np.arange(100) / 100, 1),  # KITTI, and so KITTI-360
        (np.arange(101), 100),
        (np.arange(236), 255),
        (np.arange(257), 256),
        (
            np.append(np.tile(np.arange(101), 300), [180, 240]),
            255,
        ),  # a Velodyne's few retroreflectors
        (np.arange(301), 300),  # an Ouster's counts of photons
        (np.linspace(0, 3000, 50), 3000),
        (np.linspace(0, 7000, 50), 65535),
        (np.linspace(0, 0.0115, 50), 0.012),
        (np.append(np.full(960, 0.3), np.linspace(1.5, 4e4, 40)), 1),  # as Waymo's
        (np.append(np.linspace(0, 1, 960), [2e4] * 100), 65535),  # too many for outliers
        (np.append(np.tile(np.arange(256), 9), [4e4, 65535]), 255),
        (np.append(np.tile(np.arange(2001), 9), [65535] * 9), 2000),  # saturated counts
        (np.append(np.linspace(0, 0.0115, 999), [2e4]), 0.012),
        (np.zeros(5), None),
    ],
)
def test_the_scale_of_reflectance_is_estimated(values, scale):
    points = Points(np.ones((len(values), 3)), values.astype(np.float32))
    assert full_reflectance([points]) == scale
    assert full_reflectance([Points(points.xyz)]) is None
    if scale:
        assert scaled_reflectance("a.bin", points, scale)[0].max() == pytest.approx(
            min(values.max() / scale, 1)
        )
    fractions = Points(np.ones((3, 3)), np.float32([0, 0.5, 1]))
    assert scaled_reflectance("a.bin", fractions, 255)[0].tolist() == [0, 0.5, 1]


@pytest.mark.parametrize(("scale", "dark"), [(1, False), (65535, True)])
def test_outliers_of_reflectance_are_clipped_with_a_warning(tmp_path, caplog, scale, dark):
    values = np.append(np.full(997, 0.3), [2e4] * 3).astype(np.float32)
    points = Points(np.ones((1000, 3), np.float32), values + (0 if scale == 1 else 1))
    scaled, _ = scaled_reflectance(tmp_path / "a.bin", points, scale)
    np.testing.assert_allclose(scaled, (points.reflectance / scale).clip(0, 1), rtol=1e-6)
    assert ("reflectance beyond 1 is clipped (3 points" in caplog.text) == (scale == 1)
    assert ("half of it below a hundredth" in caplog.text) == dark


def test_range_limits_include_all_but_stray_returns():
    sensor = SENSORS["vlp16"].resized(columns=1024)
    xyz = scan(sensor, RING_AFTER_RING).xyz
    r = np.linalg.norm(xyz, axis=1)
    mine = estimate_sensor(
        [Points(np.append(xyz, np.float32([[900, 0, 0]]), 0))]
    ).sensor  # one bad return of 13,000
    assert mine.min_range == sensor.min_range < r.min()  # nothing is near in these scans
    assert r.max() <= mine.max_range < r.max() + 1
    assert estimate_sensor([scan(MINE, RING_AFTER_RING)]).sensor.min_range == 0.5
    assert (
        estimate_sensor([Points(xyz / 20)]).sensor.min_range == math.floor(r.min() / 2) / 10
    )  # 0.3 m


def test_a_level_beam_is_not_at_minus_zero():
    level = Sensor("level", (4.0, 2.0, -2e-4, -2.0, -4.0), columns=192)
    assert (
        str(estimate_sensor([scan(level, RINGS)]).sensor.elevations)
        == "(4.0, 2.0, 0.0, -2.0, -4.0)"
    )


def test_what_no_sensor_is_estimated_from_is_refused():
    with pytest.raises(InputError, match="too few"):
        estimate_sensor([Points(np.ones((1, 3), np.float32))])
    with pytest.raises(InputError, match="are the points in metres"):
        estimate_sensor([Points(1000 * scan(MINE, FIRINGS).xyz)])


def real(shared, pattern: str, step: int = 1, most: int | None = None) -> list[Points]:
    return [read_points(path) for path in sorted((shared / "real").glob(pattern))[::step][:most]]


@pytest.mark.parametrize(
    ("scans", "step", "name", "order", "off", "steps"),
    [
        # Another car each, whose rings differ. 1.3 million shots a second of 64 lasers, 10 turns a
        # second: 2,083 steps, which the turns' speed makes 2,000 to 2,200.
        ("kitti360/**/*.bin", 5, "hdl64e_rings", RING_AFTER_RING, 0.25, 2100),
        ("raw/**/*.bin", 10, "hdl64e_rings", RING_AFTER_RING, 0.25, 2100),
        ("odometry/**/*.bin", 1, "hdl64e_rings", RING_AFTER_RING, 0.25, 2100),
        (
            "other_sensors/nuscenes_hdl32e/*.bin",
            1,
            "hdl32e",
            RINGS,
            0.1,
            1084,
        ),  # 34,688 points of 32 lasers
        (
            "other_sensors/rellis_os1_64/*.bin",
            1,
            "os1_64",
            FIRINGS,
            0.5,
            2048,
        ),  # a unit's beams lie off the design's
        ("other_sensors/rellis_vlp32c/*.bin", 1, "vlp32c", UNORDERED, 0.001, 1800),  # 0.2 degrees
        (
            "other_sensors/vlp16/*.pcd",
            1,
            "vlp16",
            UNORDERED,
            0.01,
            1809,
        ),  # a firing each 55.296 us, 10 turns a second
        ("pandaset/*/lidar/*.pkl.gz", 2, "pandar64", UNORDERED, 0.05, 1800),
    ],
)
def test_the_beams_of_real_sensors(shared, scans, step, name, order, off, steps):
    points = real(shared, scans, step)
    found = estimate_sensor(points)
    assert found.beams.order == order
    assert nearest_sensor(found.beams.elevations)[0] == name.removesuffix("_rings")
    np.testing.assert_allclose(found.beams.elevations, SENSORS[name].elevations, atol=off)
    assert found.steps == pytest.approx(steps, abs=100 if name == "hdl64e_rings" else steps / 100)
    if name == "hdl64e_rings":  # KITTI's own figures
        assert found.sensor.height == pytest.approx(1.73, abs=0.1)
        assert found.sensor.reflectance_scale == 1
        return
    for one in points:
        mine, table = found.sensor, SENSORS[name].resized(columns=found.sensor.columns)
        filled = [(project(one.xyz, None, sensor)[0] > 0).sum() for sensor in (mine, table)]
        assert filled[0] >= 0.99 * filled[1] > 0.2 * math.prod(mine.shape)


def test_every_beam_of_a_real_unit_has_its_own_row(shared):
    (points,) = real(shared, "other_sensors/rellis_os1_64/*.bin")
    mine = estimate_sensor([points]).sensor
    rows = lambda sensor: (project(points.xyz, None, sensor)[0] > 0).any(axis=1).sum()  # noqa: E731
    assert rows(mine) == 64
    assert rows(SENSORS["os1_64"]) < 64  # the design's beams miss this unit's: some rows stay empty
    assert other_sensor([points], mine) is None
    assert "stay empty" in other_sensor([points], SENSORS["os1_64"]).seen


@pytest.mark.parametrize("name", SENSORS)
def test_the_height_of_simulated_scans_is_found(name):
    """Beams close to the horizon meet more hedges and cars than ground."""
    sensor = SENSORS[name].resized(columns=256)
    scans = [
        Points(*image_to_points(simulate(sensor, 3, index).image, sensor.rays()))
        for index in range(4)
    ]
    assert estimate_sensor(scans).sensor.height == pytest.approx(sensor.height, abs=0.2)


HDL64E = {"hdl64e", "hdl64e_rings"}
SIZED = {
    **dict(SENSORS.items()),
    "hdl64e 16x256": SENSORS["hdl64e"].resized(16, 256),
    "vlp16 8x128": SENSORS["vlp16"].resized(8, 128),
    "pandar64 32x512": SENSORS["pandar64"].resized(32, 512),
}
# Real scans: how many are looked at, and whose they are. Alone, each of KITTI's calibrations must
# do.
REAL = {
    "kitti360/**/*.bin": (3, "hdl64e"),
    "raw/**/*0005*/**/*.bin": (3, "hdl64e"),
    "odometry/**/00/velodyne/*.bin": (3, "hdl64e"),
    "object/**/*.bin": (3, "hdl64e"),
    "other_sensors/nuscenes_hdl32e/*.pcd.bin": (1, "hdl32e"),
    "other_sensors/rellis_os1_64/*.bin": (1, "os1_64"),
    "other_sensors/rellis_vlp32c/*.bin": (1, "vlp32c"),
    "other_sensors/vlp16/*.pcd": (3, "vlp16"),
}


def refuse_wrong_answers(scans: list[Points], true: str) -> None:
    """Every sensor but the true one is doubted, and the true one is named."""
    for name, sensor in SIZED.items():
        found = other_sensor(scans, sensor)
        if name.split()[0] == true or {name.split()[0], true} <= HDL64E:
            assert found is None or (found.name, true) == (None, "os1_64"), (
                name,
                found,
            )  # rows between beams
        else:
            assert found[1] == true.removesuffix("_rings"), (name, found)


@pytest.mark.parametrize("name", [name for name in SENSORS if name != "hdl64e"])
def test_every_pair_of_sensors_is_told_apart(name: str):
    sensor = SENSORS[name].resized(columns=192)
    for how in (RINGS, RING_AFTER_RING):
        refuse_wrong_answers([scan(sensor, how, seed) for seed in range(2)], name)


@pytest.mark.parametrize("pattern", list(REAL))
def test_real_scans_are_of_their_own_sensor_alone(shared: Path, pattern: str):
    count, true = REAL[pattern]
    scans = real(shared, pattern, most=count)
    assert len(scans) == count
    refuse_wrong_answers(scans, true)
    for one in scans:
        for name in HDL64E if true in HDL64E else {true} - {"os1_64"}:
            assert other_sensor([one], SENSORS[name]) is None
        assert not is_tilted(one)


def pitched(points: Points, degrees: float) -> Points:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return Points(
        (points.xyz @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T).astype(np.float32),
        None,
        points.ring,
    )


@pytest.mark.parametrize("ringed", [True, False])
def test_two_sensors_in_one_file_are_warned_of(tmp_path: Path, caplog, ringed: bool):
    one, other = (scan(SENSORS["vlp16"].resized(columns=192), RINGS, seed) for seed in range(2))
    xyz = [
        one.xyz + np.float32([1, 0, 0]),
        other.xyz * np.float32([-1, -1, 1]) + np.float32([-2, 0, 0.3]),
    ]
    rings = np.concatenate([one.ring, other.ring]) if ringed else None
    write_points(tmp_path / "0.ply", np.concatenate(xyz), ring=rings)
    warn_of_other_sensor(describe(tmp_path), Reading(SENSORS["vlp16"]))
    assert (
        "give scans of one sensor, in its own frame" if ringed else "degrees off its beams"
    ) in caplog.text


@pytest.mark.parametrize("name", SENSORS)
def test_points_in_the_frame_of_a_pitched_vehicle_are_found(name: str):
    level = scan(SENSORS[name].resized(columns=384), UNORDERED)
    for degrees, tilted in ((0, False), (0.5, False), (2, True), (-5, True)):
        assert is_tilted(pitched(level, degrees)) == tilted, degrees
    other = scan(SENSORS["os1_64" if name == "vlp16" else "vlp16"].resized(columns=384), UNORDERED)
    pairs = [{name: level, "2": second} for second in (level, other)]
    assert [warn_of_frame(pair, named=True) for pair in pairs] == [False, True]
    with refused("are of two sensors"):
        warn_of_frame(pairs[1])


@pytest.mark.parametrize("name", SENSORS)
def test_scans_of_two_sensors_differ_and_a_thinned_scan_does_not(name: str):
    whole = scan(SENSORS[name].resized(columns=384), RINGS)
    third = Points(whole.xyz[whole.ring % 3 == 0], None, whole.ring[whole.ring % 3 == 0])
    assert differing([whole, third, third, whole]) == []
    other = "hdl32e" if name == "vlp32c" else "vlp32c"
    (first, _), (second, beams) = differing(
        [whole, third, scan(SENSORS[other].resized(columns=384), RINGS)]
    )
    assert (first, second) == (0, 2)
    np.testing.assert_allclose(beams, SENSORS[other].elevations, atol=0.01)


def test_real_scans_are_tilted_only_in_another_frame(shared: Path):
    for points in real(shared, "other_sensors/vlp16/*.pcd"):
        assert is_tilted(pitched(points, 5))
    for points in real(shared, "*/**/*.bin", step=6):
        quarter = points.xyz[find_beams(points).of_point[0] % 4 == 0]
        noisy = quarter + np.random.default_rng(0).normal(0, 0.02, quarter.shape).astype(np.float32)
        assert not any(
            is_tilted(one) for one in (points, *map(Points, (quarter, noisy, noisy * 1e-30)))
        )
        assert is_tilted(pitched(Points(quarter), 5))


def test_a_part_of_the_view_is_enough(shared: Path):
    """A camera's field of view: 82 degrees wide, and of 64 rings the lower 16 cut off."""
    for path in sorted((shared / "real" / "object").rglob("*.bin")):
        points = read_points(path)
        elevation, azimuth = (
            elevations_of(points.xyz),
            np.arctan2(points.xyz[:, 1], points.xyz[:, 0]),
        )
        part = points.xyz[(np.abs(azimuth) < np.radians(41)) & (elevation > -15.7)]
        assert len(part) < len(points.xyz) / 4
        assert [other_sensor([Points(part)], SENSORS[n]) is None for n in ("hdl64e", "vlp16")] == [
            True,
            False,
        ]


def test_scans_whose_beams_are_lost_are_judged_by_the_view(shared: Path):
    points = read_points(next((shared / "real" / "kitti360").rglob("*.bin")))
    lost = Points(np.random.default_rng(0).permutation(points.xyz))
    with pytest.raises(InputError, match="cannot be separated"):
        find_beams(lost)
    assert other_sensor([lost], SENSORS["hdl64e"]) is None
    assert other_sensor([lost], SENSORS["vlp16"]).name is None


def test_sensors_of_one_s_own_are_judged_by_their_beams():
    mine = Sensor("mine", tuple(np.linspace(3, -25, 24).tolist()))
    assert [
        other_sensor([scan(s, RING_AFTER_RING)], mine) is None for s in (mine, SENSORS["vlp16"])
    ] == [True, False]
    few = Points(scan(SENSORS["pandar64"], RING_AFTER_RING).xyz[:900])
    assert other_sensor([few], SENSORS["vlp16"]) is None  # a few returns say nothing
    assert nearest_sensor(35 - 4 * np.arange(11.0))[0] is None  # six of these are beams of a VLP-16
    less = scan(
        Sensor(
            "less",
            tuple(
                np.delete(SENSORS["hdl64e_rings"].elevations, [n for n in range(32, 64) if n % 4])
            ),
        ),
        RING_AFTER_RING,
    )
    assert "21 of its 64 rows lie between" in other_sensor([less], SENSORS["hdl64e_rings"]).seen


def test_rows_between_the_beams_of_ones_own_sensor_are_no_other_sensors(tmp_path: Path, caplog):
    for beams, rows in ((SENSORS["vlp16"], 32), (SENSORS["vlp16"], 64), (MINE, 27)):
        write_points(tmp_path / "0.ply", scan(beams, RING_AFTER_RING).xyz)
        own = Sensor("my_own", beams.elevations).resized(rows)
        warn_of_other_sensor(describe(tmp_path), Reading(own))
        assert not caplog.text
    own = Sensor("my_own", SENSORS["vlp16"].elevations)
    warn_of_other_sensor(describe(tmp_path), Reading(own))
    assert "give the right one" in caplog.text


def without_beams(pattern: str) -> Points:
    """The ground and a wall, seen by scanners whose pattern does not repeat: two sweeps whose rates
    have no ratio.
    """
    t, turn = np.linspace(0, 1, 60_000), 2 * np.pi
    if pattern == "turning":  # all around, up and down
        azimuth, elevation = turn * 431.7 * t, np.radians(22.5 + 29.5 * np.sin(turn * 1093.37 * t))
    elif pattern == "rosette":  # two prisms
        azimuth = np.radians(19.2) * (np.cos(turn * 1215.7 * t) + np.cos(-turn * 777.3 * t))
        elevation = np.radians(19.2) * (np.sin(turn * 1215.7 * t) + np.sin(-turn * 777.3 * t))
    else:
        azimuth = np.pi * (1 - 2 * np.random.default_rng(0).random(t.size))
        elevation = np.random.default_rng(1).permutation(0.4 * np.cos(turn * np.sqrt(2) * t))
    r = np.minimum(
        np.where(elevation < 0, 1.7 / np.sin(np.maximum(-elevation, 1e-9)), np.inf),
        25 / np.cos(elevation),
    )
    direction = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    return Points((r * direction).T.astype(np.float32))


@pytest.mark.parametrize("pattern", ["turning", "rosette", "random"])
def test_scanners_without_beams_are_refused_with_the_reason(tmp_path: Path, pattern: str):
    scan = without_beams(pattern)
    with pytest.raises(InputError, match="lie on no beams, as those of a Livox"):
        find_beams(scan)
    write_points(tmp_path / "0.ply", scan.xyz)
    with pytest.raises(InputError, match="lie on no beams"):
        warn_of_other_sensor(describe(tmp_path), Reading(SENSORS["hdl64e"], within_limits=True))
    assert all(other_sensor([scan], sensor).hopeless for sensor in SENSORS.values())
    with pytest.raises(
        InputError, match="lie on no beams"
    ):  # the number of one of its lasers is no ring
        find_beams(Points(scan.xyz, ring=np.arange(len(scan.xyz)) % 6))


def test_weak_beams_between_strong_ones_are_found_by_elevation():
    """76 beams, the strongest with a hundred times the returns of the weakest."""
    draw = np.random.default_rng(2)
    true = 5 - np.cumsum(draw.uniform(0.1, 0.9, 76))
    count = np.round(600 * np.exp(draw.normal(0, 1, 76))).astype(int)
    e = np.radians([draw.normal(beam, 0.03) for beam in np.repeat(true, count)])
    azimuth = draw.uniform(-np.pi, np.pi, len(e))
    xyz = 10 * np.transpose([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)])
    found = find_beams(Points(draw.permutation(xyz).astype(np.float32)))
    np.testing.assert_allclose(found.elevations, true, atol=0.05)


def test_rings_of_one_elevation_have_a_row_each():
    points = scan(SENSORS["vlp16"].resized(columns=192), RINGS)
    thrice = [
        Points(points.xyz, None, np.where(points.ring == 7, 16 + k, points.ring)) for k in range(3)
    ]
    found = estimate_sensor(thrice).sensor.elevations
    assert len(found) == 18
    np.testing.assert_allclose(found[6:11], [3, 1, 0.999, 0.998, -1], atol=1e-4)


def test_the_beams_of_shuffled_scans_are_there(shared: Path):
    for pattern, (count, _) in REAL.items():
        for points in real(shared, pattern, most=count):
            order = np.random.default_rng(0).permutation(len(points.xyz))
            found = other_sensor([Points(points.xyz[order])], SENSORS["hdl64e"])
            assert found is None or not found.hopeless


def test_beams_of_the_same_scans_are_found_once():
    points = scan(SENSORS["vlp16"].resized(columns=384), UNORDERED)
    assert find_beams(points) is find_beams(points)
    assert find_beams(points) is not find_beams(replace(points))
