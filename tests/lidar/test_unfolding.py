import numpy as np
import pytest

from r2flow.data.partial import open_partial
from r2flow.data.reading import Reading, read_projected
from r2flow.errors import InputError
from r2flow.lidar.beams import find_beams, steps_of_a_turn
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import SENSORS, Sensor

FIRED = ["hdl32e", "vlp16", "vlp32c", "os1_64", "pandar64"]


def cloud(sensor: Sensor, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a random image, (W, H, 3), a firing after the other, each from the top; a fifth without return."""
    draw = np.random.default_rng(seed)
    image = draw.uniform(sensor.min_range * 1.01, sensor.max_range * 0.99, sensor.shape).astype(np.float32)
    image *= draw.random(sensor.shape) < 0.8
    e, a = sensor.rays().numpy()
    xyz = np.stack([image * np.cos(e) * np.cos(a), image * np.cos(e) * np.sin(a), image * np.sin(e)])
    return xyz.transpose(2, 1, 0), image


def packet_order(sensor: Sensor, how: str) -> np.ndarray:
    """Row of laser 0, 1, ... of a file."""
    rows = np.arange(len(sensor.elevations))
    firing = rows if sensor.firing is None else np.array(sensor.firing)
    return {"top": rows, "bottom": rows[::-1], "firing": firing}[how]


@pytest.mark.parametrize("how", ["top", "bottom", "firing"])
@pytest.mark.parametrize("name", FIRED)
def test_whole_firings_unfold_whatever_their_order(name, how):
    sensor = SENSORS[name].resized(columns=48)
    firings, image = cloud(sensor)
    xyz = firings[:, packet_order(sensor, how)].reshape(-1, 3)
    np.testing.assert_allclose(project(xyz, None, sensor, "unfolding")[0], image, rtol=1e-6)


def test_scans_whose_lasers_cannot_be_found_are_refused_in_one_line():
    sensor = SENSORS["vlp32c"].resized(columns=64)
    xyz = cloud(sensor)[0][:, np.array(sensor.firing)].reshape(-1, 3)
    with pytest.raises(InputError, match=r"neither ring after ring nor in whole firings of 32.*spherical") as error:
        project(xyz[xyz.any(axis=1)], None, sensor, "unfolding")
    assert "\n" not in str(error.value)
    for ring, words in (
        (np.tile(np.arange(64), 32), r"ring numbers up to 63, but sensor 'vlp32c' has 32 rows"),
        (np.tile(np.arange(32) // 4, 64), r"ring numbers up to 7, but sensor 'vlp32c' has 32 rows"),
        (np.random.default_rng(0).integers(0, 32, 2048), "follow neither the elevations"),
    ):
        with pytest.raises(InputError, match=words):
            project(xyz, None, sensor, "unfolding", ring=ring)


def test_a_real_scan_of_whole_firings(shared):
    # 64 x 2048 in order: the row of a point is its number modulo 64.
    (path,) = (shared / "real" / "other_sensors" / "rellis_os1_64").glob("*.bin")
    xyz = read_points(path).xyz
    sensor = SENSORS["os1_64"].resized(columns=2048)
    r = np.linalg.norm(xyz, axis=1)
    image = project(xyz, r, sensor, "unfolding")
    counted = np.bincount(np.arange(len(xyz))[(r >= 0.8) & (r <= 120)] % 64, minlength=64)
    filled = (image[0] > 0).sum(axis=1)
    assert (filled <= counted).all()
    assert filled.sum() > 0.98 * counted.sum()  # a few share a column with a neighbour
    for row in (5, 20, 40, 63):
        assert set(image[1, row][image[0, row] > 0].tolist()) <= set(r[row::64].astype(np.float32).tolist())


def test_a_real_scan_unfolds_by_ring_and_by_firing_alike(shared):
    (path,) = (shared / "real" / "other_sensors" / "nuscenes_hdl32e").glob("*.bin")
    points = read_points(path)
    by_ring, by_firing = (
        project(points.xyz, None, SENSORS["hdl32e"], "unfolding", ring=ring) for ring in (points.ring, None)
    )
    np.testing.assert_array_equal(by_firing, by_ring)
    # The file counts its rings from the lowest up.
    within = (np.linalg.norm(points.xyz, axis=1) >= 1) & (points.ring == 31)
    assert (by_ring[0, 0] > 0).sum() <= within.sum() < 1.8 * (by_ring[0, 0] > 0).sum()


def test_lost_rays_of_whole_firings_may_be_nan(tmp_path):
    sensor = SENSORS["vlp16"].resized(columns=48)
    firings, image = cloud(sensor)
    xyz = firings[:, packet_order(sensor, "firing")].reshape(-1, 3)
    xyz[~xyz.any(axis=1)] = np.nan
    np.save(tmp_path / "0.npy", xyz)
    found = read_projected(tmp_path / "0.npy", Reading(sensor, "unfolding", reflectance=False))
    np.testing.assert_allclose(found.image[0], image, rtol=1e-6)
    assert find_beams([read_points(tmp_path / "0.npy")]).firing is not None


@pytest.mark.parametrize("missing", [[], [7], [0], [31], [0, 31], [0, 1, 2, 30, 31]])
@pytest.mark.parametrize("how", ["top", "bottom", "firing"])
@pytest.mark.parametrize("first", [0, 1])
def test_ring_numbers_keep_their_rows_whichever_rings_returned(how, first, missing):
    sensor = SENSORS["vlp32c"].resized(columns=48)
    firings, image = cloud(sensor)
    laser, ring = packet_order(sensor, how), np.tile(np.arange(32), 48)
    kept = np.random.default_rng(1).permutation(np.flatnonzero(~np.isin(ring, missing)))
    ring = (ring + first).astype(np.uint16)
    again = project(firings[:, laser].reshape(-1, 3)[kept], None, sensor, "unfolding", ring=ring[kept])
    image[laser[missing]] = 0
    np.testing.assert_allclose(again[0], image, rtol=1e-6)


def test_a_single_ring_lies_where_it_looks():
    sensor = SENSORS["hdl32e"].resized(columns=48)
    firings, image = cloud(sensor)
    again = project(firings[:, 0], None, sensor, "unfolding", ring=np.full(48, 31))  # counted from the lowest up
    np.testing.assert_allclose(again[0, 0], image[0], rtol=1e-6)
    assert not again[0, 1:].any()


@pytest.mark.parametrize("columns", [48, 63, 64, 255])
def test_points_of_an_image_of_any_width_unfold_to_it(columns):
    sensor = SENSORS["vlp16"].resized(columns=columns)
    image = cloud(sensor, 5)[1][None]
    xyz, _ = image_to_points(image, sensor.rays())
    np.testing.assert_allclose(project(xyz, None, sensor, "unfolding")[0], image[0], rtol=1e-6)


def test_lost_rays_leave_every_point_its_beam(tmp_path):
    """Without ring numbers, in no order: rows of NaN are dropped, and are not counted."""
    sensor = SENSORS["vlp16"].resized(columns=480)
    firings, _ = cloud(sensor)
    row = np.tile(np.arange(16), 480)
    mixed = np.random.default_rng(2).permutation(len(row))
    xyz = firings.reshape(-1, 3)[mixed]
    lost = ~xyz.any(axis=1)
    xyz[lost] = np.nan
    np.save(tmp_path / "0.npy", xyz)
    scan = read_points(tmp_path / "0.npy")
    beams = find_beams([scan])
    np.testing.assert_array_equal(beams.of_point[0], row[mixed][~lost])
    assert steps_of_a_turn([scan], beams.of_point) == pytest.approx(480, rel=1e-3)


def test_what_training_reads_can_be_completed(tmp_path):
    """Whole firings whose lost rays are NaN, as a model of unfolded scans has learned them."""
    sensor = SENSORS["vlp16"].resized(columns=48)
    firings, image = cloud(sensor)
    xyz = firings.reshape(-1, 3)
    xyz[~xyz.any(axis=1)] = np.nan
    np.save(tmp_path / "0.npy", xyz)
    (scan,), _ = open_partial([str(tmp_path / "0.npy")], Reading(sensor, "unfolding"), sensor)
    np.testing.assert_allclose(scan.read().image[0], image, rtol=1e-6)
