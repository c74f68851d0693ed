"""Simulated scans: a pure function of (sensor, seed, index), within the sensor's limits, of all
kinds.
"""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from r2flow.base.noise import generator
from r2flow.lidar.labels import LABELS
from r2flow.lidar.sensors import SENSORS, Sensor, build_sensor
from r2flow.simulator import draw_scene, simulate
from r2flow.simulator.scene import BODY, FACADE
from r2flow.simulator.shapes import Boxes, Cylinders, Frusta
from tests.conftest import ROOT

HDL64E = SENSORS["hdl64e"]
SMALL = HDL64E.resized(32, 256)
SENSORS_SEEN = [
    *(sensor for _, sensor in SENSORS.items()),
    SMALL,
    build_sensor("hdl64e", max_range=20.0),
]


@pytest.fixture(scope="module")
def scans():
    return [simulate(HDL64E, seed=3, index=index) for index in range(40)]


@pytest.mark.parametrize(("seed", "index"), [(77, 291), *((0, index) for index in range(24))])
def test_streets_join_and_objects_stand_apart_and_off_the_carriageways(seed, index):
    scene = draw_scene(generator(seed, "simulator", index))
    first, *others = scene.ground.streets
    for other in others:
        ends = [other.place(u, 0.0)[:2] for u in (other.start, other.stop) if abs(u) < 1e5]
        assert all(
            abs(first.locate(*end)[1]) < first.half_width for end in ends
        )  # where it joins the first
    inside, blocks, posts = np.mgrid[-0.45:0.45:19j, -0.45:0.45:19j].reshape(2, -1), [], []
    for solid, surface in scene.tables:
        named = {name: surface.label == LABELS[name] for name in ("vegetation", "pole", "trunk")}
        if isinstance(
            solid, Boxes
        ):  # a hedge across a junction once held the sensor: a scan without a return
            posts += [*np.stack(solid[:2], 1)[named["vegetation"]]]
            blocks += [
                *np.stack(solid[:5], 1)[
                    (surface.pattern == FACADE) & (solid.length * solid.width > 20)
                ]
            ]
        elif isinstance(solid, Frusta):
            blocks += [
                *np.stack(solid[:5], 1)[
                    (surface.pattern == BODY) & (np.abs(solid.front - 0.12) < 1e-3)
                ]
            ]
        elif isinstance(solid, Cylinders):
            thin = np.stack(solid[:2], 1)[named["pole"] | named["trunk"]]
            posts += [*thin]
            blocks += [*np.pad(thin, ((0, 0), (0, 3)))]
    assert all(scene.ground.off_street(float(x), float(y)) > -1e-3 for x, y in posts)
    x, y, yaw, length, width = np.stack(blocks, 1)[..., None]
    u, v = inside[0] * length, inside[1] * width
    u, v = x + u * np.cos(yaw) - v * np.sin(yaw), y + u * np.sin(yaw) + v * np.cos(yaw)
    for k, (x, y, yaw, length, width) in enumerate(blocks):
        c, s, others = np.cos(yaw), np.sin(yaw), np.arange(len(blocks)) != k
        along, across = ((u - x) * c + (v - y) * s)[others], ((v - y) * c - (u - x) * s)[others]
        assert not ((abs(along) < 0.49 * length) & (abs(across) < 0.49 * width)).any()


def digests() -> list[str]:
    views = [
        (HDL64E.resized(32, 512), 3),
        (SENSORS["os1_64"].resized(32, 256), 2),
        (SENSORS["vlp16"], 1),
    ]
    return [digest(sensor, 7, k) for sensor, count in views for k in range(count)]


def digest(sensor: Sensor, seed: int, index: int) -> str:
    scan = simulate(sensor, seed, index)
    return hashlib.sha256(scan.image.tobytes() + scan.labels.tobytes()).hexdigest()


def test_the_same_seed_and_index_give_the_same_scan_in_any_order():
    first = [digest(SMALL, 7, index) for index in range(4)]
    assert first == [digest(SMALL, 7, index) for index in reversed(range(4))][::-1]
    assert (
        len({*first, digest(SMALL, 77, 964)}) == 5
    )  # with a ray that only touches a round surface


def test_other_instructions_and_threads_draw_the_same_scans():
    # numpy and the C library choose among implementations of sine and its like by what the
    # processor can do; with all that is newer than the least forbidden, this machine stands for an
    # old one.
    core = (np._core if hasattr(np, "_core") else np.core)._multiarray_umath
    newer = [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]
    there = subprocess.run(
        [
            sys.executable, "-c",
            "from tests.simulator.test_simulate import digests; print(*digests())",
        ],
        capture_output=True, text=True, check=True, cwd=ROOT,
        env={
            **os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(newer), "OMP_NUM_THREADS": "4",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
        },
    )  # fmt: skip
    assert there.stdout.split() == digests()


def test_the_scene_is_drawn_before_anything_of_the_sensor():
    # An image of a quarter of the columns shows the same large things at the same places.
    fine, coarse = simulate("hdl64e", 5, 2), simulate(HDL64E.resized(64, 256), 5, 2)
    for row in range(20, 44, 4):
        block = fine.image[0, row].reshape(256, 4)
        both = (block > 0).all(1) & (coarse.image[0, row] > 0)
        assert np.mean(np.abs(np.median(block, 1) - coarse.image[0, row])[both] < 0.2) > 0.7


@pytest.mark.parametrize(
    "sensor", SENSORS_SEEN, ids=lambda s: f"{s.name}-{s.shape[0]}-{s.max_range:g}"
)
def test_images_are_within_the_sensors_limits(sensor: Sensor):
    scan = simulate(sensor, 0, 0)
    r, reflectance = scan.image
    assert scan.image.shape == (2, *sensor.shape)
    assert scan.labels.shape == sensor.shape
    assert scan.image.dtype == np.float32
    assert scan.labels.dtype == np.uint16
    seen = r > 0
    assert 0.2 < seen.mean() < 1
    assert r[seen].min() >= sensor.min_range
    assert r.max() <= sensor.max_range
    assert reflectance.min() >= 0
    assert reflectance.max() <= 1
    assert (reflectance[~seen] == 0).all()
    np.testing.assert_array_equal(scan.labels == 0, ~seen)
    assert set(np.unique(scan.labels)) <= {0, *LABELS.values()}


def test_every_kind_of_object_appears(scans):
    for names in (
        "road", "sidewalk", "terrain", "building", "car", "moving-car",
        "truck moving-truck",
        "pole", "traffic-sign", "fence", "vegetation", "trunk", "person moving-person", "lane-marking",
    ):  # fmt: skip
        wanted = [LABELS[name] for name in names.split()]
        assert sum(int(np.isin(scan.labels, wanted).sum()) for scan in scans) > 50, names


def test_the_road_passes_below_the_sensor_at_its_height(scans):
    e, a = HDL64E.rays().numpy().astype(float)
    for index, scan in enumerate(scans[:12]):
        drop = draw_scene(
            generator(3, "simulator", index)
        ).ground.drop  # cars stand higher or lower by their load
        road = (scan.labels == LABELS["road"]) & (scan.image[0] < 10)
        r, e_, a_ = scan.image[0][road], e[road], a[road]
        x, y, z = r * np.cos(e_) * np.cos(a_), r * np.cos(e_) * np.sin(a_), r * np.sin(e_)
        height = np.linalg.lstsq(np.stack([np.ones_like(x), x, y], 1), z, rcond=None)[0][0]
        # a return lies within half a row of its ray: 0.22 degrees of 8 metres is 3 cm; waves add a
        # few more
        assert abs(height + HDL64E.height + drop) < 0.12


def test_the_own_car_hides_the_lowest_rows(scans):
    assert np.mean([scan.image[0, -1] > 0 for scan in scans]) < 0.05
