"""Readers of columns: rows of floats, NumPy's .npy and .npz, text, Arrow tables and LAS."""

import io
import math
import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import check, require
from r2flow.lidar.scan_files.clouds import Table
from r2flow.lidar.scan_files.points import MOST_COLUMNS, ROLES, find_roles

TABLES = ("points", "xyz", "point_cloud", "pointcloud", "cloud", "pts", "lidar", "scan", "data", "arr_0")


def read_rows(path: Path, columns: Sequence[str] | None) -> list[np.ndarray]:
    """Rows of little-endian float32: as many as `columns`, or 4 of KITTI."""
    content = path.read_bytes()
    head = content[:64]
    text = (head and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in head)) or head.startswith(b"\x93NUMPY")
    check(not text, f"it is not rows of float32: it begins with {head[:16]!r}, as text or another format.")
    width = 4 if columns is None else len(columns)
    rows, rest = divmod(len(content), 4 * width)
    known = {4: "the 4 of KITTI (.bin)", 5: "the 5 of nuScenes: give --columns x,y,z,intensity,ring"}
    other = next((f", but of {words}" for count, words in known.items() if len(content) % (4 * count) == 0), "")
    check(rest == 0, f"it is not made of rows of {width} float32{other}: {rest} bytes are left. Is it cut short?")
    table = np.frombuffer(content, "<f4").reshape(rows, width)
    for every in (2, 3, 4) if columns is None and rows >= 1000 else ():  # 8 to 16 floats a point, as in PCL's memory
        parts = table[every * np.random.default_rng(0).integers(rows // every, size=500) + np.c_[:every]]
        below = [(part[:, :2] < 0).any(axis=1).mean() or (part == 0).all() for part in parts]  # lost rays are zeros
        names = ",".join([*"xyz", *"_" * (len(np.unique(parts[0, :, 3])) == 1), "intensity", *"_" * 16][: 4 * every])
        check(all(below[1:]) or below[0] < 0.3, f"a point seems to be of {4 * every} floats: give --columns {names}.")
    return list(table.T)


def read_npy(path: Path) -> Table:
    """An array (N, 3) or wider, or with named fields."""
    with path.open("rb") as file:
        return _columns_of(read_array(file, path.stat().st_size))


def read_npz(path: Path) -> Table:
    """An archive with an array of points, by a usual name or as its only member, and further columns; or of columns."""
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        check_unpacked(path, sum(info.file_size for info in members.values()))
        lower = {name.lower(): name for name in members}
        alone = next(iter(members)) if len(members) == 1 else None
        usual = () if {"x", "y", "z"} <= lower.keys() else TABLES
        table = next((lower[name] for name in usual if name in lower), alone)
        others = [name for name in _named(members) if name != table]
        arrays = {}
        for name in [*([table] if table else []), *others]:
            with archive.open(members[name]) as file:
                arrays[name] = read_array(file, members[name].file_size)
    if table is None:
        return others if len(others) > 2 else list(members), list(arrays.values())  # fewer: refused, with all names
    names, fields = _columns_of(arrays.pop(table))
    if names is None and others:
        names = list(usual_names(len(fields), None))
    return [*names, *others] if names else None, [*fields, *arrays.values()]


def _named(names: Iterable[str]) -> list[str]:
    """The names that are columns of points."""
    roles = {alias for aliases in ROLES.values() for alias in aliases}
    return [name for name in names if name.lower().removeprefix("scalar_") in roles]


def read_array(file: IO[bytes], size: int) -> np.ndarray:
    """The array of numbers in an open .npy of `size` bytes, read without unpickling or allocating more than that."""
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = header(file)
    check(not dtype.hasobject, "it holds objects, not numbers.")
    declared, present = math.prod(shape) * dtype.itemsize, size - file.tell()
    check(declared == present, f"it declares the shape {shape} of {dtype}, but {present} bytes follow. Is it damaged?")
    return np.frombuffer(file.read(), dtype).reshape(shape, order="F" if fortran_order else "C")


def _columns_of(array: np.ndarray) -> Table:
    if array.dtype.names is not None:
        return list(array.dtype.names), [array[name] for name in array.dtype.names]
    check(
        array.ndim == 2 and array.dtype.kind in "fiu" and array.shape[1] <= MOST_COLUMNS,
        f"it holds an array {array.shape} of {array.dtype}, not points: these are (N, 3) or (N, 4), x y z reflectance.",
    )
    return None, list(array.T)


def read_text(path: Path) -> Table:
    """A point per line, separated by commas, semicolons, tabs or spaces; names in the first line or a comment."""
    text = path.read_text("utf-8-sig", "replace").replace('"', "")
    lines = [line.strip(" \r") for line in text.split("\n") if line.strip()]
    rows = [line for line in lines if line[0] not in "#/"]
    if rows[:1] in ([str(len(rows) - 1)], ["0,1,2"], ["0,1,2,3"]):  # the number of points; pandas' names
        del rows[0]
    check(rows, "it holds no line of numbers.")
    apart = next((mark for mark in ";\t," if mark in rows[-1]), None)
    decimal = r"\d,\d+(e[-+]?\d+)? +-?\d+,\d" if apart == "," else r"(^|[;\t] *)-?\d+,\d+ *($|[;\te])"
    check("." in rows[-1] or not re.search(decimal, rows[-1], re.I), "it has decimal commas: write decimal points.")

    def words(line: str) -> list[str]:
        return [re.sub(r"\s*[\[(](?!([cmk]m|ft)\b).*", "", word.strip()) for word in line.lstrip("#/ ").split(apart)]

    names: list[str] | None
    if not any(map(_is_number, words(rows[0]))):
        names, rows = words(rows[0]), rows[1:]
        check(rows, "it holds no line of numbers.")
    else:  # CloudCompare writes names after //, NumPy after #
        width, comments = len(words(rows[0])), [words(line) for line in lines if line[0] in "#/"]
        names = next((line for line in comments if len(line) == width and _named(line)), None)
    try:
        table = np.loadtxt(rows, delimiter=apart, comments=None, ndmin=2)
    except ValueError:
        if apart is None:
            raise
        # Slower; empty values, as of rays without return, and words become NaN.
        table = np.genfromtxt(rows, delimiter=apart, comments=None, ndmin=2)  # type: ignore[call-overload]
    check(not names or len(names) >= len(table.T) or np.isnan(table[:, -1]).all(), "rows are longer than the names.")
    return names, list(table.T)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_arrow(path: Path) -> Table:
    """A Feather or Parquet table: Argoverse 2's lidar."""
    require(str(path), "formats", "pyarrow")
    import pyarrow
    from pyarrow import feather, parquet

    if path.name.lower().endswith(".parquet"):
        file = parquet.ParquetFile(path)
        check_unpacked(path, 8 * file.metadata.num_rows)  # run-length encoded values take no bytes
        find_roles(file.schema_arrow.names)  # refuses a table with all of its names
        table = file.read(_named(file.schema_arrow.names))
    else:
        with pyarrow.memory_map(str(path)) as source:
            find_roles(names := pyarrow.ipc.open_file(source).schema.names)
        table = feather.read_table(path, _named(names), memory_map=False)
    table.validate(full=True)
    return table.column_names, [column.to_numpy() for column in table.columns]


def read_las(path: Path) -> Table:
    """LAS, read with laspy: scaled x, y, z in the sensor's frame, intensity if measured, extra fields."""
    require(str(path), "formats", "laspy")
    import laspy

    content = path.read_bytes()
    records = 54 * int.from_bytes(content[100:104], "little")
    records += 60 * int.from_bytes(content[243:247], "little") if content[24:26] == b"\x01\x04" else 0
    check(content[:4] == b"LASF" and records <= len(content), "it is not a LAS file, or its header is damaged.")
    # Read from memory, which limits the size: laspy allocates what a header declares.
    with laspy.open(io.BytesIO(content), laz_backend=(), read_evlrs=False) as reader:
        header = reader.header
        check_unpacked(path, header.point_count * header.point_format.size)
        check(not header.are_points_compressed, "its points are compressed: uncompress them by laszip.")
        points = reader.read()
    check(len(points.points) == header.point_count, f"it declares {header.point_count} points. Is it whole?")
    extra = [name for name in points.point_format.dimension_names if name not in ("X", "Y", "Z")]
    extra = [name for name in extra if name != "intensity" or np.asarray(points[name]).any()]
    names = ["x", "y", "z", *extra]
    return names, [np.asarray(points[name]) for name in names]


READERS = {
    ".npy": read_npy, ".npz": read_npz, **dict.fromkeys((".csv", ".xyz", ".txt"), read_text),
    **dict.fromkeys((".feather", ".parquet"), read_arrow), ".las": read_las,
}  # fmt: skip


def check_unpacked(path: Path, size: int) -> None:
    """Refuse a compressed file that declares far more bytes than its size allows."""
    most = 100 * path.stat().st_size + (1 << 20)  # bytes: points do not pack as well
    check(0 <= size <= most, f"it unpacks to {size:,} bytes, far more than its own size. Is it damaged?")


def usual_names(width: int, columns: Sequence[str] | None) -> Sequence[str]:
    """Names of the columns of a file without names: `columns`, else x, y, z and, for four columns, reflectance."""
    if columns is not None:
        check(len(columns) == width, f"it has {width} columns, but {len(columns)} were named: {','.join(columns)}.")
        return columns
    example = ",".join(["x", "y", "z", "intensity", *("_" * width)][:width])
    check(2 < width < 5, f"{width} columns without names: give --columns {example} (data.reading.columns=[{example}]).")
    return ("x", "y", "z", "reflectance")[:width]
