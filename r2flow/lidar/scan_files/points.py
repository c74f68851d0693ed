"""The points of a scan file, and the checks that they are a scan."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from r2flow.errors import InputError

# No LiDAR measures 10 km or less than a millimetre: nearly all bytes read in the wrong order or width are beyond these
# limits, because the exponent of a float changes.
FARTHEST = 1e4
NEAREST = 1e-3
SAMPLE = 4096  # rows that are checked

_OTHER_LAYOUTS = "Is it big-endian, float64, text, or another row layout?"


class NoPointsError(InputError):
    """A scan file that is whole and has no point; a generator may well write one."""


@dataclass(frozen=True, eq=False)
class Points:
    """The N points of one scan, in the file's order.

    Attributes:
        xyz: Coordinates in metres, (N, 3), float32, sensor frame: x ahead, y left, z up.
        reflectance: As stored, (N,), float32, not rescaled; None when the file has none.
        ring: Number of the beam, (N,), uint16; None when the file has none.
        dropped: Number of rows left out because a coordinate or the reflectance was NaN or infinite, or a coordinate
            beyond `FARTHEST`.
        kept: Index in the file of each row that is left, (N,); None when all are.
    """

    xyz: np.ndarray
    reflectance: np.ndarray | None = None
    ring: np.ndarray | None = None
    dropped: int = 0
    kept: np.ndarray | None = None

    def with_lost_rays(self) -> "Points":
        """The rows of the file again, those that were dropped as rays without return, at the origin.

        Where lasers are told by the order of the points, a lost ray keeps its place, stored as NaN or as (0, 0, 0).
        Points with ring numbers need no order and stay as they are.
        """
        if self.kept is None or self.ring is not None:
            return self
        xyz = np.zeros((len(self.xyz) + self.dropped, 3), np.float32)
        xyz[self.kept] = self.xyz
        reflectance = None
        if self.reflectance is not None:
            reflectance = np.zeros(len(xyz), np.float32)
            reflectance[self.kept] = self.reflectance
        return Points(xyz, reflectance)


def checked_points(
    path: Path,
    xyz: np.ndarray,
    reflectance: np.ndarray | None = None,
    ring: np.ndarray | None = None,
    layout: str | None = None,
) -> Points:
    """Drop points that are not finite or beyond `FARTHEST`, refuse what is not a scan.

    Args:
        path: The file, for messages.
        xyz: Coordinates in metres, (N, 3), any number type.
        reflectance: (N,), any number type, or None.
        ring: (N,), any number type, or None.
        layout: The assumed row, where the file has no header. Such a file is also refused where most rows are not
            finite or reflectance is negative.

    Raises:
        NoPointsError: no point, or rays without return alone.
        InputError: no finite point, or values that no LiDAR measures.
    """
    if not len(xyz):
        raise NoPointsError(f"{path} is well-formed but holds no points; leave it out, or fetch it again.")
    total = len(xyz)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, and so dropped
        # Copied, since these may be read-only views of a file's bytes.
        xyz = np.array(xyz, dtype=np.float32, order="C")
        reflectance = None if reflectance is None else np.array(reflectance, dtype=np.float32)
    points = Points(xyz, reflectance, ring)
    if not (_all_finite(xyz) and (reflectance is None or _all_finite(reflectance))):
        finite = np.isfinite(xyz).all(axis=1)
        finite &= True if reflectance is None else np.isfinite(reflectance)
        points = _only(points, finite)
    if not len(points.xyz):
        raise InputError(
            f"{path} holds no finite point: each of its {total} rows has a coordinate or reflectance that "
            "is NaN or infinite; was it written by something that failed?"
        )
    _refuse_implausible(path, points.xyz, layout)
    if layout is not None:
        _refuse_wrong_layout(path, points.reflectance, points.dropped, total, layout)
    if max(points.xyz.max(), -points.xyz.min()) > FARTHEST:
        points = _only(points, np.abs(points.xyz).max(axis=1) <= FARTHEST)
    return points if points.ring is None else replace(points, ring=_whole_rings(path, points.ring))


def _only(points: Points, keep: np.ndarray) -> Points:
    """The rows where `keep`, (N,) bool, holds."""
    kept = np.flatnonzero(keep) if points.kept is None else points.kept[keep]
    reflectance = None if points.reflectance is None else points.reflectance[keep]
    ring = None if points.ring is None else points.ring[keep]
    return Points(points.xyz[keep], reflectance, ring, points.dropped + int((~keep).sum()), kept)


def _all_finite(values: np.ndarray) -> bool:
    # Two reductions, no temporary: NaN and infinity remain in a minimum or a maximum.
    with np.errstate(invalid="ignore"):
        return bool(np.isfinite(values.min()) and np.isfinite(values.max()))


def _refuse_implausible(path: Path, xyz: np.ndarray, layout: str | None) -> None:
    if not xyz.any():
        raise NoPointsError(f"{path} holds {len(xyz)} points, all at (0, 0, 0): no ray returned. Is it whole?")
    # A wrong layout is wrong everywhere, so that some thousand rows show it; all of them would take as long as reading.
    size = np.abs(xyz[:: max(1, len(xyz) // SAMPLE)])
    largest = np.maximum(np.maximum(size[:, 0], size[:, 1]), size[:, 2])
    largest = largest[largest > 0]  # an organised scan keeps rays without return as (0, 0, 0)
    returns = len(largest)
    far = np.count_nonzero(largest > FARTHEST)
    near = np.count_nonzero(largest < NEAREST)
    # A twentieth, so that a few flipped bits cost only their own points, not the scan. A file of float64 read as
    # float32 has a third of its rows beyond the limits.
    if far <= returns / 20 and near <= returns / 2:
        return
    found = f"of {returns} points, {far} lie beyond {FARTHEST:g} m and {near} within {NEAREST:g} m"
    if layout is None:
        raise InputError(
            f"{path} does not look like one scan: {found}. Is it damaged, or are its coordinates not metres "
            "in the sensor's frame (millimetres, a map's frame)?"
        )
    raise InputError(f"{path} does not look like {layout}: {found}. {_OTHER_LAYOUTS}")


def _refuse_wrong_layout(path: Path, reflectance: np.ndarray | None, dropped: int, total: int, layout: str) -> None:
    # Rows of three or five floats read as four put coordinates into the reflectance, and half of
    # these are negative.
    negative = 0 if reflectance is None else np.count_nonzero(reflectance < 0)
    if dropped > total / 2:
        found = f"{dropped} of {total} rows are NaN or infinite"
    elif negative > (total - dropped) / 20:
        found = f"{negative} of {total - dropped} reflectances are negative"
    else:
        return
    raise InputError(f"{path} does not look like {layout}: {found}. {_OTHER_LAYOUTS}")


def _whole_rings(path: Path, ring: np.ndarray) -> np.ndarray:
    """Ring numbers as uint16, (N,), whatever the type they were stored in."""
    with np.errstate(invalid="ignore"):
        whole = (ring >= 0) & (ring <= np.iinfo(np.uint16).max) & (ring == np.floor(ring))
    if not whole.all():
        first = int(np.argmin(whole))
        raise InputError(
            f"{path} has a ring number that is none: {ring[first]!s} at point {first}; rings are whole and "
            "from 0 to 65535. Is it damaged, or another layout?"
        )
    return ring.astype(np.uint16)
