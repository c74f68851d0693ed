"""How many turns of the sensor a file of points holds."""

import numpy as np
from numpy import ndarray

from r2flow.lidar.scan_files import Points

SEVERAL = 1.5  # turns; a scan may overlap itself by a few degrees
_OF_RING = 16  # points in a group; groups are narrow in azimuth
_OF_ALL = 512  # covers every beam at least four times
_NARROW = 0.8  # length of the mean direction of a group; of 90 degrees it is 0.9
_ALL_BEAMS = 0.5  # spread of elevations in a group, of that of the scan


def turns(points: Points) -> float:
    """Turns of a sensor by the order of its points; 0 where the order does not tell.

    The points of one ring pass the azimuths once a turn. So do all points of a scan without rings
    if they are stored as they were fired, all beams at one azimuth after the other. Points stored
    ring after ring, without numbers, or in no order do not tell.
    """
    returned = points.xyz[:, :2].any(axis=1)
    xyz = points.xyz[returned]
    if points.ring is None:
        return _by_order(xyz, _OF_ALL) if _fired_in_order(xyz) else 0.0
    ring = points.ring[returned]
    fullest = np.bincount(ring, minlength=1).argmax()
    return _by_order(xyz[ring == fullest], _OF_RING)


def _fired_in_order(xyz: ndarray) -> bool:
    """Whether neighbours in the order are of all beams."""
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    groups = _grouped(elevation, _OF_ALL)
    return len(groups) > 0 and np.median(groups.std(axis=1)) > _ALL_BEAMS * elevation.std()


def _by_order(xyz: ndarray, size: int) -> float:
    direction = xyz[:, 0] + 1j * xyz[:, 1]
    means = _grouped(direction / abs(direction), size).mean(axis=1)
    if len(means) < 3 or np.median(abs(means)) < _NARROW:
        return 0.0
    steps = np.angle(means[1:] / means[:-1])
    return abs(float(steps.sum())) / (2 * np.pi) * len(means) / len(steps)


def _grouped(values: ndarray, size: int) -> ndarray:
    return values[: len(values) // size * size].reshape(-1, size)
