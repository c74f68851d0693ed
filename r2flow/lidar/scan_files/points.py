"""The points of a scan file: found among named columns, and checked to be a scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from r2flow.errors import InputError

# No LiDAR measures 10 km or less than a millimetre: nearly all bytes read in the wrong order or width are beyond these
# limits, because the exponent of a float changes.
FARTHEST = 1e4
NEAREST = 1e-3
SAMPLE = 4096  # rows that are checked
MOST_COLUMNS = 64  # of a file without names
# The first name that a file has is taken: Ouster writes both an intensity and a calibrated reflectivity.
ROLES: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "points_m_xyz:0", "points:0"),  # VeloView's
    "y": ("y", "points_m_xyz:1", "points:1"),
    "z": ("z", "points_m_xyz:2", "points:2"),
    "reflectance": ("intensity", "reflectance", "reflectivity", "remission", "i"),
    "ring": ("ring", "laser_number", "laser_id"),  # Argoverse's and VeloView's
}


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
        """The rows of the file again, dropped ones at the origin, as rays without return.

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


def check(holds: bool, message: str) -> None:
    """Raise an InputError unless a condition holds; the reader's door adds the file's name."""
    if not holds:
        raise InputError(message)


def check_columns(columns: Sequence[str] | None) -> None:
    """Refuse names of columns that do not have x, y and z once each.

    Raises:
        InputError: what was given, and an example.
    """
    names = [str(name).lower() for name in columns or "xyz"]
    counts = {role: sum(name in aliases for name in names) for role, aliases in ROLES.items()}
    check(
        max(counts.values()) == 1 == min(counts[axis] for axis in "xyz") and len(names) <= MOST_COLUMNS,
        "columns must name x, y and z, and intensity and ring at most once, as x,y,z,intensity,_; found "
        f"{','.join(map(str, columns or ()))[:80]}.",
    )


def find_roles(names: Sequence[str]) -> dict[str, int]:
    """Which column holds x, y, z and, where present, reflectance and ring.

    Further columns that may hold the reflectance are `reflectance N`: `column_points` takes one where the first is 0
    throughout, as an intensity that nobody measured. Names are compared without case and CloudCompare's `scalar_`.
    """
    lower = [name.lower().removeprefix("scalar_") for name in names]
    roles: dict[str, int] = {}
    for role, aliases in ROLES.items():
        for name in (alias for alias in aliases if alias in lower):
            check(lower.count(name) == 1, f"it declares {name!r} more than once; one number a point is needed.")
            roles[role if role not in roles else f"{role} {lower.index(name)}"] = lower.index(name)
            if role != "reflectance":
                break
    missing = [role for role in "xyz" if role not in roles]
    found = " ".join(", ".join(names)[:120].split()) or "none"
    check(not missing, f"it has no field {', '.join(missing)}; it has: {found}. Points need x, y and z.")
    return roles


def column_points(names: Sequence[str], columns: Sequence[np.ndarray], raw: bool = False) -> Points:
    """Points from all columns of a file, (N,) each; see `checked_points`."""
    roles = {role: np.asarray(columns[index]) for role, index in find_roles(names).items()}
    for role, column in roles.items():
        right = column.shape == roles["x"].shape[:1] and column.dtype.kind in "fiub"
        check(right, f"it holds {column.dtype} {column.shape} in the place of one number a point for {role}.")
    strengths = [column for role, column in roles.items() if role.startswith("reflectance")]
    strength = next((column for column in strengths if column.any()), strengths[0] if strengths else None)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, and so dropped
        xyz = np.stack([np.asarray(roles[axis], dtype=np.float32) for axis in "xyz"], axis=1)
    return checked_points(xyz, strength, roles.get("ring"), raw)


def checked_points(
    xyz: np.ndarray, reflectance: np.ndarray | None = None, ring: np.ndarray | None = None, raw: bool = False
) -> Points:
    """Drop points that are not finite or beyond `FARTHEST`, refuse what is not a scan.

    Args:
        xyz: Coordinates in metres, (N, 3), any number type; reflectance and ring (N,) or None.
        raw: Whether the file has no header. It is also refused where most rows are not finite or reflectance is
            negative, as in rows of another layout.

    Raises:
        NoPointsError: no point, or rays without return alone.
        InputError: no finite point, or values that no LiDAR measures.
    """
    if not len(xyz):
        raise NoPointsError("it holds no points; leave it out, or fetch it again.")
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.array(xyz, dtype=np.float32, order="C")  # a copy, since it may be a read-only view of a file's bytes
        reflectance = None if reflectance is None else np.array(reflectance, dtype=np.float32)
    points = Points(xyz, reflectance, ring)
    if not (_all_finite(xyz) and (reflectance is None or _all_finite(reflectance))):
        finite = np.isfinite(xyz).all(axis=1)
        points = _only(points, finite if reflectance is None else finite & np.isfinite(reflectance))
    check(len(points.xyz) > 0, f"each of its {len(xyz)} rows has a value that is NaN or infinite.")
    if not points.xyz.any():
        raise NoPointsError(f"it holds {len(points.xyz)} points, all at (0, 0, 0): no ray returned. Is it whole?")
    # A wrong layout is wrong everywhere, so that some thousand rows show it; all of them would take as long as reading.
    size = np.abs(points.xyz[:: max(1, len(points.xyz) // SAMPLE)])
    largest = np.maximum(np.maximum(size[:, 0], size[:, 1]), size[:, 2])
    largest = largest[largest > 0]  # an organised scan keeps rays without return as (0, 0, 0)
    far, near = np.count_nonzero(largest > FARTHEST), np.count_nonzero(largest < NEAREST)
    # A twentieth, so that a few flipped bits cost only their own points. Of float64 read as float32 a third is beyond.
    check(
        bool(far <= len(largest) / 20 and near <= len(largest) / 2),
        f"it does not look like a scan: of {len(largest)} points, {far} lie beyond {FARTHEST:g} m and {near} within "
        f"{NEAREST:g} m. Is it damaged, not in metres, big-endian, or of another row layout?",
    )
    # Rows of three or five floats read as four put coordinates into the reflectance, and half of these are negative.
    negative = 0 if points.reflectance is None else np.count_nonzero(points.reflectance < 0)
    check(
        not raw or bool(points.dropped <= len(xyz) / 2 and negative <= len(points.xyz) / 20),
        f"it does not look like rows of float32: of {len(xyz)} rows, {points.dropped} are not finite and {negative} "
        "have a negative reflectance. Is it big-endian, float64, text, or another row layout?",
    )
    if max(points.xyz.max(), -points.xyz.min()) > FARTHEST:
        points = _only(points, np.abs(points.xyz).max(axis=1) <= FARTHEST)
    if points.ring is None:
        return points
    whole = (points.ring >= 0) & (points.ring <= 65535) & (points.ring == np.floor(points.ring))
    check(bool(whole.all()), "it has a ring number that is not a whole number from 0 to 65535. Is it damaged?")
    return Points(points.xyz, points.reflectance, points.ring.astype(np.uint16), points.dropped, points.kept)


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
