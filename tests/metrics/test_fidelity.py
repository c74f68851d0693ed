import math

import numpy as np
import pytest
import torch

from r2flow.data.reading import Reading
from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.metrics.fidelity import (
    PANEL,
    PER_PIXEL,
    RUNS,
    controls,
    distances,
    nearest,
    panel,
    run_lengths,
    steps_by_sector,
)
from r2flow.reports.fidelity import compare_sets, load_scans, markdown
from r2flow.reports.fidelity_page import fidelity_page
from r2flow.reports.pages import write_page

SENSOR = SENSORS["hdl64e"].resized(16, 64)


def walls(count: int, seed: int) -> np.ndarray:
    """Scenes of a sort: ground and a wall at a distance of its own."""
    e, a = SENSOR.rays().numpy()
    images = []
    for index in range(count):
        draw = np.random.default_rng(seed * 1000 + index)
        wall = draw.uniform(8, 30) / np.maximum(np.abs(np.cos(a + draw.uniform(0, 3))), 0.05)
        ground = np.where(e < 0, -1.73 / np.sin(np.minimum(e, -1e-3)), np.inf)
        r = np.minimum(wall, ground)
        r = np.where((r < 78) & (draw.random(r.shape) < 0.95), r, 0)
        images.append(np.stack([r, (r > 0) * draw.beta(2, 5, r.shape)]))
    return np.stack(images).astype(np.float32)


def judged(*sets, **options):
    return compare_sets(*sets, **options)[0]


def test_js_distance_of_known_histograms():
    p = np.array([1.0, 1.0, 0.0, 0.0])
    assert js_distance(p, p * 7) == 0
    assert js_distance(p, p[::-1]) == pytest.approx(math.sqrt(math.log(2)))
    # p = (1, 0), q = (1/2, 1/2), m = (3/4, 1/4), by hand.
    expected = math.sqrt((math.log(4 / 3) + 0.5 * math.log(2 / 3) + 0.5 * math.log(2)) / 2)
    assert js_distance(np.array([5, 0]), np.array([3, 3])) == pytest.approx(expected)
    empty = np.zeros(2)
    assert js_distance(empty, np.ones(2)) == pytest.approx(math.sqrt(math.log(2)))
    assert js_distance(empty, empty) == 0


def test_the_bird_s_eye_distance_is_the_reference_s(shared):
    case = torch.load(shared / "oracle" / "bev_metrics.pt", weights_only=False)
    histograms = np.stack([birds_eye_histogram(points) for points in case["point_clouds"].numpy()])
    np.testing.assert_array_equal(histograms, case["hists"].numpy())
    distance = js_distance(histograms[:12].sum(0), histograms[12:].sum(0))
    assert distance == pytest.approx(case["jsd"], rel=1e-4)


def test_a_set_is_at_no_distance_from_itself_and_its_order_does_not_matter():
    images = walls(6, 0)
    d = distances(panel(images, SENSOR), panel(images[::-1], SENSOR))
    assert set(d) == set(PANEL)
    assert d == pytest.approx(dict.fromkeys(PANEL, 0.0), abs=1e-9)


def test_scenes_of_the_same_sort_beat_every_control():
    training = walls(40, 1)
    result = judged(walls(40, 2), walls(40, 3), SENSOR, training)
    # Losses and reflectances are independent from pixel to pixel here, as the shuffled ones are.
    alike = {"changes per row", "run lengths", "drop rate by range", "drop rate by incidence", "reflectance pairs"}
    assert set(result["won"]) >= set(PANEL) - alike
    assert "| gradient, azimuth | **" in markdown(result)
    for name in ("noise", "flat ground", "mean scan"):
        assert all(result["sets"][name][line] > result["sets"]["other"][line] for line in result["won"])


def test_pixels_shuffled_across_scans_have_what_counts_single_pixels():
    training = walls(40, 1)
    truth = panel(training, SENSOR, PANEL | PER_PIXEL)
    shuffled = panel(controls(training, SENSOR, 40)["shuffled pixels"], SENSOR, PANEL | PER_PIXEL)
    other = panel(walls(40, 2), SENSOR, PANEL | PER_PIXEL)
    to_shuffled, to_other = distances(shuffled, truth), distances(other, truth)
    for line in PER_PIXEL:
        assert to_shuffled[line] <= to_other[line] + 0.005
    for line in ("gradient, azimuth", "gradient, elevation", "surface normals", "range pairs", "bird's-eye density"):
        assert to_shuffled[line] > 2 * to_other[line]


@pytest.mark.slow
def test_every_member_tells_real_drives_from_controls_and_no_other_statistic_does(shared):
    sensor, real = SENSORS["hdl64e"], shared / "real"
    raw, odometry = real / "raw" / "2011_09_26", real / "odometry" / "sequences"
    halves = (
        [real / "kitti360", raw / "2011_09_26_drive_0048_sync", odometry / "08"],
        [odometry / "00", raw / "2011_09_26_drive_0005_sync", real / "object"],
    )
    one, other = (np.concatenate([load_scans(path, Reading(sensor))[0] for path in half]) for half in halves)
    result = judged(one, other, sensor, floor=other)
    assert result["blind"] == []
    per_pixel = result["per_pixel"]
    for line in PER_PIXEL:
        nearest_control = min(v[line] for name, v in per_pixel.items() if name not in ("other", "other real scans"))
        assert per_pixel["other real scans"][line] > 0.5 * nearest_control


def test_the_floor_is_what_real_scans_come_to():
    real, other, elsewhere = walls(24, 2), walls(24, 3), walls(24, 4)
    given = judged(real, other, SENSOR, floor=elsewhere)
    assert given["floor_is"] == "other real scans"
    assert given["floor"] == distances(panel(elsewhere, SENSOR), panel(real, SENSOR))
    assert given["beyond"] == [line for line in PANEL if line not in given["blind"]
                               and given["sets"]["other"][line] > 2 * given["floor"][line]]  # fmt: skip
    # three drives, one of them of three scans, which is left out: the mean over pairs is that of one pair
    drives = ["a"] * 12 + ["b"] * 9 + ["c"] * 3
    split = judged(real, other, SENSOR, drives=drives)
    assert split["floor_is"] == "drive against drive"
    assert split["floor"] == distances(panel(real[:12], SENSOR), panel(real[12:21], SENSOR))
    alone = judged(real, other, SENSOR, drives=["a"] * 24)
    assert alone["floor"] == {}
    assert alone["floor_is"] is None
    assert "No floor" in markdown(alone)


def test_a_member_that_does_not_tell_the_floor_from_controls_judges_nothing():
    real = walls(16, 2)
    rng = np.random.default_rng(0)
    result = judged(real, walls(16, 3), SENSOR, floor=(real * rng.permuted(real > 0, axis=-1)).astype(np.float32))
    assert "run lengths" in result["blind"]
    assert not set(result["blind"]) & {*result["won"], *result["lost"], *result["beyond"]}
    assert "Not judged" in markdown(result)


def test_drives_are_the_folders_of_the_scans(tmp_path):
    for name in ("one/data/0.npy", "one/data/1.npy", "two/data/0.npy"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / name, walls(1, 0)[0])
    images, drives = load_scans(tmp_path, Reading(SENSOR))
    assert drives == [f"{tmp_path}: one/data"] * 2 + [f"{tmp_path}: two/data"]
    assert len(images) == 3


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda x: np.where(x > 0, x, -1), "scan 0 of .*: its range goes down to -1"),
        (lambda x: x * 1000, "millimetres"),
    ],
)
def test_images_that_are_no_scans_are_not_judged(tmp_path, spoil, said):
    images = walls(1, 0)
    images[:, :, 0] = 0
    np.save(tmp_path / "0.npy", spoil(images).astype(np.float32)[0])
    with pytest.raises(InputError, match=said):
        load_scans(tmp_path, Reading(SENSOR))


def test_the_page_holds_the_table_and_is_read_by_compare(tmp_path):
    real, other = walls(8, 2), walls(8, 3)
    result, statistics = compare_sets(real, other, SENSOR, floor=walls(8, 4))
    page = fidelity_page(result, statistics, real, other, SENSOR, "mine", "r2flow report fidelity a b")
    written = {path.name for path in write_page(page, tmp_path)}
    assert written == {"fidelity.png", "fidelity_histograms.png", "fidelity_scans.png", "fidelity.csv",
                       "fidelity.json", "fidelity.md"}  # fmt: skip
    text = (tmp_path / "fidelity.md").read_text("utf-8")
    for words in ("| mine / floor |", "range histogram", "Dropped from the panel"):
        assert words in text


def test_the_controls_are_what_they_say():
    training = walls(20, 1)
    made = controls(training, SENSOR, 30)
    e = SENSOR.rays()[0].numpy()
    flat = made["flat ground"][0, 0]
    seen = flat > 0
    np.testing.assert_allclose(flat[seen], -1.73 / np.sin(e[seen]), rtol=1e-5)
    assert seen[(-1.73 / np.sin(np.minimum(e, -1e-6)) < 80) & (e < 0)].all()
    h, w = 2, 20  # where walls stand before the ground
    values = set(training[:, 0, h, w].tolist())
    assert set(made["shuffled pixels"][:, 0, h, w].tolist()) <= values
    assert len(np.unique(made["shuffled pixels"][:, 0, h, w])) > 5
    assert {len(images) for images in made.values()} == {30}


def test_a_copy_is_seen():
    training = walls(10, 1)
    assert nearest(training[3:5], training, SENSOR) == pytest.approx([0, 0], abs=1e-3)
    assert nearest(walls(3, 9), training, SENSOR).min() > 0.01
    assert nearest(training, training, SENSOR, leave_self=True).min() > 0.01


def test_a_turn_changes_no_run_of_returns():
    images = np.zeros((2, 1, 3, 40), np.float32)
    images[0, 0, 0, 4:17], images[0, 0, 1, 30:], images[0, 0, 1, :5], images[1, 0, 2] = 9, 9, 9, 9
    expected = np.histogram([13, 15, 40], RUNS, weights=[13, 15, 40])[0]
    for by in (0, 7, 20):
        np.testing.assert_array_equal(run_lengths(np.roll(images, by, -1), SENSOR), expected)


def test_mirrored_scans_of_a_car_that_keeps_to_the_right_are_seen():
    e, a = SENSOR.rays().numpy()
    draw = np.random.default_rng(0)
    away = np.where(np.sin(a) > 0, 9, 3)[None] * draw.uniform(0.9, 1.1, (60, 1, 1))  # walls to the left and right
    images = (np.minimum(away / np.maximum(np.abs(np.sin(a)), 0.05), 60) / np.cos(e)).astype(np.float32)[:, None]
    one, other = (steps_by_sector(half, SENSOR) for half in (images[:30], images[30:]))
    mirrored = steps_by_sector(np.roll(images[30:, ..., ::-1], 1, axis=-1), SENSOR)  # about the first column
    np.testing.assert_array_equal(mirrored, other[::-1, ::-1])  # sectors and signs change sides, nothing else
    assert js_distance(one, mirrored) > 5 * js_distance(one, other)


def test_range_alone_leaves_reflectance_out():
    images = walls(4, 0)[:, :1]
    assert "reflectance pairs" not in panel(images, SENSOR)
    result = judged(images, images, SENSOR)
    assert "reflectance pairs" not in result["sets"]["noise"]
    assert "reflectance histogram" not in result["per_pixel"]["noise"]
