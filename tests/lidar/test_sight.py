"""Scans as images in exportable operations are those of NumPy, bit for bit."""

import numpy as np
import pytest
import torch

from r2flow.lidar.other_sensors import points_through, sensor_of
from r2flow.lidar.scan_files import Points, points_in_memory
from r2flow.lidar.sensors import SENSORS
from r2flow.lidar.sight import Sight

SOURCE = SENSORS["vlp16"].resized(columns=300)
SCANS = {
    "whole": lambda rows: rows,
    "two returns of each ray": lambda rows: np.repeat(rows, 2, axis=0),
    "rays without a return at the origin": lambda rows: np.vstack([rows, 0 * rows[:500]]),
    "damaged rows": lambda rows: np.where(np.arange(len(rows))[:, None] % 9, rows, np.nan),
    "without a sector": lambda rows: rows[rows[:, 1] > 0.5],
    "without beams": lambda rows: rows[rows[:, 2] > -0.4],
}


def room() -> np.ndarray:
    """A round wall 0.3 to 115 m away without a return in some directions, (N, 4)."""
    draws = np.random.default_rng(0)
    e, a = SOURCE.rays().double().numpy()
    a = a + draws.normal(0, 2e-4, a.shape)
    r = draws.uniform(0.3, 115, a.shape)
    xyz = r * np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    kept = draws.random(a.shape) > 0.2
    rows = np.concatenate([xyz, draws.random((1, *a.shape))])[:, kept].T
    return rows.astype(np.float32)


@pytest.mark.parametrize("scan", SCANS)
def test_a_scan_is_seen_as_by_numpy(scan):
    rows = SCANS[scan](room())
    target = SENSORS["vlp16"].resized(32, 128)
    points: Points = points_in_memory(rows)
    assert points.reflectance is not None
    expected = points_through(points, sensor_of([points], SOURCE), target, points.reflectance)
    image, state, xyz = Sight(SOURCE, target)(torch.from_numpy(rows))
    assert set(np.unique(state)) == {0, 1, 2}
    np.testing.assert_array_equal(state, expected.state)
    np.testing.assert_array_equal(image, expected.image)
    np.testing.assert_array_equal(xyz, expected.xyz)
