"""Points of a scan file, selected from named columns and validated."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, warn_odd

if TYPE_CHECKING:
    from r2flow.lidar.scan_files.cloud import Cloud

# No LiDAR measures 10 km or less than a millimetre. Nearly all floats read in the wrong byte order
# or width are beyond these limits, because their exponent changes.
FARTHEST = 1e4
NEAREST = 1e-3
# r2flow's own fields, of a completed cloud (`r2flow.lidar.added`), are what their names say.
OWN = ("measured", "image_row", "error_68", "error_95", "p_return")
# The first name in the file is used: Ouster writes both an intensity and a calibrated reflectivity.
_ROLES: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "points_m_xyz:0", "points:0", "x1"),  # VeloView's, and Ouster's first return
    "y": ("y", "points_m_xyz:1", "points:1", "y1"),
    "z": ("z", "points_m_xyz:2", "points:2", "z1"),
    "reflectance": ("intensity", "reflectance", "reflectivity", "remission", "i"),
    # Argoverse's, VeloView's and Autoware's
    "ring": ("ring", "laser_number", "laser_id", "channel"),
    "time": (
        "t", "time", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset",
        "offset_ns", "gps_time", "point_time_offset",
    ),
    **{name: (name,) for name in OWN},
}  # fmt: skip
_ONCE = ("x", "y", "z", "reflectance", "ring")  # a file's columns name each at most once
# What may be a reflectance: a field of any other name is never proposed as one.
_LIKE_REFLECTANCE = re.compile(
    "intens|reflec|remiss|amplitude|signal|strength|power|gain|albedo|bright"
)
_OF_IT = re.compile("time|stamp|valid|flag|index|label|id$")  # what is said of it
_ROLE_OF = {alias: role for role, aliases in _ROLES.items() for alias in aliases}


class NoPointsError(InputError):
    """A scan file is intact, but has no point, as generators may write."""


@dataclass(frozen=True, eq=False)
class Points:
    """The N points of a scan, in the order of the file."""

    xyz: ndarray  # metres, (N, 3), float32, sensor frame: x ahead, y left, z up
    reflectance: ndarray | None = None  # as stored, (N,), float32; None if the file has none
    ring: ndarray | None = None  # number of the beam, (N,), uint16; None if the file has none
    dropped: int = 0  # dropped rows: a value was NaN or infinite, or beyond `FARTHEST`
    kept: ndarray | None = None  # index in the file of each remaining row, (N,); None: all
    cloud: "Cloud | None" = None  # all fields and rows, where a completion needs them

    def __post_init__(self) -> None:
        check_xyz(self.xyz)

    def with_lost_rays(self) -> "Points":
        """All rows of the file, with dropped rows at the origin, as rays without return.

        If the order of the points determines their lasers, lost rays must keep their position,
        stored as NaN or as (0, 0, 0). Points with ring numbers are returned unchanged.
        """
        if self.kept is None or self.ring is not None:
            return self
        rows = len(self.xyz) + self.dropped
        xyz = np.zeros((rows, 3), np.float32)
        xyz[self.kept] = self.xyz
        if self.reflectance is None:
            return Points(xyz, cloud=self.cloud)
        reflectance = np.zeros(rows, np.float32)
        reflectance[self.kept] = self.reflectance
        return Points(xyz, reflectance, cloud=self.cloud)


def check_xyz(xyz: ndarray) -> None:
    """Refuse coordinates of another shape than (N, 3), such as rows of KITTI's four numbers."""
    if xyz.shape[1:] != (3,):
        raise InputError(f"xyz must have the shape (N, 3), as points[:, :3]; found {xyz.shape}.")


def role_of(name: str) -> str | None:
    """What a field of this name is, a key of `_ROLES`; None if it is nothing of these.

    Names are compared without case and without CloudCompare's prefix `scalar_`.
    """
    return _ROLE_OF.get(_plain(name))


def places_of(names: Sequence[str], role: str) -> list[int]:
    """The numbers of the fields of a role, a key of `_ROLES`, in the order of its names there."""
    plain = [_plain(name) for name in names]
    return [plain.index(alias) for alias in _ROLES[role] if alias in plain]


def _plain(name: str) -> str:
    return name.lower().removeprefix("scalar_")


def is_renaming(columns: Sequence[str] | None) -> bool:
    """Whether columns rename fields, as `intensities=reflectance`, instead of naming all."""
    return any("=" in str(name) for name in columns or ())


def check_columns(columns: Sequence[str] | None) -> None:
    """Refuse names of columns without exactly one x, y and z, and renames to no known role."""
    names = [str(name).lower() for name in columns or "xyz"]
    if is_renaming(columns):
        pairs = [name.rpartition("=") for name in names]
        if any(not field or (role != "_" and not role_of(role)) for field, _, role in pairs):
            raise InputError(
                "columns rename fields to x, y, z, reflectance, ring, time or, if unused, _, as "
                f"intensities=reflectance,channel=_; found {','.join(names)[:80]}."
            )
        return
    roles = [role for role in map(role_of, names) if role in _ONCE]
    if len(set(roles)) < len(roles) or not set("xyz").issubset(roles):
        raise InputError(
            "columns must name x, y and z, and intensity and ring at most once, as "
            f"x,y,z,intensity,_; found {','.join(names)[:80]}."
        )


def renamed(names: Sequence[str], columns: Sequence[str] | None) -> list[str]:
    """The names of a file's fields after its user's renames, which precede the usual names.

    Raises:
        InputError: The file lacks such a field, or `columns` are no renames.
    """
    if not columns:
        return list(names)
    if not is_renaming(columns):
        raise InputError(
            "it names its columns: leave --columns (data.reading.columns) out, or rename some, as "
            "--columns intensities=reflectance."
        )
    pairs = [str(name).rpartition("=") for name in columns]
    roles = {_plain(field.strip()): role.strip() for field, _, role in pairs}
    plain = [_plain(name) for name in names]
    _refuse_missing([field for field in roles if field not in plain], names)
    taken = {role_of(role) for role in roles.values()} - {None}
    return [roles.get(name, "_" if role_of(name) in taken else name) for name in plain]


def _refuse_missing(missing: Sequence[str], names: Sequence[str]) -> None:
    if missing:
        listed = " ".join(", ".join(names)[:120].split()) or "none"
        raise InputError(f"it has no field {', '.join(missing)}; it has: {listed}.")


def column_points(names: Sequence[str], columns: Sequence[ndarray], raw: bool = False) -> Points:
    """The finite points within `FARTHEST` from all columns of a file, (N,) each.

    Args:
        raw: Whether the file has no header. Then it is also refused if most rows are not finite or
            if reflectances are negative, as in another row layout.

    Raises:
        NoPointsError: There are no points, or only rays without return.
        InputError: The columns hold no numbers, or numbers that are no scan.
    """
    roles = {role: [columns[place] for place in places_of(names, role)] for role in _ONCE}
    _refuse_missing([role for role in "xyz" if not roles[role]], names)
    for column in chain(*roles.values()):
        if column.ndim != 1 or column.dtype.kind not in "fiub":
            raise InputError(f"it holds {column.dtype} in the place of one number a point.")
    reflectance = None
    with np.errstate(over="ignore", invalid="ignore"):  # float32 overflow is infinite: dropped
        axes = np.array([roles[axis][0] for axis in "xyz"], dtype=np.float32)
        size = abs(axes).max(axis=0)
        finite = np.isfinite(size)
        if roles["reflectance"]:
            reflectance = np.array(_first_filled(roles["reflectance"]), dtype=np.float32)
            finite &= np.isfinite(reflectance)
    _check_values(size, reflectance, finite, raw)
    kept = np.flatnonzero(finite & (size <= FARTHEST))
    dropped = len(size) - len(kept)
    return Points(
        np.ascontiguousarray(axes.T[kept]),
        None if reflectance is None else reflectance[kept],
        _ring_numbers(roles["ring"][0][kept]) if roles["ring"] else None,
        dropped,
        kept if dropped else None,
    )


def _first_filled(columns: Sequence[ndarray]) -> ndarray:
    """The first of some columns that is not 0 throughout, as what was not measured is; else the
    first.
    """
    return next((column for column in columns if column.any()), columns[0])


def _check_values(size: ndarray, reflectance: ndarray | None, finite: ndarray, raw: bool) -> None:
    """Refuse rows, by their largest coordinate and their reflectance, that are no scan."""
    rows = len(size)
    count = np.count_nonzero(finite)
    returned = size[finite & (size > 0)]  # organised scans store rays without return as (0, 0, 0)
    if not len(returned) and (count or not rows):
        raise NoPointsError(
            f"it holds no point, only {rows} rays without return: leave it out."
            if rows
            else "it holds no points: leave it out."
        )
    far = np.count_nonzero(returned > FARTHEST)
    near = np.count_nonzero(returned < NEAREST)
    # A limit of 1/20, so that flipped bits lose only their points. Of float64 read as float32, 1/3
    # is beyond.
    wrong = count == 0 or far > len(returned) / 20 or near > len(returned) / 2
    negative = np.int_(0)
    if raw and reflectance is not None:
        # Rows of three or five floats read as four have coordinates as reflectance, half negative;
        # an integer is tiny.
        negative = np.count_nonzero(finite & (reflectance < 1e-30) & (reflectance != 0))
    if wrong or negative > count / 20 or (raw and count < rows / 2):
        raise InputError(
            f"it does not look like a scan: of {rows} rows, {rows - count} are NaN or infinite, "
            f"{far} lie beyond {FARTHEST:g} m, {near} within {NEAREST:g} m and {negative} have a "
            "negative or integer reflectance. Is it damaged, not in metres, big-endian, or of "
            "other columns (--columns)?"
        )


def warn_of_unused(
    path: Path, names: Sequence[str], columns: Sequence[ndarray], points: Points
) -> None:
    """Warn, once per folder, of fields that may be the reflectance that a scan lacks."""
    if points.reflectance is not None and points.reflectance.any():
        return
    unused = [
        name
        for name, column in zip(names, columns, strict=True)
        if not role_of(name)
        and _LIKE_REFLECTANCE.search(_plain(name))
        and not _OF_IT.search(_plain(name))
        and column.ndim == 1
        and column.dtype.kind in "fiu"
    ]
    if unused:
        listed = ", ".join(unused)[:120]
        kind = (
            f"it has no reflectance, and these fields are not used: {listed}. "
            f"--columns {unused[0]}=reflectance (of r2flow.read columns) takes one"
        )
        warn_odd(path, kind)


def _ring_numbers(ring: ndarray) -> ndarray:
    with np.errstate(invalid="ignore"):
        numbers = ring.astype(np.uint16)
    if (numbers != ring).any():
        raise InputError("it has a ring number that is not whole, from 0 to 65535. Is it damaged?")
    return numbers
