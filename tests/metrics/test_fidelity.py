import math

import numpy as np
import pytest
import torch

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.metrics.fidelity import PANEL, controls, distances, nearest, panel
from r2flow.reports.fidelity import fidelity, markdown

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
    result = fidelity(walls(40, 2), walls(40, 3), SENSOR, training)
    # Shuffled pixels keep every per-pixel statistic, so only lines that look at neighbours must be won.
    for line in ("gradient, azimuth", "gradient, elevation"):
        assert line in result["won"]
    assert "| gradient, azimuth | **" in markdown(result)
    for name in ("noise", "flat ground", "mean scan"):
        assert all(result["sets"][name][line] > result["sets"]["other"][line] for line in PANEL)


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


def test_range_alone_leaves_reflectance_out():
    images = walls(4, 0)[:, :1]
    assert "reflectance histogram" not in panel(images, SENSOR)
    assert "reflectance histogram" not in fidelity(images, images, SENSOR)["sets"]["noise"]
