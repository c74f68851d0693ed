"""The ground: an uneven surface with streets, kerbs, pavements and verges, and its intersection
with rays.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np
from numpy import ndarray

from r2flow.lidar.labels import LABELS
from r2flow.simulator.draws import sine
from r2flow.simulator.lasers import Rays
from r2flow.simulator.materials import ALBEDO, INDEX
from r2flow.simulator.streets import Footprint, Street, Where, larger

_SAMPLES = 72  # points of a column's profile, which is piecewise linear
_NEAREST = 1.5  # metres: the profile's first point; nearer, the ground is level
_REACH = 90.0  # metres: the profile's last point

# Label and material of the surfaces of the ground: two kinds of verge, then what lies on it, ever
# higher.
_SURFACES = (
    ("terrain", "grass"),
    ("other-ground", "paving"),
    ("parking", "paving"),
    ("sidewalk", "paving"),
    ("road", "asphalt"),
    ("lane-marking", "marking"),
)
_LABEL = np.array([LABELS[label] for label, _ in _SURFACES], np.uint16)
_MATERIAL = np.array([INDEX[material] for _, material in _SURFACES], np.uint8)


def _sin(x: Where) -> Where:
    return sin(x) if isinstance(x, float) else sine(x)  # NumPy takes ten times as long for a number


class Ground(NamedTuple):
    """An uneven surface with streets and a kerb.

    z = -drop + lean . p + sum_k A_k [sin(k . p + phi) - sin phi - cos phi (k . p)] + banks.
    The bracket has zero height and slope at the origin, the position of the car.
    """

    streets: tuple[Street, ...]  # the car's, and others
    # rows (A in metres, k_x and k_y in radians / metre, phi)
    waves: tuple[tuple[float, float, float, float], ...] = ()
    # slope along x and y relative to the car, which leans on its springs
    lean: tuple[float, float] = (0.0, 0.0)
    drop: float = 0.0  # how far the ground is below its default height under the sensor, in metres
    kerb: float = 0.0  # height of the kerb in metres
    tufts: float = 0.0  # height in metres of grass and rubble beyond the pavements
    # rise next to the first street, left and right, in metres
    banks: tuple[float, float] = (0.0, 0.0)
    corner: float = 4.0  # radius of the kerb at junctions, in metres
    paved: bool = False  # whether the ground beyond the pavements is paved, not grass
    yards: tuple[Footprint, ...] = ()  # paved drives and yards next to the street
    # Reflectance reading of each material, (M,).
    albedo: ndarray = ALBEDO

    def height(self, x: Where, y: Where) -> Where:
        """Height of the ground in metres, without kerbs."""
        z = self.lean[0] * x + self.lean[1] * y - self.drop
        for amplitude, kx, ky, phase in self.waves:
            t = kx * x + ky * y
            z = z + amplitude * (_sin(t + phase) - sin(phase) - cos(phase) * t)
        if not any(self.banks):
            return z
        # Banks are smooth steps over 12 metres outwards from the pavement.
        street = self.streets[0]
        _, lateral = street.locate(x, y)
        out = (abs(lateral) - street.half_width - street.pavement - 1) / 12
        t = 1 - larger(1 - larger(out, 0.0), 0.0)
        left, right = self.banks
        return z + (right + (left - right) * (lateral > 0)) * t * t * (3 - 2 * t)

    @property
    def pavement(self) -> float:
        """Width of the widest pavement in metres."""
        return max(street.pavement for street in self.streets)

    def off_street(self, x: Where, y: Where) -> Where:
        """Distance to the nearest carriageway in metres, negative on a carriageway; corners are
        rounded.
        """
        distance, *others = (street.away(x, y) for street in self.streets)
        for other in others:
            blend = larger(self.corner - abs(distance - other), 0.0)
            distance = -larger(-distance, -other) - blend * blend / (4 * self.corner)
        return distance

    def surface(self, x: ndarray, y: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """SemanticKITTI label, material and reflectance of the ground at points, (N,) each."""
        surface = np.full(x.shape, int(self.paved))
        for yard in self.yards:
            surface[yard.holds(x, y)] = 2
        away = self.off_street(x, y)
        surface[away <= self.pavement] = 3
        surface[away <= 0] = 4
        surface[self._painted(x, y)] = 5
        # Repairs, wear and damp: reflectance varies over a few metres.
        stains = 0.03 * sine(1.1 * x + 0.4 * y) * sine(0.5 * x - 1.3 * y) + 0.02 * sine(
            0.23 * x + 0.31 * y
        )
        material = _MATERIAL[surface]
        return _LABEL[surface], material, self.albedo[material] + stains

    def _painted(self, x: ndarray, y: ndarray) -> ndarray:
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

    def meet(self, rays: Rays) -> tuple[ndarray, ndarray]:
        """First intersection of every ray with the ground and kerbs: distance (inf for none) and
        cosine, (B, W) each.

        The profile of each column is piecewise linear. A ray intersects the first piece at whose
        end the running maximum of (ground - laser) / s, the slope to the ground's skyline, exceeds
        the slope of the ray.
        """
        s = np.geomspace(_NEAREST, _REACH, _SAMPLES).astype(np.float32)[:, None]
        z = self.height(s * rays.cos, s * rays.sin)
        low, approach = _meet_profiles(s, z, rays)
        high, raised = _meet_profiles(s, z + np.float32(self.kerb), rays)
        distance, off, face = self._step_up(low, high, rays)
        approach = np.where(off, raised, approach)
        slope = rays.slope[:, None]
        cosine = approach / np.sqrt((1 + slope**2) * (1 + (approach + slope) ** 2))
        cosine = np.where(face, np.maximum(cosine, 0.6), cosine)
        return self._overgrown(distance, approach, rays), cosine

    def _step_up(self, low: ndarray, high: ndarray, rays: Rays) -> tuple[ndarray, ndarray, ndarray]:
        """Raise everything except carriageways by the kerb: distance, whether off the street and
        whether on the face.

        A ray reaches the raised level first. Off the street it ends there; over the street it
        continues to the low level, or to the kerb's face if that is nearer.
        """
        far = np.minimum(low, _REACH)
        near = np.clip(high, 0, _REACH)
        d_high, d_low = (self.off_street(s * rays.cos, s * rays.sin) for s in (near, far))
        off = d_high > 0
        face = ~off & (d_low > 0)
        share = d_high / np.where(face, d_high - d_low, 1)
        return np.where(off, high, np.where(face, near + share * (far - near), low)), off, face

    def _overgrown(self, distance: ndarray, approach: ndarray, rays: Rays) -> ndarray:
        """Move intersections with the verge forward by h / approach, for grass and rubble of height
        h.
        """
        s = np.where(np.isfinite(distance), distance, 0)
        x = s * rays.cos
        y = s * rays.sin
        # grows over half a metre
        share = np.clip((self.off_street(x, y) - self.pavement) * 2, 0, 1)
        h = (
            0.25
            * (2 + sine(2.3 * x + 1.1 * y) * sine(0.7 * x - 2.9 * y) + sine(4.1 * x - 3.3 * y))
            * self.tufts
        )
        moved = distance - share * h / np.maximum(approach, 0.02)
        return np.maximum(moved, 0.5 * distance)


def _meet_profiles(s: ndarray, z: ndarray, rays: Rays) -> tuple[ndarray, ndarray]:
    """Distances of `_meet_profile` for all blocks of lasers, and approach of ray and ground per
    metre of s.
    """
    distance, approach = np.empty((2, *rays.shape), np.float32)
    for block in np.unique(rays.lasers.block):
        rows = rays.lasers.block == block
        distance[rows], approach[rows] = _meet_profile(s, z, rays.slope[rows], rays.height[rows])
    return distance, approach


def _meet_profile(
    s: ndarray, z: ndarray, slope: ndarray, height: ndarray
) -> tuple[ndarray, ndarray]:
    """Intersect rays of decreasing slopes T and nearly equal heights with profiles z(s).

    The piece of a ray is found with the mean height of the lasers, the position on it with the
    height of the ray's laser. s is (S, 1), z (S, W), slope and height (R,). Returns the distance of
    the first intersection, inf for none, and the slope of the ground there less that of the ray,
    (R, W) each.
    """
    skyline = np.maximum.accumulate((z - height.mean()) / s, axis=0)
    slope = slope[:, None]
    # the number of profile points with a skyline below the ray
    piece = sum(level < slope for level in skyline)
    # Before the first point, the ground is level.
    s = np.pad(s[:, 0], (1, 0))
    z = np.concatenate([z[:1], z])
    start = np.minimum(piece, len(skyline) - 1)
    w = np.arange(z.shape[1])
    z_0 = z[start, w]
    s_0 = s[start]
    ground = (z[start + 1, w] - z_0) / (s[start + 1] - s_0)
    distance = s_0 + (height[:, None] + s_0 * slope - z_0) / np.maximum(ground - slope, 1e-6)
    return np.where(piece < len(skyline), distance, np.inf), ground - slope
