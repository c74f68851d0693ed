"""Points as columns: text (.csv, .xyz, .txt), NumPy archives (.npz), Arrow tables (.feather, .parquet), LAS and LAZ."""

import importlib
import re
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files.arrays import Columns, named_already, read_array, table_columns
from r2flow.lidar.scan_files.fields import (
    ROLES,
    PointField,
    column_points,
    named_roles,
    point_count,
    text_columns,
    text_lines,
    usual_names,
)
from r2flow.lidar.scan_files.points import Points

INSTALL = "python -m pip install 'r2flow[formats]'"
MOST_POINTS = 1 << 24  # of a compressed file, whose size says little: thirty times the scan of 128 beams
MOST_UNPACKED = 100  # times its own size that a compressed file may hold
TABLES = ("points", "xyz", "point_cloud", "pointcloud", "cloud", "pts", "lidar", "scan", "data", "arr_0")


def read_text(path: Path, columns: Columns = None) -> Points:
    """One point a line, numbers apart by commas, semicolons, tabs or spaces; names in the first line are read."""
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    head = content[: content.find(b"\n") + 1]
    with suppress(UnicodeDecodeError):  # a unit among the names, as degrees
        if not head.isascii():
            content = head.decode("utf-8").encode("ascii", "replace") + content[len(head) :]
    lines = text_lines(path, content)
    width = next((len(_words(line)) for line in lines if line.lstrip()[0] not in "#/"), 0)
    lines = [line for line in lines if line.lstrip()[0] not in "#/" or _is_header(line, width)]
    if not lines:
        raise InputError(f"{path} holds no line of numbers.")
    words = _words(lines[0])
    if any(not _is_number(word) for word in words):
        if columns is not None:
            raise named_already(path)
        names: Sequence[str] = [re.sub(r"\s*[\[(].*", "", word) for word in words]
        lines = lines[1:]
    else:
        names = usual_names(path, len(words), columns)
    roles = named_roles(path, names)
    point_count(path, len(lines))
    apart = _apart(lines[0])
    fields = [PointField(name, np.dtype("<f8")) for name in names]

    def columns_of(some: Sequence[str]) -> dict[str, np.ndarray]:
        return text_columns(path, [line.replace(apart, " ") for line in some], fields, roles)

    try:
        found = columns_of(lines)
    except InputError:  # looked for there alone: in all tables it would take a fifth of the time
        filled = [_filled(line, apart, len(names)) for line in lines]
        if filled == lines:
            raise
        found = columns_of(filled)
    return column_points(path, found)


def _is_header(line: str, width: int) -> bool:
    """Whether a comment holds the names of the columns, which CloudCompare writes behind // and numpy behind #.

    Args:
        width: How many numbers the lines have.
    """
    if re.match(r'[\s#/]*"?x\b', line.lower()):
        return True
    names = [word.lower() for word in _words(line)]
    return len(names) == width and {"x", "y", "z"} <= set(names)


def _apart(line: str) -> str:
    """What stands between two numbers."""
    return next((mark for mark in ";\t," if mark in line), " ")


def _filled(line: str, apart: str, count: int) -> str:
    """A line with nan in the place of a number that is missing, as tables write a ray without return.

    Args:
        count: Numbers of a line; one more separator at its end separates nothing.
    """
    if apart == " " or not (apart + apart in line or line[0] == apart or line.rstrip("\r ")[-1] == apart):
        return line
    words = [word.strip() for word in line.split(apart)]
    words = words[:-1] if len(words) == count + 1 and not words[-1] else words
    return apart.join(word or "nan" for word in words)


def _words(line: str) -> list[str]:
    text = line.strip().lstrip("#/").strip()
    parts = text.split(_apart(text)) if _apart(text) != " " else text.split()
    return [part.strip().strip('"') for part in parts]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_npz(path: Path, columns: Columns = None) -> Points:
    """An archive of arrays: one of points, (N, 3) or more, or one a column, named x, y, z, ...; never unpickles."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            size = sum(info.file_size for info in members.values())
            if size > MOST_UNPACKED * path.stat().st_size + (1 << 20):
                raise InputError(f"{path} unpacks to {size:,} bytes, far more than its own size. Is it damaged?")
            found = {}
            for name in _wanted(path, list(members)):
                with archive.open(members[name]) as file:
                    found[name] = read_array(path, file, members[name].file_size)
    except InputError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is not a readable .npz file ({reason[:120]}). Is it damaged?") from None
    table = next((name for name in found if found[name].ndim == 2 or found[name].dtype.names), None)
    if table is None:
        if columns is not None:
            raise named_already(path)
        roles = {role: found[list(found)[index]] for role, index in named_roles(path, list(found)).items()}
    else:
        roles = table_columns(path, found.pop(table), columns)
        roles |= {role: array for role, array in _roles_beside(path, found).items() if role not in roles}
    rows = roles["x"].shape
    if len(rows) != 1 or any(array.shape != rows or array.dtype.kind not in "fiu" for array in roles.values()):
        shapes = ", ".join(f"{role} {array.shape} {array.dtype}" for role, array in roles.items())
        raise InputError(f"{path} holds arrays that are no columns of the same points: {shapes}.")
    return column_points(path, roles)


def _wanted(path: Path, names: list[str]) -> list[str]:
    """The arrays to read: a table by its usual name, or the only one, and columns beside it; else all columns."""
    lower = {name.lower(): name for name in names}
    table = next((lower[name] for name in TABLES if name in lower), names[0] if len(names) == 1 else None)
    beside = [lower[name] for name in (*ROLES["reflectance"], *ROLES["ring"]) if name in lower]
    if table is None and not {"x", "y", "z"} <= lower.keys():
        found = ", ".join(names)[:120] or "nothing"
        raise InputError(f"{path} holds {found}: no array of points, as {', '.join(TABLES[:3])}, nor x, y and z.")
    return [*([table] if table else [lower[axis] for axis in "xyz"]), *beside]


def _roles_beside(path: Path, found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns that lie beside a table of points."""
    names = [*"xyz", *found]
    return {role: found[names[i]] for role, i in named_roles(path, names).items() if names[i] in found}


def read_arrow(path: Path, columns: Columns = None) -> Points:
    """Columns x, y, z and, where present, intensity and ring (laser_number) of an Arrow table: Argoverse 2's lidar."""
    if columns is not None:
        raise named_already(path)
    pyarrow = _extra("pyarrow", path)
    try:
        if path.name.lower().endswith(".parquet"):
            file = importlib.import_module("pyarrow.parquet").ParquetFile(path)
            names, rows = file.schema_arrow.names, file.metadata.num_rows
            _refuse_many(path, rows)
            roles = named_roles(path, names)
            table = file.read([names[index] for index in roles.values()])
        else:
            wanted = importlib.import_module("pyarrow.feather")
            with pyarrow.memory_map(str(path)) as source:
                names = pyarrow.ipc.open_file(source).schema.names
            roles = named_roles(path, names)
            table = wanted.read_table(path, [names[index] for index in roles.values()], memory_map=False)
            _refuse_many(path, table.num_rows)
        table.validate(full=True)
        point_count(path, table.num_rows)
        arrays = {role: table.column(names[index]).to_numpy() for role, index in roles.items()}
    except (pyarrow.ArrowException, OSError, MemoryError, ValueError, KeyError, TypeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is not a readable Arrow table ({reason[:120]}). Is it damaged?") from None
    wrong = [role for role, array in arrays.items() if array.dtype.kind not in "fiu"]
    if wrong:
        raise InputError(f"{path}: {', '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} no numbers, one a point.")
    return column_points(path, arrays)


def read_las(path: Path, columns: Columns = None) -> Points:
    """LAS and LAZ by laspy: scaled x, y, z, intensity and, where a unit wrote it, ring. In the sensor's frame only."""
    if columns is not None:
        raise named_already(path)
    laspy = _extra("laspy", path)
    _refuse_records(path)
    try:
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            count, header = reader.header.point_count, reader.header
            _refuse_many(path, count)
            if not header.are_points_compressed and count * header.point_format.size > path.stat().st_size:
                raise InputError(f"{path} declares {count} points, more than its bytes hold. Is it whole?")
            if header.are_points_compressed:
                _refuse_chunks(path, header.offset_to_point_data)
            point_count(path, count)
            points = reader.read()
        if len(points.points) != count:
            raise InputError(f"{path} declares {count} points but holds {len(points.points)}. Is it whole?")
        roles = {axis: np.asarray(points[axis]) for axis in "xyz"}
        for role, index in named_roles(path, names := list(points.point_format.dimension_names)).items():
            roles.setdefault(role, np.asarray(points[names[index]]))
    except InputError:
        raise
    except MemoryError:
        raise InputError(f"{path} declares more points than fit into memory. Is it damaged?") from None
    except Exception as error:  # laspy and its decoders raise many kinds on damaged files
        if "LazBackend" in str(error):
            raise InputError(f"{path}: .laz files need lazrs: {INSTALL}.") from None
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} is not a readable LAS file ({reason[:120]}). Is it damaged?") from None
    for role in [role for role in roles if role.startswith("reflectance") and not roles[role].any()]:
        del roles[role]  # LAS has a field for it whether or not a sensor measured it
    return column_points(path, roles)


def _refuse_records(path: Path) -> None:
    """Refuse more records in a LAS header than fit into the file: laspy would go through all that it declares."""
    with path.open("rb") as file:
        head = file.read(375).ljust(375, b"\0")
    records = 54 * int.from_bytes(head[100:104], "little")
    if head[24:26] == b"\x01\x04":
        records += 60 * int.from_bytes(head[243:247], "little")
    if head[:4] != b"LASF" or records > path.stat().st_size:
        raise InputError(f"{path} is not a LAS file, or its header is damaged.")


def _refuse_chunks(path: Path, start: int) -> None:
    """Refuse compressed points of more chunks than the file has bytes: lazrs ends the process where memory is short.

    Points begin with the place of the chunk table, int64, or -1 where it is in the last 8 bytes; the table with its
    version and its number of chunks, uint32 each.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        for place in (start, size - 8):
            file.seek(min(max(place, 0), size))
            table = int.from_bytes(file.read(8), "little", signed=True)
            if table != -1:
                break
        file.seek(min(max(table, 0), size))
        head = file.read(8)
    if len(head) < 8 or int.from_bytes(head[4:], "little") > size:
        raise InputError(f"{path} has a damaged table of compressed points.")


def _refuse_many(path: Path, count: int) -> None:
    """Refuse more points than a scan has, or than a file of its size holds, by 8 bytes each."""
    if not 0 <= count <= min(MOST_POINTS, (MOST_UNPACKED * path.stat().st_size + (1 << 20)) // 8):
        raise InputError(f"{path} declares {count:,} points, more than one scan has. Is it damaged, or a whole map?")


def _extra(name: str, path: Path) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError:
        ending = path.suffix.lower()
        raise InputError(f"{path}: {ending} files need {name}: {INSTALL}.") from None
