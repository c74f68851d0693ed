"""Readers of columns: rows of floats, NumPy's .npy, text, Arrow tables and LAS."""

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, require
from r2flow.lidar.scan_files.clouds import Table
from r2flow.lidar.scan_files.points import is_renaming, role_of
from r2flow.lidar.scan_files.widths import fits_width, fitting_widths

_NUMBER = re.compile(r"(^|[;,\s])[-+]?(\.?\d|nan\b|inf\b)", re.IGNORECASE)
WIDEST = 32  # columns of points; a wider array is an image
_UNIT = re.compile(r"\s*[\[(](?!([cmk]m|ft)\b).*")  # other units than metres stay: not a known name


def read_rows(path: Path, columns: Sequence[str] | None) -> list[ndarray]:
    """Rows of little-endian float32: as many as `columns`, or nuScenes' 5 or KITTI's 4.

    Raises:
        InputError: The file is not made of such rows, or without `columns` of others.
    """
    width = 5 if path.name.lower().endswith(".pcd.bin") else 4
    if columns is not None:
        width = len(usual_names(len(columns), columns))
    size = path.stat().st_size
    values = np.fromfile(path, "<f4")
    if values[:1].tobytes() == np.lib.format.MAGIC_PREFIX[:4]:
        raise InputError("it is a .npy file: rename it.")
    left = size % (4 * width)
    if left or not (columns or fits_width(values, width)):
        fitting = fitting_widths(values)
        if len(fitting) == 1 and fitting != [width]:
            names = ["x", "y", "z", "intensity", *"_" * WIDEST][: fitting[0]]
            raise InputError(
                f"it is made of rows of {fitting[0]} float32, not {width}: name all by --columns "
                f"{','.join(names)} (_ for what is not used)."
            )
    if left:
        raise InputError(
            f"it is not made of rows of {width} float32: {left} bytes are left. Is it cut short, "
            "or of other columns (--columns x,y,z,intensity,ring)?"
        )
    return list(values.reshape(-1, width).T)


def read_array(path: Path) -> ndarray:
    """The array of numbers in a .npy, without unpickling or allocating what a header declares."""
    with np.errstate(over="raise"):
        mapped = np.lib.format.open_memmap(path, mode="r")
    if mapped.offset + mapped.nbytes != path.stat().st_size:
        raise InputError(f"it is longer than its header declares: {mapped.shape}. Is it damaged?")
    return np.array(mapped)


def read_npy(path: Path) -> Table:
    """An array (N, 3) or wider, or with named fields."""
    array = read_array(path)
    if array.dtype.names is not None:
        return list(array.dtype.names), [array[name] for name in array.dtype.names]
    if array.ndim != 2 or array.shape[1] > WIDEST:
        raise InputError(
            f"it holds an array {array.dtype} {array.shape}, not points: these are (N, 3) or "
            "(N, 4). Range images are floats (2, H, W), range in metres and reflectance, or "
            "(1, H, W)."
        )
    return None, list(array.T)


def read_text(path: Path) -> Table:
    """A point per line, separated by commas, semicolons, tabs or spaces.

    Names stand in the first line, or in the comment before it.
    """
    text = path.read_text("utf-8-sig", "replace").replace('"', "")
    lines = [line.strip(" \r") for line in text.split("\n") if line.strip()]
    rows = [line for line in lines if line[0] not in "#/"]
    if rows and rows[0] in (str(len(rows) - 1), "0,1,2", "0,1,2,3"):  # the count; pandas' names
        del rows[0]
    head = next((line for line in reversed(lines) if line[0] in "#/"), "")
    in_comment = not rows or _NUMBER.search(rows[0]) is not None
    if not in_comment:
        head = rows.pop(0)
    if not rows:
        raise InputError("it holds no line of numbers.")
    separator = next((mark for mark in ";\t," if mark in rows[-1]), None)
    words = head.lstrip("#/ ").split(separator)  # CloudCompare writes names after //, NumPy after #
    names = [_UNIT.sub("", word.strip()) for word in words]
    if "X1" in names:  # by ouster-cli
        names = ["ring" if name == "ROW" else name for name in names]
    try:
        table = np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        if separator is None:
            raise
        # Slower; empty values, as of rays without return, and words become NaN.
        table = np.genfromtxt(rows, delimiter=separator, comments=None, ndmin=2)  # type: ignore[call-overload]
    width = table.shape[1]
    if in_comment and (len(words) != width or not any(map(role_of, names))):
        return None, list(table.T)
    if len(words) < width and not np.isnan(table[:, -1]).all():
        raise InputError("rows are longer than the names.")
    return names, list(table.T)


def read_arrow(path: Path) -> Table:
    """A Feather or Parquet table: Argoverse 2's lidar."""
    require(str(path), "formats", "pyarrow")
    from pyarrow import dataset

    stored = dataset.dataset(path, format=path.suffix.lower().removeprefix("."))
    rows = stored.count_rows()
    values = 8 * rows * len(stored.schema.names)
    if values > 100 * path.stat().st_size + (1 << 20):  # run-length encoded values take no bytes
        raise InputError(f"it declares {rows:,} rows, far more than its size. Is it damaged?")
    table = stored.to_table()
    table.validate(full=True)
    return table.column_names, [column.to_numpy() for column in table.columns]


def read_las(path: Path) -> Table:
    """LAS, read with laspy: scaled x, y, z, intensity if measured, and extra fields."""
    require(str(path), "formats", "laspy")
    import laspy

    content = path.read_bytes()
    # laspy allocates what a header declares
    records = 54 * int.from_bytes(content[100:104], "little")
    if content[24:26] == b"\x01\x04":
        records += 60 * int.from_bytes(content[243:247], "little")
    if records > len(content):
        raise InputError("its header is damaged.")
    with laspy.open(io.BytesIO(content), laz_backend=(), read_evlrs=False) as reader:
        header = reader.header
        if header.point_count * header.point_format.size > len(content):
            raise InputError(
                f"it is too small for the {header.point_count} points that it declares."
            )
        points = reader.read()
    names = ["x", "y", "z", *points.point_format.extra_dimension_names]
    if np.any(points["intensity"]):  # a field of every file, which few fill
        names.append("intensity")
    return names, [np.asarray(points[name]) for name in names]


READERS = {
    ".npy": read_npy,
    ".csv": read_text,
    ".xyz": read_text,
    ".txt": read_text,
    ".feather": read_arrow,
    ".parquet": read_arrow,
    ".las": read_las,
}


def usual_names(width: int, columns: Sequence[str] | None) -> Sequence[str]:
    """Names of the columns of a file without names.

    They are `columns`, else x, y, z and, for four columns, reflectance.
    """
    if is_renaming(columns):
        raise InputError("it does not name its columns: name all, as --columns x,y,z,intensity.")
    names = columns or ("x", "y", "z", "reflectance")[: max(width, 3)]
    if len(names) != width:
        raise InputError(
            f"it has {width} columns, not {len(names)}: name all by --columns x,y,z,intensity,_,_ "
            "(data.reading.columns=[x,y,z,intensity,_,_])."
        )
    return names
