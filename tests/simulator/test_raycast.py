"""Ray casting against geometry."""

import numpy as np
import pytest

from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator.ground import Ground
from r2flow.simulator.lasers import Rays, _along_rows, lasers_of
from r2flow.simulator.raycast import cast
from r2flow.simulator.scene import SceneBuilder
from r2flow.simulator.shapes import Blobs, Boxes, Cylinders, Frusta
from r2flow.simulator.streets import Street

HDL64E = SENSORS["hdl64e"]
HEIGHT = HDL64E.height


def look(*solids, lasers=None):
    """Hits of all rays on a few solids over flat ground far from any street, and r = s / cos e."""
    b = SceneBuilder(np.random.default_rng(0))
    b.ground = Ground((Street(0.0, 1e6, 0.0, 4.0, 2.0),))
    for label, solid in solids:
        b.add(solid, 0.0, label, "concrete")
    rays = Rays(lasers or _along_rows(HDL64E), HDL64E.columns, HEIGHT)
    hits = cast(b.build(), rays, np.random.default_rng(1))
    return hits, hits.distance / np.cos(rays.lasers.elevation)[:, None], rays


def directions(rays):
    """Unit vectors of all rays, (3, B, W), float64."""
    e, a = np.broadcast_arrays(rays.lasers.elevation[:, None], rays.azimuth)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def test_lasers_above_the_origin_see_flat_ground_at_their_own_height():
    lasers = lasers_of(HDL64E)
    hits, _, _ = look(lasers=lasers)
    down = lasers.elevation < -0.05
    exact = -(HEIGHT + lasers.height) / np.tan(lasers.elevation)
    np.testing.assert_allclose(
        hits.distance[down], np.repeat(exact[down, None], HDL64E.columns, 1), rtol=1e-5
    )


@pytest.mark.parametrize(
    ("centre", "radius"), [((9.0, 4.0, 1.2), 1.1), ((0.3, 0.2, -0.05), 1.5)]
)  # ahead, below
def test_a_sphere_is_met_at_the_root_of_its_quadratic(centre, radius):
    hits, r, rays = look(("person", Blobs(*centre, radius, radius, 0.0)))
    d = directions(rays)
    c = np.subtract(centre, [0, 0, HEIGHT])
    along = np.tensordot(c, d, 1)
    root = radius**2 - (c @ c - along**2)
    exact = along - np.sqrt(np.where(root > 0, root, np.nan))
    on = hits.label == LABELS["person"]
    clear = root > 1e-3
    assert clear.sum() > 500
    assert on[clear & (along > 0)].mean() == 1
    np.testing.assert_allclose(r[on], exact[on], atol=2e-3)


def test_an_upright_cylinder_is_met_at_the_near_side_of_the_chord():
    x, y, radius = 7.0, -3.0, 0.4
    hits, _, rays = look(("pole", Cylinders(x, y, radius, -1.0, 6.0)))
    a = np.broadcast_to(rays.azimuth, rays.shape)
    along, across = x * np.cos(a) + y * np.sin(a), y * np.cos(a) - x * np.sin(a)
    exact = along - np.sqrt(np.maximum(radius**2 - across**2, 0))
    on = hits.label == LABELS["pole"]
    assert on.sum() > 100
    np.testing.assert_allclose(hits.distance[on], exact[on], atol=2e-3)


@pytest.mark.parametrize("shape", [Boxes, Frusta])
def test_the_face_of_a_turned_box_is_met_in_its_plane(shape):
    yaw, length, width = 0.6, 4.0, 2.0
    middle = np.array([8.0, 5.0])
    lean = (0.0, 0.0, 0.0) if shape is Frusta else ()
    hits, _, rays = look(("car", shape(*middle, yaw, length, width, 0.0, 5.0, *lean)))
    on = np.argwhere(hits.label == LABELS["car"])
    assert len(on) > 200
    s = hits.distance[tuple(on.T)].astype(float)
    a, z = rays.azimuth[on[:, 1]], HEIGHT + s * np.tan(rays.lasers.elevation[on[:, 0]])
    p = np.stack([s * np.cos(a), s * np.sin(a)]) - middle[:, None]
    u, v = p[0] * np.cos(yaw) + p[1] * np.sin(yaw), p[1] * np.cos(yaw) - p[0] * np.sin(yaw)
    outside = np.max([np.abs(u) - length / 2, np.abs(v) - width / 2, z - 5.0, -z], axis=0)
    np.testing.assert_allclose(outside, 0, atol=2e-3)


def test_a_leaning_windscreen_is_met_in_its_plane():
    hits, _, rays = look(("car", Frusta(10.0, 0.0, np.pi, 4.0, 4.0, 0.0, 2.0, 0.5, 0.0, 0.0)))
    w = HDL64E.columns // 2
    rows = np.flatnonzero(hits.label[:, w] == LABELS["car"])
    z = HEIGHT + hits.distance[rows, w] * np.tan(rays.lasers.elevation[rows])
    # its front looks at the sensor: at x = 8 on the ground, half a metre farther for each metre of
    # height
    leaning = z < 2 - 1e-3
    np.testing.assert_allclose(hits.distance[rows, w][leaning], 8 + 0.5 * z[leaning], atol=0.02)


def test_the_nearest_of_many_overlapping_solids_is_met():
    places = {"car": 5.0, "truck": 6.0, "fence": 7.0, "building": 9.0, "trunk": 14.0}
    solids = [
        (name, Boxes(x, 0.5 * (x - 5), 0.2 * x, 1.5, 1.0, 0.0, 2.0)) for name, x in places.items()
    ]
    together, _, _ = look(*solids)
    alone = [look(one)[0] for one in solids]
    distances = np.stack([hits.distance for hits in alone])
    np.testing.assert_array_equal(together.distance, distances.min(0))
    nearest = np.choose(distances.argmin(0), [hits.label for hits in alone])
    np.testing.assert_array_equal(together.label, nearest)
    assert {LABELS[name] for name in places} <= set(np.unique(nearest).tolist())


def test_the_share_of_pulses_through_leaves_is_exponential_in_their_path():
    radius, path = 2.0, 1.5
    hits, _, rays = look(("vegetation", Blobs(15.0, 0.0, 1.7, radius, radius, path)))
    d, c = directions(rays), np.array([15.0, 0.0, 1.7 - HEIGHT])
    root = radius**2 - (c @ c - np.tensordot(c, d, 1) ** 2)
    inner = (root > 0.9 * radius**2) & (np.tensordot(c, d, 1) > 0)
    chord = 2 * np.sqrt(root[inner])
    expected = 1 - np.exp(-chord / path).mean()
    share = (hits.label[inner] == LABELS["vegetation"]).mean()
    assert share == pytest.approx(expected, abs=4 * np.sqrt(0.25 / inner.sum()))


def test_walls_seen_face_on_have_cosine_one_and_grazed_ground_sin_e():
    wall, disc = Boxes(10.0, 0.0, 0.0, 1.0, 40.0, -1.0, 9.0), Cylinders(-6.0, 0.0, 2.0, -0.5, 0.01)
    hits, _, rays = look(("building", wall), ("pole", disc))
    e = rays.lasers.elevation
    wall = hits.label[:, 512] == LABELS["building"]  # ahead
    np.testing.assert_allclose(hits.cosine[wall, 512], np.cos(e[wall]), atol=1e-4)
    flat = np.isin(hits.label[:, 0], [LABELS["terrain"], LABELS["pole"]]) & (e < -0.05)
    np.testing.assert_allclose(hits.cosine[flat, 0], np.sin(-e[flat]), atol=1e-4)
