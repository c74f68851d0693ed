"""Normals and losses of images whose surfaces are known."""

import math

import numpy as np
import pytest

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.panel import PANEL, Scan, _drop_incidence, _drop_range, _drop_rate
from r2flow.metrics.surfaces import bridged, normals

SENSOR = SENSORS["hdl64e"].resized(32, 512)
E, A = SENSOR.rays().numpy().astype(np.float64)


def ground(lean_x: float = 0.0) -> np.ndarray:
    """Ranges of the plane z = -1.73 + lean x: r = -1.73 / (sin e - lean cos e cos a)."""
    closing = np.sin(E) - lean_x * np.cos(E) * np.cos(A)
    return np.where(closing < -0.03, -1.73 / np.minimum(closing, -0.03), 0).astype(np.float32)


def scans_of(images: np.ndarray) -> list[Scan]:
    return [Scan(image[0], None, SENSOR, np.zeros((100, 100))) for image in images]


def share(counts, images: np.ndarray) -> np.ndarray:
    """Share of lost rays in each bin, over a set."""
    lost, rays, _ = sum(counts(scan) for scan in scans_of(images))
    return lost / np.maximum(rays, 1)


def inner(r: np.ndarray) -> np.ndarray:
    seen = r > 0
    for by, axis in ((1, 0), (-1, 0), (2, 1), (-2, 1)):
        seen = seen & np.roll(r > 0, by, axis)
    seen[[0, -1]] = False
    return seen


@pytest.mark.parametrize("lean", [0.0, 0.2])
def test_the_normal_of_the_ground_leans_as_it_does_and_its_incidence_is_the_angle_to_it(lean):
    r, upright = ground(lean), math.cos(math.atan(lean))
    up, cosine = normals(r, SENSOR)
    near = inner(r) & (r < 7)  # farther away rows lie more than 15 % apart
    assert near.sum() > 1000
    np.testing.assert_allclose(up[near], upright, atol=1e-3)
    np.testing.assert_allclose(
        cosine[near], (lean * np.cos(E) * np.cos(A) - np.sin(E))[near] * upright, atol=1e-3
    )
    assert np.isnan(up[r == 0]).all()


def test_the_normal_of_a_wall_is_level_and_its_incidence_is_the_angle_to_it():
    ahead = np.abs(A) < 0.6
    r = np.where(ahead, 10 / (np.cos(E) * np.where(ahead, np.cos(A), 1)), 0).astype(np.float32)
    up, cosine = normals(r, SENSOR)
    on = inner(r)
    np.testing.assert_allclose(up[on], 0, atol=1e-3)
    np.testing.assert_allclose(cosine[on], (np.cos(E) * np.cos(A))[on], atol=1e-3)


def test_edges_have_no_normal():
    r = np.full(SENSOR.shape, 10, np.float32)
    r[:, 256:] = 20
    up, _ = normals(r, SENSOR)
    assert np.isnan(up[:, 254:258]).all()
    assert np.isfinite(up[1:-1, 4:254]).all()


def test_gaps_are_bridged_by_the_mean_of_their_ends_around_the_ring():
    x = np.array([[1.0, 0, 0, 4, 5, 0, 0, 0]])
    np.testing.assert_array_equal(
        bridged(x, x > 0, gap=2), [[1, 2.5, 2.5, 4, 5, np.nan, np.nan, np.nan]]
    )
    # between 5 and, around, 1
    np.testing.assert_array_equal(bridged(x, x > 0, gap=3)[0, 5:], [3, 3, 3])
    for width in (2, 8, 16, 25):  # of narrow images too
        x = np.zeros((1, width))
        assert np.isnan(bridged(x, x > 0)).all()
        x[0, 1] = 3
        np.testing.assert_array_equal(bridged(x, x > 0, gap=width), np.full((1, width), 3))


def test_the_drop_rate_is_the_share_that_a_mask_takes():
    rng = np.random.default_rng(0)
    near, far = 5.0, 50.0
    r = np.where(np.arange(512) < 256, near, far) * np.ones((4, *SENSOR.shape))
    lost = rng.random(r.shape) < np.where(r == near, 0.05, 0.25)
    rate = share(_drop_range, np.where(lost, 0, r)[:, None].astype(np.float32))
    bin_of = np.searchsorted(np.geomspace(3, 80, 13), [near, far]) - 1
    # deviations of 32,768 draws: 0.0012 and 0.0024
    assert rate[bin_of] == pytest.approx([0.05, 0.25], abs=0.01)
    # between them there are but gaps across the edge, at 27.5 m: nothing that is not lost
    assert rate.sum() == pytest.approx(0.05 + 0.25 + 1, abs=0.01)
    counts = _drop_rate(
        np.array([1.0, 2, 3, np.nan]), np.array([True, False, True, True]), np.array([0.0, 2.5, 5])
    )
    np.testing.assert_array_equal(counts, [[1, 1], [2, 1], [4, 4]])


def test_losses_on_flat_ground_fall_into_the_bins_of_its_elevations():
    r = ground()
    rng = np.random.default_rng(1)
    images = np.stack([np.where(rng.random(r.shape) < 0.02, 0, r)[None] for _ in range(8)]).astype(
        np.float32
    )
    # bins of 9 degrees, from 90 down: 63 to 90 is what -27 to 0 looks like
    rate = share(_drop_incidence, images)
    assert (rate[3:] == 0).all()
    assert rate[1] == pytest.approx(0.02, abs=0.01)
    upward = sum(PANEL["surface normals"].counts(scan) for scan in scans_of(images))
    assert upward[-1] == upward.sum()
