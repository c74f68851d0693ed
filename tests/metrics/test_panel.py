"""The panel's statistics of scans that are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.data.sets import ScanSet
from r2flow.evaluation.sets import BASELINES, _Baseline
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics import METRICS
from r2flow.metrics import panel as lines
from r2flow.metrics.jsd_mmd import js_distance
from r2flow.metrics.panel import (
    PANEL,
    RUNS,
    Scan,
    _rate_distance,
    _steps_by_sector,
    distances,
    panel,
)
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import measured

SENSOR = SENSORS["hdl64e"].resized(16, 64)


def walls(count: int, seed: int) -> np.ndarray:
    e, a = SENSOR.rays().numpy()
    images = []
    for index in range(count):
        draw = np.random.default_rng(seed * 1000 + index)
        wall = draw.uniform(8, 30) / np.maximum(np.abs(np.cos(a + draw.uniform(0, 3))), 0.05)
        ground = np.where(e < 0, -1.73 / np.sin(np.minimum(e, -1e-3)), np.inf)
        r = np.minimum(wall, ground)
        r = np.where((r < 62) & (draw.random(r.shape) < 0.95), r, 0)
        images.append(np.stack([r, (r > 0) * draw.beta(2, 5, r.shape)]))
    return np.stack(images).astype(np.float32)


def apart(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    return distances(panel(a, SENSOR), panel(b, SENSOR))


def scan_of(image: np.ndarray) -> Scan:
    return Scan(image[0], None, SENSOR, np.zeros((100, 100)))


def baseline(name: str, training: np.ndarray, num: int, sensor=SENSOR) -> np.ndarray:
    source = _Baseline(name, training, sensor, range(num))
    return np.stack([source[i] for i in range(num)])


def test_the_histograms_are_numpy_s_and_every_member_has_its_size():
    r, q = walls(1, 0)[0]
    scan = Scan(r, q, SENSOR, np.zeros((100, 100)))
    up, cosine = scan.surfaces
    above = (r[1:] > 0) & (r[:-1] > 0)
    edges = np.geomspace(SENSOR.min_range, SENSOR.max_range, 17)
    aside = (r > 0) & (np.roll(r, -1, -1) > 0)
    pairs = [[x[aside], np.roll(x, -1, -1)[aside]] for x in (r, q)]
    expected = {
        "gradient, elevation": np.histogram(np.abs(r[1:] - r[:-1])[above], lines.GRADIENTS)[0],
        "surface normals": np.histogram(up[np.isfinite(up)], lines.NORMALS)[0],
        "incidence": np.histogram(cosine[np.isfinite(cosine)], lines.COSINES)[0],
        "range pairs": np.histogram2d(*pairs[0], [edges, edges])[0],
        "reflectance pairs": np.histogram2d(*pairs[1], [lines.REFLECTANCES] * 2)[0],
    }
    for name, member in PANEL.items():
        counts = member.counts(scan).ravel()
        assert counts.size == member.size, name
        np.testing.assert_array_equal(counts, expected.get(name, counts).ravel(), err_msg=name)
    # of 1024 rows
    assert (lines._changes_row(scan_of(np.indices((1030, 64)).sum(0)[None] % 2))[:2] == 64).all()


def test_the_metric_has_the_distances_of_the_sets_and_their_mean():
    real, other = walls(5, 1), walls(7, 2)
    expected = apart(real, other)
    figures = measured(
        METRICS["panel"](), *(Scans(torch.from_numpy(x), SENSOR) for x in (real, other))
    ).compute()
    assert figures.pop("panel") == pytest.approx(np.mean(list(expected.values())))
    assert figures == pytest.approx(expected)
    # of LiDM: the same scans have the same counts
    limits = replace(SENSOR, min_range=1.0, max_range=56.0)
    np.testing.assert_array_equal(panel(real, limits), panel(real, SENSOR))


def test_scenes_of_the_same_sort_are_nearer_than_every_baseline():
    training, real, other = walls(40, 1), walls(40, 2), walls(40, 3)
    d = apart(other, real)
    far = {name: apart(baseline(name, training, 40), real) for name in BASELINES}
    # Losses and reflectances are independent from pixel to pixel here, as the shuffled ones are.
    alike = {
        "changes per row",
        "run lengths",
        "drop rate by range",
        "drop rate by incidence",
        "reflectance pairs",
    }
    for line in set(PANEL) - alike:
        assert d[line] < min(found[line] for found in far.values()), line


@pytest.mark.slow
def test_every_member_tells_real_drives_from_baselines(shared):
    sensor, real = SENSORS["hdl64e"], shared / "real"
    raw, odometry = real / "raw" / "2011_09_26", real / "odometry" / "sequences"
    halves = (
        [real / "kitti360", raw / "2011_09_26_drive_0048_sync", odometry / "08"],
        [odometry / "00", raw / "2011_09_26_drive_0005_sync", real / "object"],
    )

    def read(path) -> np.ndarray:
        scans: ScanSet = open_scans(path, Reading(sensor))
        return np.stack([scans.source[i] for i in range(len(scans))])

    one, other = (np.concatenate([read(path) for path in half]) for half in halves)
    truth = panel(one, sensor)
    d = distances(truth, panel(other, sensor))
    for name in BASELINES:
        made = distances(truth, panel(baseline(name, one, len(other), sensor), sensor))
        for line in PANEL:
            assert d[line] < 0.5 * made[line], (name, line)


def test_a_turn_changes_no_run_of_returns():
    images = np.zeros((2, 1, 3, 40), np.float32)
    images[0, 0, 0, 4:17], images[0, 0, 1, 30:], images[0, 0, 1, :5], images[1, 0, 2] = 9, 9, 9, 9
    expected = np.histogram([13, 15, 40], RUNS, weights=[13, 15, 40])[0]
    for by in (0, 7, 20):
        counts = sum(
            PANEL["run lengths"].counts(scan_of(image)) for image in np.roll(images, by, -1)
        )
        np.testing.assert_array_equal(counts, expected)


def test_mirrored_scans_of_a_car_that_keeps_to_the_right_are_seen():
    e, a = SENSOR.rays().numpy()
    draw = np.random.default_rng(0)
    # walls to the left and right
    away = np.where(np.sin(a) > 0, 9, 3)[None] * draw.uniform(0.9, 1.1, (60, 1, 1))
    images = (np.minimum(away / np.maximum(np.abs(np.sin(a)), 0.05), 60) / np.cos(e)).astype(
        np.float32
    )[:, None]

    def steps(scans: np.ndarray) -> np.ndarray:
        return sum(_steps_by_sector(scan_of(image)) for image in scans)

    one, other = steps(images[:30]), steps(images[30:])
    mirrored = steps(np.roll(images[30:, ..., ::-1], 1, axis=-1))  # about the first column
    # sectors and signs change sides, nothing else
    np.testing.assert_array_equal(mirrored, other[::-1, ::-1])
    assert js_distance(one, mirrored) > 5 * js_distance(one, other)


def test_a_set_without_surfaces_is_not_near_in_the_drop_rate():
    draw, real = np.random.default_rng(0), walls(20, 1)
    lossy = real * (draw.random((20, 1, *SENSOR.shape)) > 0.05)
    random = (real > 0) * draw.uniform([[[2]], [[0]]], [[[60]], [[1]]], real.shape).astype(
        np.float32
    )
    found = [
        apart(images, real)["drop rate by incidence"] for images in (real, lossy, random, 0 * real)
    ]
    assert found[0] == 0 < found[1] < 0.2
    assert found[3] == 1 > found[2] > 0.8
    counts = np.array([[1, 18], [10, 90], [200, 200]])  # missing, all, of the image
    for rates, expected in (
        ([[2, 9], [10, 90]], 0.1),
        ([[2, 0], [10, 0]], 0.9),
        ([[1, 0], [10, 0.5]], 0.4),
    ):
        other = np.array([*rates, [200, 200]])
        assert (
            _rate_distance(counts, other)
            == _rate_distance(other, counts)
            == pytest.approx(expected)
        )
    # of two rows
    lines = distances(
        *(panel(x[:, :, 9:11], SENSORS["vlp16"].resized(2, 64)) for x in (real, lossy))
    )
    assert {*filter(lambda x: np.isnan(lines[x]), lines)} == {
        "surface normals",
        "incidence",
        "drop rate by incidence",
    }


def test_range_alone_leaves_reflectance_out():
    images = walls(4, 0)
    metric = measured(
        METRICS["panel"](), *(Scans(torch.from_numpy(x), SENSOR) for x in (images, images[:, :1]))
    )
    assert np.isnan(metric.compute()["reflectance pairs"])
    assert metric.compute()["panel"] == pytest.approx(0, abs=1e-9)
    assert any("no reflectance" in remark for remark in metric.remarks)


def test_the_baselines_are_what_they_say():
    training = walls(20, 1)
    e = SENSOR.rays()[0].numpy()
    flat = baseline("flat ground", training, 1)[0, 0]
    np.testing.assert_allclose(flat[flat > 0], -1.73 / np.sin(e[flat > 0]), rtol=1e-5)
    assert (flat > 0)[(-1.73 / np.sin(np.minimum(e, -1e-6)) < 80) & (e < 0)].all()
    # where walls stand before the ground
    shuffled = baseline("shuffled pixels", training, 30)[:, 0, 2, 20]
    assert set(shuffled.tolist()) <= set(training[:, 0, 2, 20].tolist())
    assert len(np.unique(shuffled)) > 5
    mean = baseline("mean scan", training, 1)[0, 0]
    held = (training[:, 0] > 0).mean(0) > 0.5
    np.testing.assert_array_equal(mean > 0, held)
    h, w = np.argwhere(held)[0]
    values = training[:, 0, h, w]
    assert mean[h, w] == pytest.approx(values[values > 0].mean(), rel=1e-5)
