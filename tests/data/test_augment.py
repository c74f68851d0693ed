"""Augmentation: exact where it is geometry, counted where it is chance, and a function of (seed, k)
alone.
"""

import numpy as np
import pytest
import torch

from r2flow.data.augment import Augmentation
from r2flow.data.loader import FlowDataset, ItemFormat
from r2flow.data.sources import InMemory
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points, project
from r2flow.lidar.sensors import SENSORS

SENSOR = SENSORS["hdl64e"].resized(8, 32)
KINDS = {"flip": True, "roll": True}


# Every pixel has a range of its own, so that it can be found again.
IMAGE = np.linspace(2, 70, 8 * 32, dtype=np.float32).reshape(8, 32) * np.array(
    [[[1]], [[0.01]]], np.float32
)
SLOPE = InMemory(IMAGE[None], ["slope"])


def test_half_of_the_scans_are_mirrored():
    flip = Augmentation(flip=True)
    mirrored = 0
    for k in range(200):
        image = flip(IMAGE, 0, k)
        same, mirror = np.array_equal(image, IMAGE), np.array_equal(image, IMAGE[..., ::-1])
        assert same != mirror
        mirrored += mirror
    assert 70 < mirrored < 130  # 200 fair coins: 100 +- 7


def test_a_rolled_image_is_the_image_of_the_turned_scan():
    xyz, reflectance = image_to_points(IMAGE, SENSOR.rays())
    roll = Augmentation(roll=True)
    # the first column is the nearest
    turns = [int(np.argmin(roll(IMAGE, 0, k)[0, 0])) for k in range(400)]
    np.testing.assert_array_equal(roll(IMAGE, 0, 0), np.roll(IMAGE, turns[0], -1))
    a = -2 * np.pi / 32 * turns[0]  # columns count against azimuth
    turned = xyz @ np.float32([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    np.testing.assert_allclose(project(turned, reflectance, SENSOR), roll(IMAGE, 0, 0), rtol=1e-5)
    counts = np.bincount(turns, minlength=32)  # 400 draws of 32 values: 12.5 +- 3.5 each
    assert counts.min() > 0
    assert counts.max() < 30


@pytest.mark.parametrize("kind", KINDS)
def test_switching_one_on_changes_no_other_draw(kind: str):
    assert [bool(Augmentation()), bool(Augmentation(**{kind: KINDS[kind]}))] == [False, True]
    encoding = Encoding(SENSOR)
    item = ItemFormat(encoding, encoding.shape)
    plain = FlowDataset(SLOPE, item, 0, "training")[(7, 0)]
    changed = FlowDataset(SLOPE, item, 0, "training", Augmentation(**{kind: KINDS[kind]}))[(7, 0)]
    assert torch.equal(plain["x_0"], changed["x_0"])
    assert torch.equal(plain["u"], changed["u"])
    # Both together are one, then the other, each with the draws that it has alone.
    image = IMAGE
    for one, value in KINDS.items():
        image = Augmentation(**{one: value})(image, 0, 7)
    np.testing.assert_array_equal(Augmentation(**KINDS)(IMAGE, 0, 7), image)


def test_an_image_depends_on_its_number_alone_and_is_left_as_it_was():
    before = IMAGE.copy()
    augment = Augmentation(**KINDS)
    first = augment(IMAGE, 3, 5)
    augment(IMAGE, 3, 6)
    np.testing.assert_array_equal(augment(IMAGE, 3, 5), first)
    assert not np.array_equal(augment(IMAGE, 4, 5), first)
    np.testing.assert_array_equal(IMAGE, before)
