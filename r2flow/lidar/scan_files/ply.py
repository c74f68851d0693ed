"""PLY, the Stanford polygon format: ascii and binary of either byte order are read, binary_little_endian is written."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import InputError
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

_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {  # NumPy's codes of PLY's types
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass
class _Element:
    """`count` rows of properties; `codes` are those of its numbers by name, `lists` the names of its lists."""

    name: str
    count: int
    codes: list[tuple[str, str]] = field(default_factory=list)
    lists: list[str] = field(default_factory=list)

    def fields(self, order: str) -> list[PointField]:
        return [PointField(name, np.dtype(order + code)) for name, code in self.codes]

    @property
    def nbytes(self) -> int:
        return self.count * sum(field.nbytes for field in self.fields("<"))


def read_ply(path: Path) -> Points:
    """Properties x, y, z of `vertex` and, where present, reflectance and ring; see `read_points`.

    Rows of other elements are passed over. Lists make rows of unequal length: only elements behind the points, such as
    the faces of a mesh, may have them.
    """
    data = path.read_bytes()
    kind, elements, start = _read_header(path, data)
    names = [element.name for element in elements]
    if names.count("vertex") != 1:
        raise InputError(
            f"{path} declares {names.count('vertex')} 'vertex' elements, which hold the points; one is needed."
        )
    index = names.index("vertex")
    before, vertex = elements[:index], elements[index]
    count = point_count(path, vertex.count)
    listed = [name for element in (*before, vertex) for name in element.lists]
    if listed:
        raise InputError(f"{path} has lists ({', '.join(listed)}) in or before its points; write it without them.")
    fields = vertex.fields(_ORDERS[kind])
    roles = find_roles(path, fields)
    if kind == "ascii":
        lines = text_lines(path, data[start:])
        declared = sum(element.count for element in elements)
        if declared != len(lines):
            raise InputError(f"{path} declares {declared} rows but holds {len(lines)}. Is it whole?")
        first = sum(element.count for element in before)
        return column_points(path, text_columns(path, lines[first : first + count], fields, roles))
    payload = memoryview(data)[start:]
    _check_size(path, payload, elements)
    offset = sum(element.nbytes for element in before)
    return column_points(path, binary_columns(payload[offset:], count, fields, roles))


def _check_size(path: Path, payload: memoryview, elements: list[_Element]) -> None:
    size = sum(element.nbytes for element in elements)
    if len(payload) < size:
        raise InputError(f"{path} is cut short: its header declares {size} bytes, {len(payload)} follow it.")
    if not any(element.lists for element in elements) and bytes(payload[size:]).strip(b"\r\n"):
        raise InputError(f"{path} holds {len(payload) - size} bytes more than its header declares. Is it damaged?")


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """The encoding, the elements in order, and the offset of the first byte behind the header."""
    lines, end = split_header(path, data, "end_header")
    if lines[0] != ["ply"]:
        raise InputError(f"{path} begins with {lines[0][0][:24]!r}, not with 'ply'. Is it a PLY file?")
    kind = ""
    elements: list[_Element] = []
    for words in lines[1:-1]:
        match words:
            case ["format", encoding, "1.0"] if encoding in _ORDERS and not kind:
                kind = encoding
            case ["element", name, number]:
                elements.append(_Element(name, whole_number(path, f"the number of {name!r} as", number)))
            case ["property", code, name] if elements and code in _CODES:
                elements[-1].codes.append((name, _CODES[code]))
            case ["property", "list", length, code, name] if elements and {length, code} <= _CODES.keys():
                elements[-1].lists.append(name)
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                raise InputError(f"{path} has a header line that PLY does not know: {' '.join(words)[:60]!r}.")
    if not kind:
        raise InputError(f"{path} has no 'format' line in its header; known: {', '.join(_ORDERS)}, each 1.0.")
    return kind, elements, end


PLY_NAMES = "x", "y", "z", "intensity"


def write_ply(file: IO[bytes], table: np.ndarray, names: tuple[str, ...] = PLY_NAMES) -> None:
    """Vertices x, y, z and, from a table (N, 4), intensity, or other `names`, as little-endian float32."""
    names = names[: table.shape[1]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    file.write("\n".join([*header, "end_header", ""]).encode())
    file.write(table.tobytes())
