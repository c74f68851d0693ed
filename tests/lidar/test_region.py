import math

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.lidar.region import Region, region
from r2flow.lidar.sensors import SENSORS

SENSOR = SENSORS["hdl64e"].resized(16, 72)  # columns of 5 degrees


@pytest.mark.parametrize(
    "sector", [(-45, 45), (135, -135), (0, 90), (-178, 20), (170, 190), (-190, -170), (-90, 89.9)]
)
def test_the_columns_are_those_that_the_sector_touches_from_left_to_right(sector):
    columns = region(SENSOR.shape, sector).columns
    assert (columns.diff() % 72 == 1).all()  # through the seam
    begin, width = sector[0], (sector[1] - sector[0]) % 360
    for column in range(72):
        # by the definition of a column: it spans the azimuths 180 - 5 w down to 175 - 5 w
        touched = any(
            (180 - 5 * (column + share / 100) - begin) % 360 < width for share in range(1, 100)
        )
        assert (column in columns) == touched


def test_rounding_goes_outward_to_whole_units():
    part = Region((16, 72), 3, 2, 70, 4)  # over the seam
    outer = part.widened((4, 8))
    assert (outer.top, outer.height, outer.left, outer.width) == (0, 8, 64, 16)
    assert set(part.columns.tolist()) <= set(outer.columns.tolist())
    assert outer.widened((4, 8)) == outer
    nearly_all = Region((16, 72), 0, 16, 4, 70).widened((4, 8))
    assert (nearly_all.left, nearly_all.width, nearly_all.share) == (0, 72, 1)
    assert region((16, 360), (-74, -50)) == Region(
        (16, 360), 0, 16, 230, 24
    )  # 180 + 50 and 180 + 74, whole columns


def test_the_whole_image_keeps_its_order():
    turns = [(-180, 180), (180, -180), (0, 360), (360, 0), (0, -360), (-360, 360), (10, -350)]
    for whole in (region((16, 72)), *(region((16, 72), turn, (0, 15)) for turn in turns)):
        assert whole == Region((16, 72), 0, 16, 0, 72)


@pytest.mark.parametrize(
    ("sector", "rows", "words"),
    [
        ((10, 10), None, "narrower than a column"),
        ((math.nan, 10), None, "degrees"),
        ((0, 720), None, "within -360 to 360"),
        (None, (5, 4), "FIRST-LAST within 0-15"),
        (None, (0, 16), "FIRST-LAST within 0-15"),
    ],
)
def test_impossible_regions_are_refused(sector, rows, words):
    with pytest.raises(InputError, match=words):
        region(SENSOR.shape, sector, rows)


def test_a_margin_widens_what_is_generated_and_not_what_is_asked_for():
    shape = (8, 64)
    asked = region(shape, (-45, 45), (0, 3), margin=22.5)
    assert asked.widened((1, 1)) == region(shape, (-67.5, 67.5), (0, 3))
    assert region(shape, (-45, 45), margin=6).margin == 2  # columns of 5.625 degrees
    assert asked.crop(torch.zeros(shape)).shape == (4, 16)
    assert region(shape, (135, -135), margin=45).widened((1, 1)) == region(shape, (90, -90))
    assert region(shape, (-100, 100), margin=90).widened((1, 1)) == region(shape)
