"""The points of a scan file: found among named columns, and checked to be a scan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from r2flow.errors import InputError

# No LiDAR measures 10 km or less than a millimetre: nearly all bytes read in the wrong order or width are beyond these
# limits, because the exponent of a float changes.
FARTHEST = 1e4
NEAREST = 1e-3
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
    """The N points of one scan, in the file's order."""

    xyz: np.ndarray  # coordinates in metres, (N, 3), float32, sensor frame: x ahead, y left, z up
    reflectance: np.ndarray | None = None  # as stored, (N,), float32, not rescaled; None when the file has none
    ring: np.ndarray | None = None  # number of the beam, (N,), uint16; None when the file has none
    dropped: int = 0  # rows left out: a value was NaN or infinite, or a coordinate beyond `FARTHEST`
    kept: np.ndarray | None = None  # index in the file of each row that is left, (N,); None when all are

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


def check(holds: object, message: str) -> None:
    """Raise an InputError unless a condition holds; the reader's door adds the file's name."""
    if not holds:
        raise InputError(message)


def check_columns(columns: Sequence[str] | None) -> None:
    """Refuse names of columns that do not have x, y and z once each."""
    names = [str(name).lower() for name in columns or "xyz"]
    counts = {role: sum(name in aliases for name in names) for role, aliases in ROLES.items()}
    check(
        max(counts.values()) == 1 == min(counts[axis] for axis in "xyz") and len(names) <= MOST_COLUMNS,
        "columns must name x, y and z, and intensity and ring at most once, as x,y,z,intensity,_; found "
        f"{','.join(map(str, columns or ()))[:80]}.",
    )


def find_roles(names: Sequence[str]) -> dict[str, list[int]]:
    """The columns that may hold x, y, z, reflectance and ring, the first choice first.

    Names are compared without case and CloudCompare's `scalar_`.
    """
    lower = [name.lower().removeprefix("scalar_") for name in names]
    roles: dict[str, list[int]] = {}
    for role, aliases in ROLES.items():
        present = [alias for alias in aliases if alias in lower]
        twice = [alias for alias in present if lower.count(alias) > 1]
        check(not twice, f"it declares {', '.join(twice)} more than once; one number a point is needed.")
        roles[role] = [lower.index(alias) for alias in present]
    missing = [role for role in "xyz" if not roles[role]]
    found = " ".join(", ".join(names)[:120].split()) or "none"
    check(not missing, f"it has no field {', '.join(missing)}; it has: {found}. Points need x, y and z.")
    return roles


def column_points(names: Sequence[str], columns: Sequence[np.ndarray], raw: bool = False) -> Points:
    """Points from all columns of a file, (N,) each: those that are finite and within `FARTHEST`; refuses other files.

    A file without header, `raw`, is refused, too, where most rows are not finite or reflectance is negative, as in rows
    of another layout. A file without a point, or of rays without return alone, is a `NoPointsError`.
    """
    roles = {role: [np.asarray(columns[index]) for index in indices] for role, indices in find_roles(names).items()}
    rows = roles["x"][0].shape[:1]
    for role, candidates in roles.items():
        for column in candidates:
            right = column.shape == rows and column.dtype.kind in "fiub"
            check(right, f"it holds {column.dtype} {column.shape} in the place of one number a point for {role}.")
    strengths, rings = roles["reflectance"], roles["ring"]
    if rows == (0,):
        raise NoPointsError("it holds no points; leave it out, or fetch it again.")
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, and so dropped
        axes = np.array([roles[axis][0] for axis in "xyz"], dtype=np.float32)
        # An intensity that is 0 throughout was not measured.
        strength = next((column for column in strengths if column.any()), strengths[0] if strengths else None)
        reflectance = None if strength is None else np.array(strength, dtype=np.float32)
        size = np.abs(axes).max(axis=0)
    finite = np.isfinite(size) if reflectance is None else np.isfinite(size) & np.isfinite(reflectance)
    check(finite.any(), f"each of its {len(size)} rows has a value that is NaN or infinite.")
    returned = size[finite & (size > 0)]  # an organised scan keeps rays without return as (0, 0, 0)
    if not len(returned):
        raise NoPointsError(f"it holds {finite.sum()} points, all at (0, 0, 0): no ray returned. Is it whole?")
    far, near = np.count_nonzero(returned > FARTHEST), np.count_nonzero(returned < NEAREST)
    # A twentieth, so that a few flipped bits cost only their own points. Of float64 read as float32 a third is beyond.
    check(
        far <= len(returned) / 20 and near <= len(returned) / 2,
        f"it does not look like a scan: of {len(returned)} points, {far} lie beyond {FARTHEST:g} m and {near} within "
        f"{NEAREST:g} m. Is it damaged, not in metres, big-endian, or of another row layout?",
    )
    # Rows of three or five floats read as four put coordinates into the reflectance, and half of these are negative.
    negative = 0 if reflectance is None else np.count_nonzero(finite & (reflectance < 0))
    lost = np.count_nonzero(~finite)
    check(
        not raw or (lost <= len(size) / 2 and negative <= (len(size) - lost) / 20),
        f"it does not look like rows of float32: of {len(size)} rows, {lost} are not finite and {negative} have a "
        "negative reflectance. Is it big-endian, float64, text, or another row layout?",
    )
    kept = np.flatnonzero(finite & (size <= FARTHEST))
    some = kept if len(kept) < len(size) else slice(None)
    ring = rings[0][some] if rings else None
    if ring is not None:
        whole = (ring >= 0) & (ring <= 65535) & (ring == np.floor(ring))
        check(whole.all(), "it has a ring number that is not a whole number from 0 to 65535. Is it damaged?")
        ring = ring.astype(np.uint16)
    return Points(
        np.ascontiguousarray(axes.T[some]),
        None if reflectance is None else reflectance[some],
        ring,
        len(size) - len(kept),
        kept if len(kept) < len(size) else None,
    )
