"""States of rays, masks and interpolation."""

import math

import numpy as np
import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.generators.surroundings import nearest_returns
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray, parse_mask, ray_states, sector_columns
from r2flow.lidar.sensors import SENSORS
from tests.conftest import ground, refused

SENSOR = SENSORS["hdl64e"].resized(16, 64)
SHAPE = SENSOR.shape
WHOLE = np.ones(SHAPE, dtype=bool)


def draws(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_ray_is_never_empty_because_it_was_not_measured():
    images = torch.tensor([5.0, 0, 0, 0, 0, 0, 0, 0]).reshape(1, 2, 2, 2)
    measured = torch.tensor([[1, 1], [0, 1]])  # of any type
    with pytest.raises(InputError, match=r"measured is \(1, 2\), images \(1, 2, 2, 2\)"):
        ray_states(images, measured[:1])  # which would be repeated
    assert ray_states(images, measured).tolist() == [
        [[Ray.RETURN, Ray.EMPTY], [Ray.UNKNOWN, Ray.EMPTY]]
    ]
    assert ray_states(images).tolist() == [[[1, 2], [2, 2]]]  # numbers that callers store


def test_masks_measure_what_they_say():
    assert np.flatnonzero(parse_mask("rows:4")(WHOLE, draws()).all(1)).tolist() == [0, 4, 8, 12]
    assert np.flatnonzero(parse_mask("rows:4,2")(WHOLE, draws()).any(1)).tolist() == [2, 6, 10, 14]
    assert np.flatnonzero(parse_mask("rows:4,6")(WHOLE, draws()).any(1)).tolist() == [6, 10, 14]
    rows = parse_mask("random:0.5")(WHOLE, draws())
    assert rows.all(1).sum() == rows.any(1).sum() == 8
    assert parse_mask("points:0.1")(WHOLE, draws()).sum() == round(0.1 * math.prod(SHAPE))
    measured = (
        np.isin(np.arange(16), range(1, 16, 3))[:, None] & WHOLE
    )  # five beams, in rows 1, 4, 7, 10 and 13
    assert np.flatnonzero(parse_mask("rows:2")(measured, draws()).all(1)).tolist() == [1, 7, 13]
    assert (parse_mask("random:0.4")(measured, draws()) & measured).any(1).sum() == 2
    assert np.flatnonzero(~parse_mask("sector:-45,45")(WHOLE, draws()).any(0)).tolist() == [
        *range(24, 40)
    ]  # ahead
    assert parse_mask("rows:4+sector:-45,45")(WHOLE, draws()).sum() == 4 * 48


@pytest.mark.parametrize("text", [
    "row:4", "rows:0", "rows:4,-1", "rows:nan", "rows", "random:1.5", "sector:5", "sector:5,5", "sector:nan,5", "a.npy",
])  # fmt: skip
def test_what_is_no_mask_is_one_line(text):
    with refused(text.partition(",")[0].partition(":")[0]):
        parse_mask(text)(WHOLE, draws())


def test_a_mask_from_a_file_has_the_size_of_the_scans(tmp_path):
    np.save(tmp_path / "mask.npy", np.eye(16, 64, dtype=np.uint8))
    assert (
        parse_mask(str(tmp_path / "mask.npy"))(WHOLE, draws()) == np.eye(16, 64, dtype=bool)
    ).all()
    with pytest.raises(InputError, match="16, 64"):
        parse_mask(str((tmp_path / "mask.npy").rename(tmp_path / "mask.NPY")))(WHOLE[:8], draws())
    for other in (np.full((16, 64), 0.5), np.ones((1, 2, 2), bool), np.full((2, 2), None)):
        np.save(tmp_path / "other.npy", other)
        with pytest.raises(InputError, match=r"other\.npy"):
            parse_mask(str(tmp_path / "other.npy"))


@pytest.mark.parametrize("rule", ["nearest", "linear", "inverse"])
def test_interpolation_keeps_what_is_measured_and_fills_the_rest(rule):
    image = ground(SENSOR)
    measured = parse_mask("points:0.3")(WHOLE, draws())
    found = interpolated(np.where(measured, image, 7), measured, rule)
    assert (found[:, measured] == image[:, measured]).all()
    assert ((found[0] > 0) == (image[0] > 0)).mean() > 0.9
    assert np.allclose(found[1][found[0] > 0], 0.3)
    assert not interpolated(
        image, np.zeros(SHAPE, dtype=bool), rule
    ).any()  # nothing is guessed from nothing
    line = np.float32([4, 0, 0, 0, 0, 0, 8]).reshape(1, 7, 1)  # in its middle a ray came back empty
    assert (interpolated(line, np.c_[:7] % 3 == 0, rule)[0, :, 0] > 0).tolist() == [
        1,
        1,
        0,
        0,
        0,
        1,
        1,
    ]


@pytest.mark.parametrize("rule", ["linear", "inverse"])
def test_interpolation_follows_columns_and_then_the_ring(rule):
    """Against numpy.interp, where every ray returns: between the known rows of a column, else
    around its row.
    """
    random = draws(3)
    image = np.stack([random.uniform(2, 80, SHAPE), random.random(SHAPE)]).astype(np.float32)
    measured = parse_mask("random:0.5+sector:150,-150")(WHOLE, draws(4))
    expected = image.astype(np.float64) * measured
    if rule == "inverse":
        expected[0] = np.where(measured, 1 / image[0], 0)
    rows = np.flatnonzero(measured.any(1))
    inner, columns = np.arange(rows[0], rows[-1] + 1), np.flatnonzero(measured.any(0))
    for channel in expected:
        for w in columns:
            channel[inner, w] = np.interp(inner, rows, channel[rows, w])
        for h in inner:
            channel[h] = np.interp(np.arange(64), columns, channel[h, columns], period=64)
    if rule == "inverse":
        expected[0, inner] = 1 / expected[0, inner]
    found = interpolated(image, measured, rule)
    assert np.allclose(found[:, inner], expected[:, inner], rtol=1e-5, atol=1e-5)
    assert (
        found[:, : rows[0]] == found[:, rows[:1]]
    ).all()  # rows beyond the known ones are the nearest one's
    assert (found[:, rows[-1] :] == found[:, rows[-1:]]).all()


STEPS = torch.tensor([[0.8, 0.35], [0.3, 0.5]])


def by_search(returned: np.ndarray, steps: np.ndarray, ring: bool) -> np.ndarray:
    """The least angle to a return in each of the four quarters, (4, H, W), of all pairs of pixels."""
    i, j = np.nonzero(returned)
    if ring:
        i, j = np.tile(i, 3), np.concatenate([j + turn * returned.shape[1] for turn in (-1, 0, 1)])
    row, column = np.indices(returned.shape)[..., None]
    down, aside = i - row, j - column
    apart = np.hypot(down * steps[0], aside * steps[1])
    quarters = (
        (down < 0) & (abs(aside) <= -down), (down > 0) & (aside**2 <= down**2),
        (aside < 0) & (abs(down) <= -aside), (aside > 0) & (down**2 <= aside**2),
    )  # fmt: skip
    return np.stack(
        [np.where(inside, apart, np.inf).min(-1, initial=np.inf) for inside in quarters]
    )


@pytest.mark.parametrize("ring", [True, False])
@pytest.mark.parametrize("share", [0, 0.02, 0.2, 0.6])
def test_the_nearest_return_of_each_quarter_is_that_of_a_search(share, ring):
    returned = torch.rand(2, 9, 16, generator=torch.Generator().manual_seed(3)) < share
    found = nearest_returns(returned, STEPS, ring)
    apart = torch.linalg.vector_norm(found * STEPS.T[None, :, :, None, None], dim=1)
    for image in range(2):
        assert np.allclose(
            apart[:, image],
            by_search(returned[image].numpy(), STEPS[image].numpy(), ring),
            rtol=1e-5,
        )
    # Offsets lead to returns, on the side that is asked for.
    there = found.isfinite().all(1)
    down, aside = torch.where(there[:, None], found, 0).long().unbind(1)
    row, column = torch.arange(9)[:, None] + down, (torch.arange(16) + aside) % 16
    hit = returned[torch.arange(2)[None, :, None, None].expand_as(row), row, column]
    assert (hit & torch.stack([down[0] < 0, down[1] > 0, aside[2] < 0, aside[3] > 0]))[there].all()


@pytest.mark.parametrize(
    "sector", [(-45, 45), (135, -135), (0, 90), (-178, 20), (170, 190), (-190, -170), (-90, 89.9)]
)
def test_a_sector_hides_the_columns_that_it_touches(sector):
    hidden = sector_columns(72, *sector)  # columns of 5 degrees
    begin, width = sector[0], (sector[1] - sector[0]) % 360
    for column in range(72):
        # by the definition of a column: it spans the azimuths 180 - 5 w down to 175 - 5 w
        touched = any(
            (180 - 5 * (column + share / 100) - begin) % 360 < width for share in range(1, 100)
        )
        assert hidden[column] == touched


@pytest.mark.parametrize("ends", [(10, 10), (math.nan, 10), (0, 720), (10, 10.0000001)])
def test_impossible_sectors_are_refused(ends):
    with pytest.raises(InputError, match=r"narrower than a column, .* or not within -360 to 360"):
        sector_columns(72, *ends)


def test_sectors_of_a_full_turn_hide_all_columns():
    for turn in [(-180, 180), (180, -180), (0, 360), (360, 0), (0, -360), (-360, 360), (10, -350)]:
        assert sector_columns(72, *turn).all()
