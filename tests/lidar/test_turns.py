"""Turns of the sensor in a file, of beams and azimuths that are known."""

import numpy as np
import pytest

from r2flow.lidar.scan_files import Points, write_points
from r2flow.lidar.turns import turns

DRAW = np.random.default_rng(0)


def fired(count: float, beams: int = 16, steps: int = 900) -> Points:
    """All beams at one azimuth after the other, `count` turns of them."""
    azimuth = 1 + np.repeat(np.arange(round(count * steps)) * 2 * np.pi / steps, beams)
    ring = np.tile(np.arange(beams), len(azimuth) // beams)
    elevation = np.radians(ring * 2.0 - 15)
    r = DRAW.uniform(3, 50, len(ring))
    level = r * np.cos(elevation)
    xyz = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)], 1)
    return Points(xyz.astype(np.float32), None, ring.astype(np.uint16))


def of_order(points: Points, order: np.ndarray, ring: bool = True) -> Points:
    return Points(points.xyz[order], None, points.ring[order] if ring else None)


@pytest.mark.parametrize("count", [0.5, 1, 2, 10])
def test_turns_are_counted_in_any_known_order(count: float):
    points = fired(count)
    ring_by_ring = np.argsort(points.ring, kind="stable")
    backwards = np.arange(len(points.ring))[::-1]
    for order in (np.arange(len(points.ring)), ring_by_ring, backwards):
        assert turns(of_order(points, order)) == pytest.approx(count, abs=0.05)
    assert turns(of_order(points, backwards, ring=False)) == pytest.approx(count, abs=0.05)


def test_orders_that_tell_nothing_are_no_turns():
    points = fired(1)
    ring_by_ring = np.argsort(points.ring, kind="stable")  # without numbers, 16 turns of one beam
    shuffled = DRAW.permutation(len(points.ring))
    assert turns(of_order(points, ring_by_ring, ring=False)) == 0
    assert turns(of_order(points, shuffled)) == 0
    assert turns(Points(np.zeros((5, 3), np.float32), None, np.zeros(5, np.uint16))) == 0


def test_a_file_of_two_turns_is_a_warning(r2flow, tmp_path):
    for count, warned in ((1, False), (2, True)):
        points = fired(count)
        path = tmp_path / str(count) / "a.ply"
        write_points(path, points.xyz, ring=points.ring)
        done = r2flow("sensor", path)
        assert done[0] == 0
        assert ("several turns" in done[2]) == warned
