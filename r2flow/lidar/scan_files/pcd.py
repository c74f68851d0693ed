"""PCD, the Point Cloud Library's format, version 0.7: three encodings are read, binary is written."""

import struct
from itertools import accumulate
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files import lzf
from r2flow.lidar.scan_files.fields import (
    PointField,
    binary_columns,
    column_points,
    find_roles,
    point_count,
    split_header,
    text_columns,
    text_lines,
    whole_number,
)
from r2flow.lidar.scan_files.points import Points

_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_OLD_KEYS = {"COLUMNS": "FIELDS"}  # before version 0.7
_TYPES = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}
_ENCODINGS = ("ascii", "binary", "binary_compressed")
_PADDING = b"\0\r\n "  # some writers fill the last memory page, or end with a newline

Header = dict[str, list[str]]


def read_pcd(path: Path) -> Points:
    """Fields x, y, z and, where present, reflectance and ring; see `read_points`.

    VIEWPOINT is not applied: the points are taken to be in the sensor's frame.
    """
    data = path.read_bytes()
    header, start = _read_header(path, data)
    fields = _read_fields(path, header)
    roles = find_roles(path, fields)
    count = _read_count(path, header)
    encoding = " ".join(header["DATA"])
    if encoding not in _ENCODINGS:
        raise InputError(f"{path} declares DATA {encoding[:24]!r}; known: {', '.join(_ENCODINGS)}.")
    if encoding == "ascii":
        lines = text_lines(path, data[start:])
        if len(lines) != count:
            raise InputError(f"{path} declares {count} points but holds {len(lines)} lines. Is it whole?")
        return column_points(path, text_columns(path, lines, fields, roles))
    size = count * sum(field.nbytes for field in fields)
    payload = memoryview(data)[start:]
    if encoding == "binary":
        _expect_size(path, payload, size, f"{count} points")
        return column_points(path, binary_columns(payload, count, fields, roles))
    # Compressed points are stored field by field: every x, then every y, and so on.
    blocks = _unpack(path, payload, size)
    offsets = [count * offset for offset in accumulate((field.nbytes for field in fields), initial=0)]
    columns = {role: np.frombuffer(blocks, fields[index].dtype, count, offsets[index]) for role, index in roles.items()}
    return column_points(path, columns)


def _read_header(path: Path, data: bytes) -> tuple[Header, int]:
    """The words behind each key, and the offset of the first byte behind the header."""
    lines, end = split_header(path, data, "DATA")
    header: Header = {}
    for key, *values in lines:
        if key.startswith("#"):
            continue
        key = _OLD_KEYS.get(key, key)
        # Not skipped: where a flipped bit has renamed COUNT, every row would be wrong.
        if key not in _KEYS or key in header:
            state = "repeats the" if key in header else "has an unknown"
            raise InputError(f"{path} {state} header line {key[:24]!r}; known: {', '.join(_KEYS)}.")
        header[key] = values
    missing = [key for key in ("FIELDS", "SIZE", "TYPE") if key not in header]
    if missing:
        raise InputError(f"{path} has no {', '.join(missing)} line in its header. Is it a PCD file, and whole?")
    return header, end


def _read_fields(path: Path, header: Header) -> list[PointField]:
    names = header["FIELDS"]
    counts = header.get("COUNT", ["1"] * len(names))
    lengths = [len(header["SIZE"]), len(header["TYPE"]), len(counts)]
    if lengths != [len(names)] * 3:
        raise InputError(
            f"{path} declares {len(names)} FIELDS but {lengths[0]} SIZE, {lengths[1]} TYPE and "
            f"{lengths[2]} COUNT entries; there must be one of each per field."
        )
    fields = []
    for name, size, kind, count in zip(names, header["SIZE"], header["TYPE"], counts, strict=True):
        if kind + size not in _TYPES:
            raise InputError(f"{path} declares field {name!r} as TYPE {kind!r} SIZE {size!r}, which PCD does not know.")
        number = whole_number(path, f"the COUNT of {name!r} as", count)
        if not number:
            raise InputError(f"{path} declares field {name!r} with COUNT 0. Is it damaged?")
        fields.append(PointField(name, np.dtype(f"<{kind.lower()}{size}"), number))
    return fields


def _read_count(path: Path, header: Header) -> int:
    numbers = {
        key: whole_number(path, key, " ".join(header[key])) for key in ("WIDTH", "HEIGHT", "POINTS") if key in header
    }
    grid = numbers["WIDTH"] * numbers["HEIGHT"] if {"WIDTH", "HEIGHT"} <= numbers.keys() else None
    count = numbers.get("POINTS", grid)
    if count is None:
        raise InputError(f"{path} declares neither POINTS nor WIDTH and HEIGHT. Is it a PCD file, and whole?")
    if grid not in (None, count):
        raise InputError(f"{path} declares {count} POINTS but WIDTH x HEIGHT = {grid}. Is it damaged?")
    return point_count(path, count)


def _expect_size(path: Path, payload: memoryview, size: int, what: str) -> None:
    if len(payload) < size:
        raise InputError(f"{path} is cut short: {what} need {size} bytes, {len(payload)} follow the header.")
    if bytes(payload[size:]).strip(_PADDING):
        raise InputError(f"{path} holds {len(payload) - size} bytes more than its {what} need. Is the header damaged?")


def _unpack(path: Path, payload: memoryview, size: int) -> bytes:
    if len(payload) < 8:
        raise InputError(f"{path} is cut short: the sizes of its compressed data are missing.")
    packed, unpacked = struct.unpack_from("<II", payload)
    if unpacked != size:
        raise InputError(f"{path} declares points of {size} bytes, its compressed data {unpacked}. Is it damaged?")
    _expect_size(path, payload[8:], packed, "compressed data")
    try:
        return lzf.decompress(bytes(payload[8 : 8 + packed]), size)
    except ValueError as error:
        raise InputError(f"{path} cannot be decompressed: {error}. Is it damaged?") from None


def write_pcd(file: IO[bytes], table: np.ndarray) -> None:
    """Fields x, y, z and, from a table (N, 4), intensity, as binary float32."""
    count, width = table.shape
    header = {
        "VERSION": "0.7",
        "FIELDS": "x y z intensity" if width == 4 else "x y z",
        "SIZE": " ".join("4" * width),
        "TYPE": " ".join("F" * width),
        "COUNT": " ".join("1" * width),
        "WIDTH": count,
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": count,
        "DATA": "binary",
    }
    file.write("".join(f"{key} {value}\n" for key, value in header.items()).encode())
    file.write(table.tobytes())
