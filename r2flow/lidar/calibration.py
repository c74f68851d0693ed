"""A sensor estimated from its scans: beams, resolution, limits, height, scale of reflectance."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.beams import Beams, find_beams
from r2flow.lidar.scan_files import Points
from r2flow.lidar.sensors import SENSORS, Sensor

FEWEST_RETURNS = 200
MOST_UNDER = 0.08  # of the returns 3 to 20 m away that lie 0.4 m under a ground: docs/sensor.md
COLUMNS = 64  # an image's width is a multiple of it, so that every backbone can halve it
FULL_REFLECTANCE = (1.0, 100.0, 255.0, 256.0, 65535.0)  # values in use for it


@dataclass(frozen=True)
class Reflectance:
    """The reflectance values of scans.

    Attributes:
        highest: Highest value.
        levels: Number of different values.
        scale: Estimate of the value of full reflectance.
    """

    highest: float
    levels: int
    scale: float


@dataclass(frozen=True)
class Estimate:
    """A sensor estimated from its scans.

    Attributes:
        beams: Its beams.
        steps: Azimuth steps of a full turn, not rounded.
        ranges: Nearest and farthest range in metres, without one return in ten thousand at either end.
        near_share: Share of the returns within a metre, often from the vehicle itself.
        height: Height above the ground in metres; None where no ground was found.
        ground_share: Share of the returns on that ground.
        reflectance: None where the files have none.
        scans: Number of scans.
        returns: Number of their returns.
    """

    beams: Beams
    steps: float
    ranges: tuple[float, float]
    near_share: float
    height: float | None
    ground_share: float
    reflectance: Reflectance | None
    scans: int
    returns: int

    @property
    def columns(self) -> int:
        """Columns of an image: the largest multiple of 64 that is not above the steps."""
        return max(int((self.steps + 0.5) // COLUMNS), 1) * COLUMNS

    def sensor(self, name: str) -> Sensor:
        """The sensor, its range limits rounded outwards."""
        near, far = self.ranges
        return Sensor(
            name,
            _falling(self.beams.elevations.round(3).tolist()),
            self.columns,
            max(math.floor(near * 10) / 10, 0.1),
            float(math.ceil(far)),
            Sensor.height if self.height is None else round(self.height, 2),
            self.beams.firing,
            None if self.reflectance is None else self.reflectance.scale,
        )

    def nearest_known(self) -> tuple[str, float] | None:
        """The built-in sensor of as many beams with the nearest elevations, and their median distance in degrees."""
        found = [
            (float(np.median(np.abs(np.asarray(sensor.elevations) - self.beams.elevations))), name)
            for name, sensor in SENSORS.items()
            if len(sensor.elevations) == len(self.beams.elevations)
        ]
        return min(found)[::-1] if found else None


def estimate_sensor(scans: Sequence[Points]) -> Estimate:
    """Estimate a sensor from its scans, which are in its own frame.

    Raises:
        InputError: too few returns, or no beams in them.
    """
    ranges = [np.linalg.norm(scan.xyz, axis=1) for scan in scans]
    r = np.concatenate([one[one > 0] for one in ranges])
    if len(r) < FEWEST_RETURNS:
        raise InputError(
            f"{len(scans)} scan{'s' * (len(scans) != 1)} with {len(r)} returns in all are too few for an estimate: "
            f"give several whole scans, with at least {FEWEST_RETURNS} returns."
        )
    beams = find_beams(scans)
    height, ground_share = _height(np.concatenate([scan.xyz for scan in scans]))
    return Estimate(
        beams,
        steps_of_a_turn(scans, beams),
        (float(np.quantile(r, 1e-4, method="lower")), float(np.quantile(r, 1 - 1e-4, method="higher"))),
        float((r < 1).mean()),
        height,
        ground_share,
        reflectance_of(scans),
        len(scans),
        len(r),
    )


def _falling(elevations: list[float]) -> tuple[float, ...]:
    """Elevations as a `Sensor` has them; equal ones after rounding are set a thousandth of a degree apart."""
    for row, (above, below) in enumerate(pairwise(elevations)):
        if below >= above:
            elevations[row + 1] = round(above - 1e-3, 3)
    return tuple(elevations)


def steps_of_a_turn(scans: Sequence[Points], beams: Beams) -> float:
    """Azimuth steps of a full turn, 360 / step.

    The first estimate is the 30th percentile of the gaps between neighbouring returns of one beam, since most rays next
    to a return have one too; then the sum of all gaps of up to three steps divided by the number of steps in them.
    """
    gaps = []
    for scan, row in zip(scans, beams.of_point, strict=True):
        azimuth = np.rad2deg(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]).astype(np.float64))
        order = np.lexsort((azimuth, row))
        order = order[row[order] >= 0]
        gaps.append(np.diff(azimuth[order])[np.diff(row[order]) == 0])
    gap = np.concatenate(gaps)
    apart = gap[gap > 1e-2]  # two returns of one ray lie at one azimuth
    if not len(apart):
        raise InputError("no beam returned at two azimuths in these scans. Are they whole?")
    step = float(np.quantile(apart, 0.3))
    for _ in range(3):
        near = gap[gap < 3.5 * step]
        step = float(near.sum() / (near / step).round().sum())
    return 360 / step


def _height(xyz: np.ndarray) -> tuple[float | None, float]:
    """Height above the ground, and the share of returns on it.

    The ground is a plane through the most frequent height of the returns 3 to 20 m away under which few of them lie:
    beams close to the horizon meet more hedges and cars than ground.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[(distance > 3) & (distance < 20)].astype(np.float64)
    counts, edges = np.histogram(near[:, 2], np.arange(-6, -0.1, 0.1))
    often = np.convolve(counts, np.ones(3), "same")
    while often.any():
        peak = int(np.argmax(often))
        plane = _plane(near[near[:, 2] < -0.2], edges[peak] + 0.05)
        if plane is None:
            return None, 0.0
        under = float((near[:, 2] < near[:, :2] @ plane[:2] + plane[2] - 0.4).mean())
        if under < MOST_UNDER:
            on = np.abs(near[:, 2] - near[:, :2] @ plane[:2] - plane[2]) < 0.15
            height, share = -plane[2] / math.hypot(1, *plane[:2]), float(on.sum() / len(xyz))
            return (float(height), share) if height > 0.1 and share > 0.03 else (None, share)
        often[max(peak - 1, 0) :] = 0
    return None, 0.0


def _plane(xyz: np.ndarray, z: float) -> np.ndarray | None:
    """(a, b, c) of z = a x + b y + c by least squares about a height; None where too few points lie there."""
    plane, design = np.array([0.0, 0.0, z]), np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    for within in (0.3, 0.2, 0.15, 0.15):
        on = np.abs(xyz[:, 2] - design @ plane) < within
        if on.sum() < FEWEST_RETURNS / 4:
            return None
        plane = np.linalg.lstsq(design[on], xyz[on, 2], rcond=None)[0]
    return plane


def reflectance_of(scans: Sequence[Points]) -> Reflectance | None:
    """The reflectance values of scans; None where a file has none, or only one value."""
    if any(scan.reflectance is None for scan in scans):
        return None
    values = np.unique(np.concatenate([scan.reflectance for scan in scans]))
    highest = float(values[-1])
    if len(values) < 2 or highest <= 0:
        return None
    scale = next((full for full in FULL_REFLECTANCE if highest <= full * (1 + 1e-3)), highest)
    if highest < 0.1:  # else the values would fill less than a tenth of the scale
        scale = float(f"{highest:.1g}") if float(f"{highest:.1g}") >= highest else float(f"{highest * 1.05:.2g}")
    return Reflectance(highest, len(values), scale)
