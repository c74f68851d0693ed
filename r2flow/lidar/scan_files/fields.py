"""Named fields of PCD and PLY: finding x, y, z among them and reading their columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files.points import NoPointsError, Points, checked_points

# The first name that a file has is taken: Ouster writes both an intensity and a calibrated reflectivity.
ROLES: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "points_m_xyz:0", "points:0"),  # VeloView's
    "y": ("y", "points_m_xyz:1", "points:1"),
    "z": ("z", "points_m_xyz:2", "points:2"),
    "reflectance": ("intensity", "reflectance", "reflectivity", "remission", "i"),
    "ring": ("ring", "laser_number", "laser_id"),  # Argoverse's and VeloView's
}

MOST_COLUMNS = 64  # of a file without names
HEADER_LIMIT = 1 << 16  # bytes; a header has a few hundred


@dataclass(frozen=True)
class PointField:
    """`count` numbers of one type under one name."""

    name: str
    dtype: np.dtype
    count: int = 1

    @property
    def nbytes(self) -> int:
        return self.dtype.itemsize * self.count


def split_header(path: Path, data: bytes, last: str) -> tuple[list[list[str]], int]:
    """The words of each line of a text header, which ends with the line that begins with `last`.

    Returns:
        The lines that are not blank, with the last one, and the offset of the first byte behind them.

    Raises:
        InputError: there is no such line within the first `HEADER_LIMIT` bytes.
    """
    lines: list[list[str]] = []
    start = 0
    while (end := data.find(b"\n", start, HEADER_LIMIT)) >= 0:
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words:
            lines.append(words)
            if words[0] == last:
                return lines, start
    raise InputError(f"{path} has no line {last!r} to end its header. Is it cut short, or another format?")


def whole_number(path: Path, what: str, word: str) -> int:
    """A count from a header.

    Raises:
        InputError: it is not made of decimal digits, or of more than any count has.
    """
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise InputError(f"{path} declares {what} {word[:24]!r}, which is not a whole number. Is it damaged?")
    return int(word)


def point_count(path: Path, count: int) -> int:
    """`count` itself.

    Raises:
        NoPointsError: it is 0.
    """
    if not count:
        raise NoPointsError(f"{path} declares 0 points; leave it out, or fetch it again.")
    return count


def find_roles(path: Path, fields: Sequence[PointField]) -> dict[str, int]:
    """Which field holds x, y, z and, where present, reflectance and ring.

    Other fields that may hold the reflectance are `reflectance N`, with N their number: `column_points` takes one where
    the first is 0 throughout, as an intensity that nobody measured.

    Names are compared without case and without CloudCompare's prefix `scalar_`.

    Raises:
        InputError: x, y or z is missing, a name is there twice, or a field holds several numbers.
    """
    names = [field.name.lower().removeprefix("scalar_") for field in fields]
    roles: dict[str, int] = {}
    for role, aliases in ROLES.items():
        name = next((alias for alias in aliases if alias in names), None)
        if name is None:
            continue
        index = names.index(name)
        if names.count(name) > 1 or fields[index].count != 1:
            raise InputError(f"{path} declares {fields[index].name!r} more than once; one number a point is needed.")
        roles[role] = index
        if role == "reflectance":
            others = [names.index(alias) for alias in aliases if alias != name and names.count(alias) == 1]
            roles |= {f"{role} {n}": n for n in others if fields[n].count == 1}
    missing = [role for role in ("x", "y", "z") if role not in roles]
    if missing:
        found = " ".join(", ".join(field.name for field in fields)[:120].split()) or "none"
        raise InputError(f"{path} has no field {', '.join(missing)}; it has: {found}. Points need x, y and z.")
    return roles


def named_roles(path: Path, names: Sequence[str]) -> dict[str, int]:
    """`find_roles` of columns of one number each."""
    return find_roles(path, [PointField(name, np.dtype("<f8")) for name in names])


def check_columns(columns: Sequence[str] | None) -> None:
    """Refuse names of columns among which x, y and z are not, once each.

    Raises:
        InputError: what was found, and an example.
    """
    if columns is None:
        return
    names = [str(name).lower() for name in columns]
    counts = {role: sum(name in aliases for name in names) for role, aliases in ROLES.items()}
    if max(counts.values()) > 1 or min(counts[axis] for axis in "xyz") < 1 or len(columns) > MOST_COLUMNS:
        raise InputError(
            f"columns must name x, y and z, and intensity and ring at most once, as x,y,z,intensity,_; found "
            f"{','.join(map(str, columns))[:80]}."
        )


def usual_names(path: Path, width: int, columns: Sequence[str] | None) -> Sequence[str]:
    """Names of the columns of a file without any: those given, else x, y, z and perhaps reflectance.

    Raises:
        InputError: others than were given, or more than four of which nobody said what they are.
    """
    if columns is not None:
        if len(columns) != width:
            raise InputError(
                f"{path} has {width} columns, but {len(columns)} were named: {','.join(columns)}. Name each; _ "
                "passes one over."
            )
        return columns
    if width not in (3, 4):
        example = ",".join(["x", "y", "z", "intensity", *("_" * width)][:width])
        raise InputError(
            f"{path} has {width} columns without names. Points need x, y, z and perhaps reflectance: say which is "
            f"which, as --columns {example} (data.columns=[{example}])."
        )
    return ("x", "y", "z", "reflectance")[:width]


def binary_columns(
    payload: memoryview, count: int, fields: Sequence[PointField], roles: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """Views of the wanted columns, (count,) each, of `count` rows in `payload`, whose size has been checked."""
    offsets = list(accumulate((field.nbytes for field in fields), initial=0))
    rows = np.dtype(
        {
            "names": list(roles),
            "formats": [fields[index].dtype for index in roles.values()],
            "offsets": [offsets[index] for index in roles.values()],
            "itemsize": offsets[-1],
        }
    )
    table = np.frombuffer(payload, dtype=rows, count=count)
    return {role: table[role] for role in roles}


def text_columns(
    path: Path, lines: Sequence[str], fields: Sequence[PointField], roles: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """The wanted columns, float64 (len(lines),) each, of lines with one point each.

    Raises:
        InputError: a word that is no number, or a line with another number of words than the fields have.
    """
    offsets = list(accumulate((field.count for field in fields), initial=0))
    try:
        # Every word is parsed, also of unwanted fields, so that a damaged line is found.
        table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2)
    except ValueError as error:
        reason = str(error).split(";")[0].rstrip(".")
        raise InputError(f"{path} has a damaged line among its points: {reason}.") from None
    if table.shape[1] != offsets[-1]:
        raise InputError(f"{path} has {table.shape[1]} numbers a line where its header declares {offsets[-1]}.")
    return {role: table[:, offsets[index]] for role, index in roles.items()}


def text_lines(path: Path, payload: bytes) -> list[str]:
    """The lines of a text body that are not blank.

    Raises:
        InputError: bytes that are not ASCII.
    """
    try:
        return [line for line in payload.decode("ascii").split("\n") if line.strip()]
    except UnicodeDecodeError:
        raise InputError(f"{path} declares text but holds other bytes. Is it damaged, or binary?") from None


def column_points(path: Path, columns: Mapping[str, np.ndarray], layout: str | None = None) -> Points:
    """Points from columns by role, checked; see `checked_points`.

    Raises:
        InputError: a column that does not hold one number a point.
    """
    columns = {role: np.asarray(column) for role, column in columns.items()}
    for role, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in "fiub":
            raise InputError(f"{path} holds {column.dtype} {column.shape[1:]} in the place of one number for {role}.")
    strengths = [column for role, column in columns.items() if role.startswith("reflectance")]
    strength = next((column for column in strengths if column.any()), strengths[0] if strengths else None)
    with np.errstate(over="ignore", invalid="ignore"):  # beyond float32 is infinite, and so dropped
        xyz = np.stack([np.asarray(columns[axis], dtype=np.float32) for axis in ("x", "y", "z")], axis=1)
    return checked_points(path, xyz, strength, columns.get("ring"), layout)
