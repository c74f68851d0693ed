"""Places on the ground: poses, rectangles and streets."""

from math import atan, cos, dist, hypot, pi, sin
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from r2flow.simulator.draws import rotate

# Coordinate: a number in drawing a scene, an array in scanning.
Where = Any


def larger(x: Where, y: Where) -> Where:
    return max(x, y) if isinstance(x, float) and isinstance(y, float) else np.maximum(x, y)


class Pose(NamedTuple):
    """A place in the scene, in metres, and a direction there in radians."""

    x: float
    y: float
    yaw: float

    def locate(self, x: Where, y: Where) -> tuple[Where, Where]:
        """(u, v): metres ahead of the pose and to its left."""
        return rotate(x - self.x, y - self.y, cos(self.yaw), sin(self.yaw))

    def shifted(self, u: float, v: float = 0.0) -> "Pose":
        """The pose u metres ahead and v metres to the left."""
        dx, dy = rotate(u, v, cos(self.yaw), -sin(self.yaw))
        return Pose(self.x + dx, self.y + dy, self.yaw)

    def turned(self, angle: float) -> "Pose":
        return self._replace(yaw=self.yaw + angle)

    @property
    def away(self) -> float:
        """Distance from the sensor's axis in metres."""
        return hypot(self.x, self.y)


class Footprint(NamedTuple):
    """A rectangle of ground with its length along a pose."""

    pose: Pose
    length: float
    width: float

    def holds(self, x: ndarray, y: ndarray) -> ndarray:
        along, across = self.pose.locate(x, y)
        return (abs(along) * 2 <= self.length) & (abs(across) * 2 <= self.width)

    def apart(self, other: "Footprint") -> bool:
        """Whether two rectangles do not overlap."""
        far = self.length + self.width + other.length + other.width
        if dist(self.pose[:2], other.pose[:2]) >= far:  # most are
            return True
        return self._separates(other) or other._separates(self)

    def _separates(self, other: "Footprint") -> bool:
        """Whether a side of this rectangle separates it from another."""
        along, across = self.pose.locate(other.pose.x, other.pose.y)
        turn = self.pose.yaw - other.pose.yaw
        c = abs(cos(turn))
        s = abs(sin(turn))
        return (
            2 * abs(along) >= self.length + other.length * c + other.width * s
            or 2 * abs(across) >= self.width + other.length * s + other.width * c
        )


class Street(NamedTuple):
    """A strip along v = offset + curvature u^2 / 2, u along the heading and v to its left."""

    heading: float  # direction in radians
    offset: float  # lateral coordinate v of the centre line in metres
    curvature: float  # 1 / radius, 1 / metre
    half_width: float  # half of the carriageway in metres
    pavement: float  # width of the pavements in metres; 0 for none
    start: float = -1e6  # u of its start in metres
    stop: float = 1e6  # u of its end in metres
    # lateral coordinates of painted lines in metres; the centre line is dashed
    lines: tuple[float, ...] = ()

    def locate(self, x: Where, y: Where) -> tuple[Where, Where]:
        """(u, lateral): metres along the street and to the left of its centre line."""
        u, v = Pose(0.0, 0.0, self.heading).locate(x, y)
        return u, v - self.offset - (self.curvature / 2) * u * u

    def place(self, u: float, lateral: float) -> Pose:
        """The point at u along and `lateral` to the left, and the street's direction there."""
        v = self.offset + self.curvature / 2 * u * u + lateral
        return Pose(0.0, 0.0, self.heading).shifted(u, v).turned(atan(self.curvature * u))

    def lane(self, u: float, lateral: float) -> Pose:
        """A place and the direction of the traffic there, which keeps to the right."""
        pose = self.place(u, lateral)
        return pose.turned(pi) if lateral > 0 else pose

    def away(self, x: Where, y: Where) -> Where:
        """Distance to the carriageway in metres, negative on it."""
        u, lateral = self.locate(x, y)
        beyond = larger(self.start - u, u - self.stop)
        return larger(abs(lateral) - self.half_width, beyond)
