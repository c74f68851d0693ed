"""What the sensor's own car hides: roof, posts and instruments, as silhouettes around the sensor.

They are about a metre away, nearer than any valid return, so that a scan shows only their shadow. Each is an ellipse or
a rounded rectangle in azimuth and inclination, read off two KITTI drives. A laser beside the axis sees it displaced:
neighbouring rings are cut off alternately left and right.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from r2flow.simulator.lasers import Lasers


class Silhouette(NamedTuple):
    """|across|^p + |up|^p < 1 in degrees; a `grounded` one reaches straight down.

    `away` is the distance in metres from the axis to the object, which sets how far neighbouring rings shift.
    """

    azimuth: float
    elevation: float
    half_width: float
    half_height: float
    away: float
    grounded: bool = False
    power: int = 2


_ROOF = (
    Silhouette(0, -26.5, 22, 5.0, 1.2, grounded=True),
    Silhouette(34, -26.2, 6, 2.6, 0.8, grounded=True),
    Silhouette(-34, -26.2, 6, 2.6, 0.8, grounded=True),
    Silhouette(131, -23.2, 5.0, 2.4, 0.7, grounded=True),
    Silhouette(-128, -23.2, 5.0, 2.4, 0.7, grounded=True),
    Silhouette(142, -26.5, 14, 2.9, 0.8, grounded=True),
    Silhouette(-142, -26.5, 14, 2.9, 0.8, grounded=True),
    Silhouette(163, -26, 15, 6.2, 1.2, grounded=True),
    Silhouette(-163, -26, 15, 6.2, 1.2, grounded=True),
    Silhouette(180, -26, 18, 6.6, 1.5, grounded=True, power=6),
    Silhouette(161, -17.0, 4.2, 4.0, 1.0, power=4),
    Silhouette(-158.5, -17.0, 4.2, 4.0, 1.0, power=4),
)
# A roof with its posts; with an instrument beside the sensor, and without.
RIGS = ((*_ROOF, Silhouette(-69, -20.0, 11.0, 4.4, 0.55)), _ROOF)


@lru_cache(maxsize=16)
def _hidden(elevation: tuple[float, ...], side: tuple[float, ...], columns: int, rig: int) -> np.ndarray:
    azimuth = 180 - 360 * (np.arange(columns) + 0.5) / columns
    e = np.rad2deg(np.array(elevation))[:, None]
    hidden = np.zeros((len(elevation), columns), bool)
    for s in RIGS[rig]:
        shift = np.rad2deg(np.arctan2(np.array(side), s.away))[:, None]
        across = ((azimuth - shift - s.azimuth + 180) % 360 - 180) / s.half_width
        up = (e - s.elevation) / s.half_height
        up = np.maximum(up, 0) if s.grounded else up
        hidden |= np.abs(across) ** s.power + np.abs(up) ** s.power < 1
    hidden.setflags(write=False)
    return hidden


def hidden(lasers: Lasers, columns: int, rig: int) -> np.ndarray:
    """Rays that end on the own car, (B, W), bool, for one of `RIGS`."""
    return _hidden(tuple(lasers.elevation.tolist()), tuple(lasers.side.tolist()), columns, rig)
