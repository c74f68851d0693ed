"""The ground: an uneven surface with streets, kerbs, pavements and verges, and its intersection with rays."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from r2flow.lidar.labels import LABELS
from r2flow.simulator.draws import sine
from r2flow.simulator.lasers import Rays
from r2flow.simulator.materials import INDEX, column

SAMPLES = 72  # points of a column's profile, which is piecewise linear
NEAREST = 1.5  # metres: the profile's first point; nearer, the ground is level
REACH = 90.0  # metres: the profile's last point

# Coordinate: a number in drawing a scene, an array in scanning.
Where = Any


def _sin(x: Where) -> Where:
    return math.sin(x) if isinstance(x, float) else sine(x)  # NumPy takes ten times as long for a number


def _larger(x: Where, y: Where) -> Where:
    return max(x, y) if isinstance(x, float) and isinstance(y, float) else np.maximum(x, y)


class Street(NamedTuple):
    """A strip along v = offset + curvature u^2 / 2, u along the heading and v to its left."""

    heading: float  # direction in radians
    offset: float  # lateral coordinate v of the centre line in metres
    curvature: float  # 1 / radius, 1 / metre
    half_width: float  # half of the carriageway in metres
    pavement: float  # width of the pavements in metres; 0 for none
    start: float = -1e6  # u of its start in metres
    stop: float = 1e6  # u of its end in metres
    lines: tuple[float, ...] = ()  # lateral coordinates of painted lines in metres; the centre line is dashed

    def locate(self, x: Where, y: Where) -> tuple[Where, Where]:
        """(u, lateral): metres along the street and to the left of its centre line."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        u = x * c + y * s
        return u, y * c - x * s - self.offset - (self.curvature / 2) * u * u

    def place(self, u: float, lateral: float) -> tuple[float, float, float]:
        """(x, y, heading) of the point at u metres along and `lateral` to the left."""
        v = self.offset + self.curvature / 2 * u * u + lateral
        c, s = math.cos(self.heading), math.sin(self.heading)
        return u * c - v * s, u * s + v * c, self.heading + math.atan(self.curvature * u)

    def away(self, x: Where, y: Where) -> Where:
        """Distance to the carriageway in metres, negative on it."""
        u, lateral = self.locate(x, y)
        distance = abs(lateral) - self.half_width
        if self.start > -1e6 or self.stop < 1e6:
            distance = _larger(distance, _larger(self.start - u, u - self.stop))
        return distance


class Patch(NamedTuple):
    """A paved rectangle, such as a drive or a yard; fields as in `Boxes`."""

    x: float
    y: float
    yaw: float
    length: float
    width: float


@dataclass(frozen=True)
class Ground:
    """z = -drop + lean . p + sum_k A_k [sin(k . p + phi) - sin phi - cos phi (k . p)] + banks, and a kerb.

    The bracket has zero height and slope at the origin, the position of the car.
    """

    streets: tuple[Street, ...]  # the car's, and others
    waves: tuple[tuple[float, float, float, float], ...] = ()  # rows (A in metres, k_x and k_y in radians / metre, phi)
    lean: tuple[float, float] = (0.0, 0.0)  # slope along x and y relative to the car, which leans on its springs
    drop: float = 0.0  # how far the ground is below its default height under the sensor, in metres
    kerb: float = 0.0  # height of the kerb in metres
    tufts: float = 0.0  # height in metres of grass and rubble beyond the pavements
    banks: tuple[float, float] = (0.0, 0.0)  # rise next to the first street, left and right, in metres
    corner: float = 4.0  # radius of the kerb at junctions, in metres
    verge: tuple[int, int] = (LABELS["terrain"], INDEX["grass"])  # (label, material) of the ground beyond the pavements
    patches: tuple[Patch, ...] = ()  # drives and yards next to the street
    # Reflectance reading of each material, (M,).
    albedo: np.ndarray = field(default_factory=lambda: column("albedo"))

    def height(self, x: Where, y: Where) -> Where:
        """Height of the ground in metres, without kerbs."""
        z = self.lean[0] * x + self.lean[1] * y - self.drop
        for amplitude, kx, ky, phase in self.waves:
            t = kx * x + ky * y
            z = z + amplitude * (_sin(t + phase) - math.sin(phase) - math.cos(phase) * t)
        return z + self._bank(x, y) if any(self.banks) else z

    def _bank(self, x: Where, y: Where) -> Where:
        """A smooth step to the height of the banks, over 12 metres outwards from the pavement."""
        street = self.streets[0]
        _, lateral = street.locate(x, y)
        out = (abs(lateral) - street.half_width - street.pavement - 1) / 12
        t = 1 - _larger(1 - _larger(out, 0.0), 0.0)
        left, right = self.banks
        return (right + (left - right) * (lateral > 0)) * t * t * (3 - 2 * t)

    @property
    def pavement(self) -> float:
        """Width of the widest pavement in metres."""
        return max(street.pavement for street in self.streets)

    def off_street(self, x: Where, y: Where) -> Where:
        """Distance to the nearest carriageway in metres, negative on a carriageway; corners are rounded."""
        first, *others = self.streets
        distance = first.away(x, y)
        for street in others:
            d = street.away(x, y)
            blend = _larger(self.corner - abs(distance - d), 0.0)
            distance = -_larger(-distance, -d) - blend * blend / (4 * self.corner)
        return distance

    def surface(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """SemanticKITTI label, material and reflectance reading of the ground at points, (N,) each."""
        label = np.full(x.shape, self.verge[0], np.uint16)
        material = np.full(x.shape, self.verge[1], np.uint8)
        for patch in self.patches:
            c, s = math.cos(patch.yaw), math.sin(patch.yaw)
            dx, dy = x - patch.x, y - patch.y
            on = (abs(dx * c + dy * s) * 2 <= patch.length) & (abs(dy * c - dx * s) * 2 <= patch.width)
            label[on], material[on] = LABELS["parking"], INDEX["paving"]
        away = self.off_street(x, y)
        near, on = away <= self.pavement, away <= 0
        label[near], material[near] = LABELS["sidewalk"], INDEX["paving"]
        label[on], material[on] = LABELS["road"], INDEX["asphalt"]
        painted = self._painted(x, y)
        label[painted], material[painted] = LABELS["lane-marking"], INDEX["marking"]
        # Repairs, wear and damp: reflectance varies over a few metres.
        stains = 0.03 * sine(1.1 * x + 0.4 * y) * sine(0.5 * x - 1.3 * y) + 0.02 * sine(0.23 * x + 0.31 * y)
        return label, material, self.albedo[material] + stains

    def _painted(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether points are on a painted line of the first street, outside crossings."""
        street, *others = self.streets
        u, lateral = street.locate(x, y)
        on = np.zeros(x.shape, bool)
        for place in street.lines:
            line = abs(lateral - place) < 0.08
            on |= line & (np.mod(u, 9) < 3) if place == 0 else line
        for other in others:
            on &= other.away(x, y) > 1
        return on & (u > street.start) & (u < street.stop)

    def meet(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """First intersection of every ray with the ground and kerbs: distance (inf for none) and cosine, (B, W) each.

        The profile of each column is piecewise linear. A ray intersects the first piece at whose end the running
        maximum of (ground - laser) / s, the slope to the ground's skyline, exceeds the slope of the ray.
        """
        s = np.geomspace(NEAREST, REACH, SAMPLES).astype(np.float32)[:, None]
        z = self.height(s * rays.cos, s * rays.sin)
        distance, approach = _meet_profiles(s, z, rays)
        face: np.ndarray | bool = False
        if self.kerb > 0:
            high, raised = _meet_profiles(s, z + np.float32(self.kerb), rays)
            distance, off, face = self._step_up(distance, high, rays)
            approach = np.where(off, raised, approach)
        cosine = approach / np.sqrt((1 + rays.slope[:, None] ** 2) * (1 + (approach + rays.slope[:, None]) ** 2))
        cosine = np.where(face, np.maximum(cosine, 0.6), cosine)
        met = np.isfinite(distance)
        cos, sin, approach = (np.broadcast_to(q, met.shape)[met] for q in (rays.cos, rays.sin, approach))
        if self.tufts > 0:
            distance[met] = self._overgrown(distance[met], cos, sin, approach)
        return distance, cosine

    def _step_up(self, low: np.ndarray, high: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Raise everything except carriageways by the kerb: distance, whether off the street and whether on the face.

        A ray reaches the raised level first. Off the street it ends there; over the street it continues to the low
        level, or to the kerb's face if that is nearer.
        """
        far, near = np.minimum(low, np.float32(REACH)), np.clip(high, 0, REACH)
        d_high, d_low = (self.off_street(s * rays.cos, s * rays.sin) for s in (near, far))
        off, face = d_high > 0, (d_high <= 0) & (d_low > 0)
        share = d_high / np.where(face, d_high - d_low, 1)
        return np.where(off, high, np.where(face, near + share * (far - near), low)), off, face

    def _overgrown(self, distance: np.ndarray, c: np.ndarray, s: np.ndarray, approach: np.ndarray) -> np.ndarray:
        """Move intersections with the verge forward by h / approach, for grass and rubble of height h."""
        x, y = distance * c, distance * s
        share = np.clip((self.off_street(x, y) - self.pavement) * 2, 0, 1)  # grows over half a metre
        h = 0.25 * (2 + sine(2.3 * x + 1.1 * y) * sine(0.7 * x - 2.9 * y) + sine(4.1 * x - 3.3 * y)) * self.tufts
        return np.maximum(distance - share * h / np.maximum(approach, np.float32(0.02)), np.float32(0.5) * distance)


def _meet_profiles(s: np.ndarray, z: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Distances of `_meet_profile` for all blocks of lasers, and approach of ray and ground per metre of s."""
    distance, approach = (np.empty(rays.shape, np.float32) for _ in range(2))
    for block in np.unique(rays.lasers.block):
        rows = np.flatnonzero(rays.lasers.block == block)
        distance[rows], steepness = _meet_profile(s, z, rays.slope[rows], rays.height[rows])
        approach[rows] = steepness - rays.slope[rows, None]
    return distance, approach


def _meet_profile(s: np.ndarray, z: np.ndarray, slope: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays of decreasing slopes T and nearly equal heights with profiles z(s).

    The piece of a ray is found with the mean height of the lasers, the position on it with the height of the ray's
    laser. s is (S, 1), z (S, W), slope and height (R,). Returns the distance of the first intersection, inf for none,
    and the slope of the ground there, (R, W) each.
    """
    (samples, columns), rays = z.shape, len(slope)
    skyline = np.maximum.accumulate((z - height.mean()) / s, axis=0)
    covered = np.searchsorted(-slope, -skyline, side="left")  # rays above the skyline so far, (S, W)
    # A ray's piece is the number of profile points with a skyline below it: a histogram of `covered` per column,
    # accumulated upwards from the lowest ray.
    cells = covered * columns + np.arange(columns)
    count = np.bincount(cells.ravel(), minlength=(rays + 1) * columns).reshape(rays + 1, columns)
    piece = np.cumsum(count[::-1], axis=0)[::-1][1:]
    start, end = np.clip(piece - 1, 0, samples - 2), np.clip(piece, 1, samples - 1)
    w = np.arange(columns)
    s_0, s_1, z_0, z_1 = s[start, 0], s[end, 0], z[start, w], z[end, w]
    ground = (z_1 - z_0) / (s_1 - s_0)
    level = piece == 0  # before the first point: level ground
    ground, z_0, s_0 = np.where(level, 0, ground), np.where(level, z[0], z_0), np.where(level, 0, s_0)
    distance = s_0 + (height[:, None] + s_0 * slope[:, None] - z_0) / np.maximum(ground - slope[:, None], 1e-6)
    return np.where(piece < samples, distance, np.inf), ground
