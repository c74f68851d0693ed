"""PLY, the Stanford polygon format: ascii, binary_little_endian and binary_big_endian."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.scan_files.fields import (
    Field,
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
# Codes that struct and NumPy share once a byte order stands before them.
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass(frozen=True)
class _Property:
    """One number a row or, with a type for its length, a list of them."""

    name: str
    code: str
    length: str | None = None


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(p.length for p in self.properties)

    def fields(self, order: str) -> list[Field]:
        return [Field(p.name, np.dtype(order + p.code)) for p in self.properties]


def read_ply(path: Path) -> Points:
    """Properties x, y, z of `vertex` and, where present, reflectance and ring; see `read_points`.

    Other properties and elements are skipped, but all of them must be there.
    """
    data = path.read_bytes()
    kind, elements, start = _read_header(path, data)
    vertices = [element for element in elements if element.name == "vertex"]
    if len(vertices) != 1:
        raise InputError(f"{path} declares {len(vertices)} 'vertex' elements, which hold the points; one is needed.")
    point_count(path, vertices[0].count)
    roles = find_roles(path, vertices[0].fields("<"))
    listed = [p.name for k, p in enumerate(vertices[0].properties) if p.length and k in roles.values()]
    if listed:
        raise InputError(f"{path} declares {', '.join(listed)} as lists; one number a point is needed.")
    if kind == "ascii":
        return column_points(path, _text_vertices(path, text_lines(path, data[start:]), elements, roles))
    payload = memoryview(data)[start:]
    return column_points(path, _binary_vertices(path, payload, elements, roles, _ORDERS[kind]))


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """The encoding, the elements in order, and the offset of the first byte behind the header."""
    lines, end = split_header(path, data, "end_header")
    if lines[0] != ["ply"]:
        raise InputError(f"{path} begins with {lines[0][0][:24]!r}, not with 'ply'. Is it a PLY file?")
    kind = ""
    elements: list[_Element] = []
    for words in lines[1:-1]:
        if words[0] == "format" and not kind and words[1:] in [[known, "1.0"] for known in _ORDERS]:
            kind = words[1]
        elif words[0] == "element" and len(words) == 3:
            count = whole_number(path, f"the number of {words[1]!r} as", words[2])
            elements.append(_Element(words[1], count))
        elif words[0] == "property" and elements:
            elements[-1].properties.append(_read_property(path, words))
        elif words[0] not in ("comment", "obj_info"):
            raise InputError(f"{path} has a header line that PLY does not know: {' '.join(words)[:60]!r}.")
    if not kind:
        raise InputError(f"{path} has no 'format' line in its header; known: {', '.join(_ORDERS)}, each 1.0.")
    return kind, elements, end


def _read_property(path: Path, words: list[str]) -> _Property:
    match words[1:]:
        case [kind, name] if kind in _CODES:
            return _Property(name, _CODES[kind])
        case ["list", length, kind, name] if kind in _CODES and length in _CODES:
            if _CODES[length] not in "fd":
                return _Property(name, _CODES[kind], _CODES[length])
    raise InputError(f"{path} has a property that PLY does not know: {' '.join(words)[:60]!r}.")


def _binary_vertices(
    path: Path, payload: memoryview, elements: Sequence[_Element], roles: Mapping[str, int], order: str
) -> dict[str, np.ndarray]:
    """The wanted columns, (N,) each; every element is walked, so that a wrong count is found."""
    columns: dict[str, np.ndarray] = {}
    cursor = 0
    for element in elements:
        wanted = roles if element.name == "vertex" else {}
        if element.has_lists:
            found, cursor = _walk(path, payload, cursor, element, wanted, order)
        else:
            fields = element.fields(order)
            end = cursor + element.count * sum(f.nbytes for f in fields)
            if end > len(payload):
                raise _cut(path, element)
            found = binary_columns(payload[cursor:end], element.count, fields, wanted) if wanted else {}
            cursor = end
        columns |= found
    if bytes(payload[cursor:]).strip(b"\r\n"):
        raise InputError(f"{path} holds {len(payload) - cursor} bytes more than its header declares. Is it damaged?")
    return columns


def _walk(
    path: Path, payload: memoryview, cursor: int, element: _Element, wanted: Mapping[str, int], order: str
) -> tuple[dict[str, np.ndarray], int]:
    """Row by row, because lists make rows of unequal length; each row takes a byte or more, so it ends."""
    values: dict[int, list[float]] = {index: [] for index in wanted.values()}
    plan = [(struct.Struct(order + (p.length or p.code)), struct.calcsize("<" + p.code)) for p in element.properties]
    try:
        for _ in range(element.count):
            for index, (number, size) in enumerate(plan):
                (value,) = number.unpack_from(payload, cursor)
                cursor += number.size
                if element.properties[index].length:
                    if value < 0:
                        raise InputError(f"{path} has a list of {value} numbers in {element.name!r}. Is it damaged?")
                    cursor += value * size
                elif index in values:
                    values[index].append(value)
    except struct.error:
        raise _cut(path, element) from None
    if cursor > len(payload):
        raise _cut(path, element)
    return {role: np.array(values[index]) for role, index in wanted.items()}, cursor


def _cut(path: Path, element: _Element) -> InputError:
    return InputError(f"{path} is cut short: it declares {element.count} of {element.name!r} and holds fewer.")


def _text_vertices(
    path: Path, lines: Sequence[str], elements: Sequence[_Element], roles: Mapping[str, int]
) -> dict[str, np.ndarray]:
    """The wanted columns, (N,) each; an element is a line."""
    declared = sum(element.count for element in elements if element.properties)
    if declared != len(lines):
        raise InputError(f"{path} declares {declared} rows but holds {len(lines)}. Is it whole?")
    start = 0
    for element in elements:
        if element.name == "vertex":
            break
        start += element.count if element.properties else 0
    rows = lines[start : start + element.count]
    if element.has_lists:
        rows = [_without_lists(path, row, element) for row in rows]
        places = [index for index, p in enumerate(element.properties) if not p.length]
        roles = {role: places.index(index) for role, index in roles.items()}
    fields = [Field(p.name, np.dtype("<f8")) for p in element.properties if not p.length]
    return text_columns(path, rows, fields, roles)


def _without_lists(path: Path, row: str, element: _Element) -> str:
    """The row's single numbers; each list, a length and as many numbers, is passed over."""
    words = row.split()
    kept, cursor = [], 0
    for prop in element.properties:
        if cursor >= len(words):
            break
        if prop.length:
            cursor += whole_number(path, "a list's length as", words[cursor])
        else:
            kept.append(words[cursor])
        cursor += 1
    if cursor != len(words) or prop is not element.properties[-1]:
        raise InputError(f"{path} has a row that does not fit its properties: {row.strip()[:60]!r}. Is it damaged?")
    return " ".join(kept)


def write_ply(file: IO[bytes], table: np.ndarray) -> None:
    """Vertices x, y, z and, from a table (N, 4), intensity, as little-endian float32."""
    names = ("x", "y", "z", "intensity")[: table.shape[1]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    file.write("\n".join([*header, "end_header", ""]).encode())
    file.write(table.tobytes())
