"""Readers of columns: rows of floats, NumPy's .npy, text, Arrow tables and LAS."""

import io
import re
from collections.abc import Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, check, require
from r2flow.lidar.scan_files.cloud import Cloud
from r2flow.lidar.scan_files.points import is_renaming, role_of
from r2flow.lidar.scan_files.widths import fits_width, fitting_widths


@dataclass(frozen=True)
class _TextForm:
    """How the lines of a text file are written."""

    separator: str
    prefix: str  # before the names, as of a comment


_NUMBER = re.compile(r"(^|[;,\s])[-+]?(\.?\d|nan\b|inf\b)", re.IGNORECASE)
_LARGEST = 1 << 30  # bytes of the points of a compressed file
KEPT = 4  # files last read, which are looked at several times: for their sensor, their reflectance
_KITTI = ("x", "y", "z", "reflectance")
_NUSCENES = ("x", "y", "z", "intensity", "ring")
_NPY = np.lib.format.MAGIC_PREFIX[:4]
_WIDEST = 32  # columns of points; a wider array is an image
_UNIT = re.compile(r"\s*[\[(](?!([cmk]m|ft)\b).*")  # other units than metres stay: not a known name


def read_rows(path: Path, columns: Sequence[str] | None) -> Cloud:
    """Rows of little-endian float32: as many as `columns`, or nuScenes' 5 or KITTI's 4.

    Raises:
        InputError: The file is not made of such rows, or without `columns` of others.
    """
    names: Sequence[str] = _NUSCENES if path.name.lower().endswith(".pcd.bin") else _KITTI
    if columns is not None:
        names = column_names(len(columns), columns)
    width = len(names)
    left = path.stat().st_size % (4 * width)
    values = np.fromfile(path, "<f4")
    check(values[:1].tobytes() != _NPY, "it is a .npy file: rename it.")
    if left or not (columns or fits_width(values, width)):
        _refuse_other_rows(path, width)
    if left:
        raise InputError(
            f"it is not made of rows of {width} float32: {left} bytes are left. Is it cut short, "
            "or of other columns (--columns x,y,z,intensity,ring)?"
        )
    return Cloud(tuple(names), tuple(values.reshape(-1, width).T), held=width)


def _refuse_other_rows(path: Path, width: int) -> None:
    """Refuse a file if rows of another width, or of other floats, are the only ones that fit."""
    fitting = fitting_widths(np.fromfile(path, "<f4"))
    if len(fitting) == 1 and fitting != [width]:
        names = ["x", "y", "z", "intensity", *"_" * _WIDEST][: fitting[0]]
        raise InputError(
            f"it is made of rows of {fitting[0]} float32, not {width}: name all by --columns "
            f"{','.join(names)} (_ for what is not used)."
        )
    others = {"<f8": "float64", "<f2": "float16", ">f4": "big-endian float32"}
    for kind, named in {} if fitting else others.items():
        if widths := fitting_widths(np.fromfile(path, kind)):
            raise InputError(
                f"it is made of rows of {widths[0]} {named}, not float32: convert it, as "
                f"numpy.fromfile(FILE, '{kind}').astype('<f4').tofile(OTHER)."
            )


def state_of(path: Path) -> tuple[int, ...]:
    """What changes with a file; empty without one."""
    try:
        stat = path.stat()
    except (OSError, ValueError):  # the reader reports it
        return ()
    return stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def read_array(path: Path) -> ndarray:
    """The array of numbers in a .npy, read-only, without unpickling or allocating what a header
    declares.
    """
    return _read_array(path, state_of(path))


@lru_cache(KEPT)
def _read_array(path: Path, state: tuple[int, ...]) -> ndarray:
    with np.errstate(over="raise"):
        mapped = np.lib.format.open_memmap(path, mode="r")
    whole = mapped.offset + mapped.nbytes == path.stat().st_size
    check(whole, f"it is longer than its header declares: {mapped.shape}. Is it damaged?")
    array = np.array(mapped)
    array.flags.writeable = False
    return array


def _read_npy(path: Path) -> Cloud:
    """An array (N, 3) or wider, or with named fields."""
    array = read_array(path)
    if array.dtype.names is not None:
        return Cloud.of(array)
    if array.ndim != 2 or array.shape[1] > _WIDEST:
        raise InputError(
            f"it holds an array {array.dtype} {array.shape}, not points: these are (N, 3) or "
            "(N, 4). Range images are floats (2, H, W), range in metres and reflectance, or "
            "(1, H, W)."
        )
    return Cloud((), tuple(array.T), held=array.shape[1])


def _read_text(path: Path) -> Cloud:
    """A point per line, separated by commas, semicolons, tabs or spaces.

    Names stand in the first line, or in the comment before it. Columns without decimal points are
    integers of 4 bytes, or else 8, but for coordinates.
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
    stored = tuple(word.strip() for word in words)
    names = [_UNIT.sub("", word) for word in stored]
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
    form = _TextForm(separator or " ", head[: len(head) - len(head.lstrip("#/ "))])
    if in_comment and (len(words) != width or not any(map(role_of, names))):
        return Cloud((), tuple(table.T), header=form, held=width)
    if len(words) < width and not np.isnan(table[:, -1]).all():
        raise InputError("rows are longer than the names.")
    columns = [*table.T][: len(names)]  # without those of separators at the end
    for place, (name, column) in enumerate(zip(names, columns, strict=False)):
        if not _is_axis(name) and (column % 1 == 0).all():
            with suppress(ValueError):  # a number has a decimal point
                whole = np.loadtxt(
                    rows, np.int64, delimiter=separator, comments=None, usecols=place, ndmin=1
                )
                short = whole.astype(np.int32)  # the one that a PointCloud2 can hold
                columns[place] = short if (short == whole).all() else whole
    return Cloud(stored[:width], tuple(columns), tuple(names[:width]), header=form)


def _is_axis(name: str) -> bool:
    return role_of(name) in ("x", "y", "z")


def _read_arrow(path: Path) -> Cloud:
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
    columns = tuple(column.to_numpy() for column in table.columns)
    return Cloud(tuple(table.column_names), columns, header=stored.schema)


def _read_las(path: Path) -> Cloud:
    """LAS and LAZ, read with laspy: scaled x, y, z, and all other fields."""
    compressed = path.suffix.lower() == ".laz"
    require(str(path), "formats", "laspy", *(["lazrs"] if compressed else []))
    import laspy

    content = path.read_bytes()
    # laspy allocates what a header declares
    records = 54 * int.from_bytes(content[100:104], "little")
    if content[24:26] == b"\x01\x04":
        records += 60 * int.from_bytes(content[243:247], "little")
    if records > len(content):
        raise InputError("its header is damaged.")
    backend = laspy.LazBackend.Lazrs if compressed else ()
    with laspy.open(io.BytesIO(content), laz_backend=backend, read_evlrs=False) as reader:
        header = reader.header
        most = _LARGEST if compressed else len(content)
        if header.point_count * header.point_format.size > most:
            raise InputError(
                f"it is too small for the {header.point_count} points that it declares."
            )
        points = reader.read()
    names = ["x", "y", "z", *(n for n in points.point_format.dimension_names if n not in "XYZ")]
    columns = tuple(np.asarray(points[name]) for name in names)
    # Fields of every file, which few fill.
    aliases = (n if c.any() else "_" for n, c in zip(names, columns, strict=True))
    return Cloud(tuple(names), columns, ("x", "y", "z", *list(aliases)[3:]), header=header)


READERS = {
    ".npy": _read_npy,
    ".csv": _read_text,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".feather": _read_arrow,
    ".parquet": _read_arrow,
    ".las": _read_las,
    ".laz": _read_las,
}


def column_names(width: int, columns: Sequence[str] | None) -> Sequence[str]:
    """Names of the columns of a file without names.

    They are `columns`, else x, y, z and, for four columns, reflectance.
    """
    if is_renaming(columns):
        raise InputError("it does not name its columns: name all, as --columns x,y,z,intensity.")
    names = columns or _KITTI[: max(width, 3)]
    if len(names) != width:
        named = ",".join(["x", "y", "z", "intensity", *"_" * width][: max(width, 3)])
        raise InputError(
            f"it has {width} columns, not {len(names)}: name all by --columns {named} "
            f"(data.reading.columns=[{named}])."
        )
    return names


def write_las(file: IO[bytes], cloud: Cloud, compressed: bool) -> None:
    """Write a cloud that `_read_las` read, with its header; further fields are extra bytes."""
    import laspy

    rows = cloud.array()
    header = deepcopy(cloud.header)
    known = {"x", "y", "z", *header.point_format.dimension_names}
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, rows.dtype[name])
            for name in rows.dtype.names or ()
            if name not in known
        ]
    )
    points = laspy.ScaleAwarePointRecord.zeros(len(rows), header=header)
    las = laspy.LasData(header, points)
    for name in rows.dtype.names or ():
        las[name] = rows[name]
    content = io.BytesIO()
    backend = laspy.LazBackend.Lazrs if compressed else None
    las.write(content, do_compress=compressed, laz_backend=backend)
    file.write(content.getbuffer())


def write_arrow(file: IO[bytes], cloud: Cloud, ending: str) -> None:
    """Write a Feather or Parquet table with the types and notes of the one that was read."""
    import pyarrow
    from pyarrow import feather, parquet

    types = {field.name: field.type for field in cloud.header}
    arrays = [
        pyarrow.array(column, types.get(name), from_pandas=column.dtype.kind != "f")
        for name, column in zip(cloud.names, cloud.columns, strict=True)
    ]
    table = pyarrow.table(arrays, cloud.names).replace_schema_metadata(cloud.header.metadata)
    (feather.write_feather if ending == ".feather" else parquet.write_table)(table, file)


def write_text(file: IO[bytes], cloud: Cloud) -> None:
    """Write a line per point, each number with as many digits as give it back, below the names.

    Whole floats have a decimal point where `_read_text` would take them for integers.
    """
    form = cloud.header
    if cloud.named:
        file.write(f"{form.prefix}{form.separator.join(cloud.names)}\n".encode())
    columns = []
    for name, column in zip(cloud.meanings, cloud.columns[: cloud.held], strict=False):
        digits = [*map(repr, column.tolist())]
        if not cloud.named or _is_axis(name):
            digits = [number.removesuffix(".0") for number in digits]
        columns.append(digits)
    lines = map(form.separator.join, zip(*columns, strict=True))
    file.writelines(f"{line}\n".encode() for line in lines)


def write_rows(file: IO[bytes], cloud: Cloud) -> None:
    """Write rows of little-endian float32 without names."""
    file.write(np.stack(cloud.columns[: cloud.held], axis=1).astype("<f4").tobytes())


def write_npy(file: IO[bytes], cloud: Cloud) -> None:
    """Write named fields, or rows without names, of the types that were read."""
    if cloud.named:
        np.save(file, cloud.array())
        return
    kind = cloud.columns[0].dtype
    np.save(file, np.stack(cloud.columns[: cloud.held], axis=1).astype(kind))
