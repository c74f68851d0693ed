"""Files that are one array: KITTI and nuScenes rows of float32 without a header, and NumPy's .npy."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files.fields import (
    MOST_COLUMNS,
    PointField,
    column_points,
    find_roles,
    named_roles,
    usual_names,
)
from r2flow.lidar.scan_files.points import Points, checked_points

Columns = Sequence[str] | None  # names of the columns of a file that does not name them itself

KITTI = "KITTI rows of 4 little-endian float32 (x, y, z, reflectance)"
NUSCENES = "nuScenes rows of 5 little-endian float32 (x, y, z, intensity, ring)"

_SIGNATURES = {b"ply\n": "ply", b"ply\r": "ply", b"# .PCD": "pcd", b"VERSION": "pcd", b"\x93NUMPY": "npy"}


def read_kitti(path: Path, columns: Columns = None) -> Points:
    """Rows of x, y, z, reflectance, or of the columns that are named; see `read_points`."""
    if columns is not None:
        layout = f"rows of {len(columns)} little-endian float32 ({', '.join(columns)})"
        rows, roles = _float_rows(path, len(columns), layout), named_roles(path, columns)
        return column_points(path, {role: rows[:, index] for role, index in roles.items()}, layout)
    rows = _float_rows(path, 4, KITTI)
    return checked_points(path, rows[:, :3], rows[:, 3], layout=KITTI)


def read_nuscenes(path: Path, columns: Columns = None) -> Points:
    """Rows of x, y, z, intensity, ring, or of the columns that are named; see `read_points`."""
    if columns is not None:
        return read_kitti(path, columns)
    rows = _float_rows(path, 5, NUSCENES)
    return checked_points(path, rows[:, :3], rows[:, 3], rows[:, 4], layout=NUSCENES)


def _float_rows(path: Path, columns: int, layout: str) -> np.ndarray:
    content = np.fromfile(path, dtype=np.uint8)
    _refuse_other_content(path, content[:64].tobytes(), layout)
    width = 4 * columns
    rows, remainder = divmod(content.size, width)
    if remainder:
        hint = ""
        if content.size % 20 == 0:
            hint = " Its size fits nuScenes' rows of 5: if it is one, name it .pcd.bin."
        elif content.size % 16 == 0:
            hint = " Its size fits KITTI's rows of 4: if it is one, name it .bin."
        raise InputError(
            f"{path} is not a whole number of {layout}: {rows} rows of {width} bytes and {remainder} bytes more. "
            f"Is it cut short, or another layout?{hint}"
        )
    return content.view("<f4").reshape(rows, columns)


def _refuse_other_content(path: Path, head: bytes, layout: str) -> None:
    for signature, name in _SIGNATURES.items():
        if head.startswith(signature):
            raise InputError(f"{path} is not {layout}: it begins like a .{name} file; rename it.")
    if all(32 <= byte < 127 or byte in b"\t\r\n" for byte in head):
        raise InputError(f"{path} is not {layout}: it is text, beginning with {head[:24].decode()!r}.")


def read_npy(path: Path, columns: Columns = None) -> Points:
    """An array (N, 3) or (N, 4) of floats, of the columns that are named, or with named fields; see `read_points`.

    Never unpickles.
    """
    with path.open("rb") as file:
        return column_points(path, table_columns(path, read_array(path, file, None), columns))


def table_columns(path: Path, array: np.ndarray, columns: Columns) -> dict[str, np.ndarray]:
    """The columns by role of an array (N, K) or a structured one (N,)."""
    if array.dtype.names is not None and array.ndim == 1:
        if columns is not None:
            raise named_already(path)
        fields = [PointField(name, array.dtype[name]) for name in array.dtype.names]
        return {role: array[fields[index].name] for role, index in find_roles(path, fields).items()}
    if array.dtype.kind != "f" and (columns is None or array.dtype.kind not in "iu"):
        raise InputError(f"{path} holds {array.dtype} values, not floats: points are float (N, 3) or (N, 4).")
    if array.ndim != 2 or (array.shape[1] not in (3, 4) and columns is None and not 4 < array.shape[1] <= MOST_COLUMNS):
        raise InputError(
            f"{path} holds an array of shape {array.shape}, not points: these are (N, 3) or (N, 4), "
            f"x y z and perhaps reflectance.{_shape_hint(array.shape)}"
        )
    names = usual_names(path, array.shape[1], columns)
    return {role: array[:, index] for role, index in named_roles(path, names).items()}


def named_already(path: Path) -> InputError:
    """That a file names its columns itself."""
    return InputError(f"{path} names its columns itself: leave --columns (data.columns) out.")


def read_array(path: Path, file: IO[bytes], size: int | None) -> np.ndarray:
    """The array of numbers in an open .npy: `size` bytes of an archive, or the rest of a file.

    Raises:
        InputError: no such array, one of objects, or one of another size than the header declares.
    """
    shape, fortran_order, dtype = _npy_header(path, file)
    if dtype.hasobject:
        raise InputError(f"{path} holds objects, not numbers; write it from an array of numbers.")
    return _npy_body(path, file, shape, fortran_order, dtype, size)


def read_image(path: Path) -> np.ndarray | None:
    """See `read_range_image`; None where the array is of another shape or type."""
    with path.open("rb") as file:
        shape, fortran_order, dtype = _npy_header(path, file)
        if len(shape) != 3 or shape[0] not in (1, 2) or dtype.kind != "f" or 0 in shape:
            return None
        array = _npy_body(path, file, shape, fortran_order, dtype)
    with np.errstate(over="ignore"):  # beyond float32 is infinite, and so no return
        return np.nan_to_num(array.astype(np.float32), copy=False, nan=0.0, posinf=0.0, neginf=0.0)


def _npy_body(
    path: Path, file: IO[bytes], shape: tuple[int, ...], fortran_order: bool, dtype: np.dtype, total: int | None = None
) -> np.ndarray:
    """The array behind a header, whose size is compared with the file's, or with `total`, before it is read."""
    size = math.prod(shape) * dtype.itemsize
    there = (os.fstat(file.fileno()).st_size if total is None else total) - file.tell()
    body = np.frombuffer(file.read(size), dtype=np.uint8) if there == size else None
    if body is None or body.size != size:
        raise InputError(
            f"{path} declares the shape {shape} of {dtype}, {size} bytes, but {there} follow its header. Is it damaged?"
        )
    return body.view(dtype).reshape(shape, order="F" if fortran_order else "C")


def _npy_header(path: Path, file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """The declared shape, whether it is in Fortran's order, and the type.

    Not by `np.load`, which allocates what is declared, nor by a memory map, which kills the process when the file gets
    shorter meanwhile.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            return np.lib.format.read_array_header_1_0(file)
        return np.lib.format.read_array_header_2_0(file)  # 3.0 is for field names, which points do not have
    except Exception as error:  # NumPy evaluates the header and may raise anything
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputError(f"{path} is not a readable .npy file ({reason[:160]}). Is it damaged?") from None


def _shape_hint(shape: tuple[int, ...]) -> str:
    if len(shape) == 3 and shape[0] == 2:
        return " It looks like a (2, H, W) range image: unproject it first."
    if len(shape) == 2 and shape[0] in (3, 4):
        return " It looks transposed."
    return ""
