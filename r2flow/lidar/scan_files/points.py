"""Points of a scan file, selected from named columns and validated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from r2flow.errors import InputError, check

# No LiDAR measures 10 km or less than a millimetre. Nearly all floats read in the wrong byte order or width are beyond
# these limits, because their exponent changes.
FARTHEST = 1e4
NEAREST = 1e-3
MOST_COLUMNS = 64  # of a file without names
# The first name in the file is used: Ouster writes both an intensity and a calibrated reflectivity.
ROLES: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "points_m_xyz:0", "points:0"),  # VeloView's
    "y": ("y", "points_m_xyz:1", "points:1"),
    "z": ("z", "points_m_xyz:2", "points:2"),
    "reflectance": ("intensity", "reflectance", "reflectivity", "remission", "i"),
    "ring": ("ring", "laser_number", "laser_id"),  # Argoverse's and VeloView's
}


class NoPointsError(InputError):
    """A scan file is intact, but has no point, as generators may write."""


@dataclass(frozen=True, eq=False)
class Points:
    """The N points of a scan, in the order of the file."""

    xyz: np.ndarray  # coordinates in metres, (N, 3), float32, sensor frame: x ahead, y left, z up
    reflectance: np.ndarray | None = None  # as stored, (N,), float32, not rescaled; None if the file has none
    ring: np.ndarray | None = None  # number of the beam, (N,), uint16; None if the file has none
    dropped: int = 0  # number of dropped rows: a value was NaN or infinite, or a coordinate beyond `FARTHEST`
    kept: np.ndarray | None = None  # index in the file of each remaining row, (N,); None if all remain

    def __post_init__(self) -> None:
        check_xyz(self.xyz)

    def with_lost_rays(self) -> "Points":
        """All rows of the file, with dropped rows at the origin, as rays without return.

        If the order of the points determines their lasers, lost rays must keep their position, stored as NaN or as
        (0, 0, 0). Points with ring numbers are returned unchanged.
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


def check_xyz(xyz: np.ndarray) -> None:
    """Refuse coordinates of another shape than (N, 3), such as rows of KITTI's four numbers."""
    shape, split = np.shape(xyz), "rows of x, y, z, reflectance are given as points[:, :3], points[:, 3]"
    check(len(shape) == 2 and shape[1] == 3, f"xyz must have the shape (N, 3), found {shape}; {split}.")


def check_columns(columns: Sequence[str] | None) -> None:
    """Refuse names of columns without exactly one x, y and z."""
    names = [str(name).lower() for name in columns or "xyz"]
    counts = {role: sum(name in aliases for name in names) for role, aliases in ROLES.items()}
    check(
        max(counts.values()) == 1 == min(counts[axis] for axis in "xyz") and len(names) <= MOST_COLUMNS,
        "columns must name x, y and z, and intensity and ring at most once, as x,y,z,intensity,_; found "
        f"{','.join(map(str, columns or ()))[:80]}.",
    )


def find_roles(names: Sequence[str]) -> dict[str, list[int]]:
    """Indices of the candidate columns of x, y, z, reflectance and ring, in order of preference.

    Names are compared without case and without CloudCompare's prefix `scalar_`.
    """
    lower = [name.lower().removeprefix("scalar_") for name in names]
    roles: dict[str, list[int]] = {}
    for role, aliases in ROLES.items():
        present = [alias for alias in aliases if alias in lower]
        repeated = [alias for alias in present if lower.count(alias) > 1]
        check(not repeated, f"it declares {', '.join(repeated)} more than once; one number a point is needed.")
        roles[role] = [lower.index(alias) for alias in present]
    missing = [role for role in "xyz" if not roles[role]]
    listed = " ".join(", ".join(names)[:120].split()) or "none"
    check(not missing, f"it has no field {', '.join(missing)}; it has: {listed}. Points need x, y and z.")
    return roles


def column_points(names: Sequence[str], columns: Sequence[np.ndarray], raw: bool = False) -> Points:
    """The finite points within `FARTHEST` from all columns of a file, (N,) each; refuses files that are not scans.

    A file without header, `raw`, is also refused if most rows are not finite or if reflectances are negative, as in
    another row layout. A file without points, or with only rays without return, raises `NoPointsError`.
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
    with np.errstate(over="ignore", invalid="ignore"):  # float32 overflow is infinite: dropped
        axes = np.array([roles[axis][0] for axis in "xyz"], dtype=np.float32)
        # An intensity of only 0 was not measured.
        strength = next((column for column in strengths if column.any()), strengths[0] if strengths else None)
        reflectance = None if strength is None else np.array(strength, dtype=np.float32)
        size = np.abs(axes).max(axis=0)
    finite = np.isfinite(size) if reflectance is None else np.isfinite(size) & np.isfinite(reflectance)
    check(finite.any(), f"each of its {len(size)} rows has a value that is NaN or infinite.")
    returned = size[finite & (size > 0)]  # organised scans store rays without return as (0, 0, 0)
    if not len(returned):
        raise NoPointsError(f"it holds {finite.sum()} points, all at (0, 0, 0): no ray returned. Is it whole?")
    far, near = np.count_nonzero(returned > FARTHEST), np.count_nonzero(returned < NEAREST)
    # A limit of 1/20, so that flipped bits lose only their points. Of float64 read as float32, 1/3 is beyond.
    check(
        far <= len(returned) / 20 and near <= len(returned) / 2,
        f"it does not look like a scan: of {len(returned)} points, {far} lie beyond {FARTHEST:g} m and {near} within "
        f"{NEAREST:g} m. Is it damaged, not in metres, big-endian, or of another row layout?",
    )
    # Rows of three or five floats read as four have coordinates as reflectance, half negative; an integer is tiny.
    negative = 0 if reflectance is None else np.count_nonzero(finite & (reflectance < 1e-30) & (reflectance != 0))
    lost = np.count_nonzero(~finite)
    check(
        not raw or (lost <= len(size) / 2 and negative <= (len(size) - lost) / 20),
        f"it does not look like rows of float32: of {len(size)} rows, {lost} are not finite and {negative} have a "
        "negative or integer reflectance. Is it big-endian, float64, text, or of other columns (--columns)?",
    )
    kept = np.flatnonzero(finite & (size <= FARTHEST))
    selected = kept if len(kept) < len(size) else slice(None)
    ring = rings[0][selected].astype(np.float64) if rings else None  # float16 has no 65535
    if ring is not None:
        whole = (ring >= 0) & (ring <= 65535) & (ring == np.floor(ring))
        check(whole.all(), "it has a ring number that is not a whole number from 0 to 65535. Is it damaged?")
        ring = ring.astype(np.uint16)
    return Points(
        np.ascontiguousarray(axes.T[selected]),
        None if reflectance is None else reflectance[selected],
        ring,
        len(size) - len(kept),
        kept if len(kept) < len(size) else None,
    )
