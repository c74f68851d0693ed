"""PCD (Point Cloud Library) and PLY (Stanford): readers of text, binary and compressed points, writers of binary.

No libraries are used: plyfile is under the GPL and allocates what a header declares, pypcd4 returns half a scan from
half a file, and the bindings to LZF need a compiler.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from r2flow.errors import check
from r2flow.lidar.scan_files.points import NoPointsError

PCD_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
PCD_KINDS = ("binary", "binary_compressed")
PCD_TYPES = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}
PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_CODES = {  # NumPy's codes of PLY's types
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip

Table = tuple[list[str] | None, list[np.ndarray]]  # names of the columns, or None; columns


def read_pcd(path: Path) -> Table:
    """All fields of a PCD of version 0.7. VIEWPOINT is not applied: points are in the sensor's frame."""
    data = path.read_bytes()
    lines, start = _split_header(data, "DATA")
    header: dict[str, list[str]] = {}
    for key, *values in lines:
        if not key.startswith("#"):
            # Unknown keys are refused: if a flipped bit renamed COUNT, every row would be wrong.
            check(key in PCD_KEYS and key not in header, f"its header line {key[:24]!r} is unknown or there twice.")
            header[key] = values
    check(header.keys() >= {"FIELDS", "SIZE", "TYPE"}, "its header has no FIELDS, SIZE or TYPE line.")
    names, kinds = header["FIELDS"], [k + s for k, s in zip(header["TYPE"], header["SIZE"], strict=True)]
    check(len(kinds) == len(names), f"it declares {len(names)} FIELDS but {len(kinds)} SIZE.")
    check(set(kinds) <= PCD_TYPES, f"it declares types {', '.join(kinds)[:60]}, not I, U or F of 1 to 8 bytes.")
    widths = [_whole(number) for number in header.get("COUNT", ["1"] * len(names))]
    check(len(widths) == len(names) and all(widths), "its COUNT must have a positive number for each field.")
    sizes = {key: _whole("".join(header[key])) for key in ("WIDTH", "HEIGHT", "POINTS") if key in header}
    grid = sizes["WIDTH"] * sizes["HEIGHT"] if {"WIDTH", "HEIGHT"} <= sizes.keys() else None
    count = sizes.get("POINTS", grid)
    check(count is not None and grid in (None, count), f"it declares {count} POINTS, but WIDTH x HEIGHT = {grid}.")
    if not count:
        raise NoPointsError("it declares 0 points; leave it out, or fetch it again.")
    kind, body = " ".join(header["DATA"]), data[start:]
    if kind == "ascii":
        table = text_table(body, [count], 0, sum(widths))
        offsets = np.cumsum([0, *widths])
        return names, [table[:, i] if n == 1 else table[:, i : i + n] for i, n in zip(offsets, widths, strict=False)]
    check(kind in PCD_KINDS, f"it declares DATA {kind[:24]!r}; known: ascii, {', '.join(PCD_KINDS)}.")
    fields = enumerate(zip(kinds, widths, strict=True))
    row = np.dtype([(str(i), f"<{k.lower()}", (n,) if n > 1 else ()) for i, (k, n) in fields])
    size = stored = count * row.itemsize
    if kind == "binary_compressed":
        stored, unpacked = struct.unpack_from("<II", body)
        check(unpacked == size, f"it declares points of {size} bytes, its compressed data {unpacked}. Is it damaged?")
        body = body[8:]
    check(len(body) >= stored and not body[stored:].strip(b"\0\r\n "), _wrong_size(stored, len(body)))  # padded pages
    if kind == "binary":
        points = np.frombuffer(body, row, count)
        return names, [points[name] for name in row.names or ()]
    blocks = decompress_lzf(body[:stored], size)  # field by field: all x, then all y, ...
    return names, [np.frombuffer(blocks, f, count, count * offset) for f, offset, *_ in (row.fields or {}).values()]


def write_pcd(file: IO[bytes], table: np.ndarray, names: tuple[str, ...]) -> None:
    """Write fields as binary float32."""
    count, width = table.shape
    ones, fours, floats = (" ".join(mark * width) for mark in "14F")
    file.write(
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {fours}\nTYPE {floats}\nCOUNT {ones}\nWIDTH {count}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n".encode()
    )
    file.write(table.tobytes())


@dataclass
class _Element:
    """`count` rows of numbers, by name and type; `listed` if rows also have lists."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    listed: bool = False


def read_ply(path: Path) -> Table:
    """All properties of the element `vertex`. Only later elements, such as the faces of a mesh, may have lists."""
    data = path.read_bytes()
    lines, start = _split_header(data, "end_header")
    check(lines[0] == ["ply"], f"it begins with {lines[0][0][:24]!r}, not with 'ply'. Is it a PLY file?")
    kind, elements = "", list[_Element]()
    for words in lines[1:-1]:
        match words:
            case ["format", encoding, "1.0"] if encoding in PLY_ORDERS and not kind:
                kind = encoding
            case ["element", name, number]:
                elements.append(_Element(name, _whole(number)))
            case ["property", code, name] if elements and code in PLY_CODES:
                elements[-1].fields.append((name, PLY_CODES[code]))
            case ["property", "list", length, code, _] if elements and {length, code} <= PLY_CODES.keys():
                elements[-1].listed = True
            case ["comment" | "obj_info", *_]:
                pass
            case _:
                check(False, f"it has a header line that PLY does not know: {' '.join(words)[:60]!r}.")
    check(kind, f"it has no 'format' line in its header; known: {', '.join(PLY_ORDERS)}, each 1.0.")
    index = next((i for i, element in enumerate(elements) if element.name == "vertex"), -1)
    check(index >= 0, "it has no element 'vertex', which holds the points.")
    vertex = elements[index]
    check(not any(element.listed for element in elements[: index + 1]), "it has lists in or before its points.")
    if not vertex.count:
        raise NoPointsError("it declares 0 points; leave it out, or fetch it again.")
    names = [name for name, _ in vertex.fields]
    if kind == "ascii":
        table = text_table(data[start:], [element.count for element in elements], index, len(names))
        return names, list(table.T)
    order = PLY_ORDERS[kind]
    kinds = [np.dtype([(str(i), order + code) for i, (_, code) in enumerate(element.fields)]) for element in elements]
    sizes = [element.count * kind.itemsize for element, kind in zip(elements, kinds, strict=True)]
    extra = b"" if any(element.listed for element in elements) else data[start + sum(sizes) :].strip(b"\r\n")
    check(len(data) - start >= sum(sizes) and not extra, _wrong_size(sum(sizes), len(data) - start))
    points = np.frombuffer(data, kinds[index], vertex.count, start + sum(sizes[:index]))
    return names, [points[name] for name in points.dtype.names or ()]


def write_ply(file: IO[bytes], table: np.ndarray, names: tuple[str, ...]) -> None:
    """Write vertices as little-endian float32."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {name}" for name in names]
    file.write("\n".join([*header, "end_header", ""]).encode())
    file.write(table.tobytes())


READERS = {".pcd": read_pcd, ".ply": read_ply}
WRITERS = {".pcd": write_pcd, ".ply": write_ply}


def text_table(body: bytes, counts: list[int], index: int, width: int) -> np.ndarray:
    """Numbers of element `index` of a text with `counts` lines an element, float64 (counts[index], width)."""
    lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
    check(len(lines) == sum(counts), f"it declares {sum(counts)} rows but holds {len(lines)}. Is it whole?")
    first = sum(counts[:index])
    table = np.loadtxt(lines[first : first + counts[index]], dtype=np.float64, comments=None, ndmin=2)
    check(table.shape[1] == width, f"it has {table.shape[1]} numbers a line where its header declares {width}.")
    return table


def decompress_lzf(stream: bytes, size: int) -> bytes:
    """Decompress an LZF stream to `size` bytes.

    A control byte below 32 announces control + 1 literal bytes. Other control bytes copy earlier output: the upper
    three bits hold length - 2, where 7 means that the next byte is added; the lower five bits and the next byte hold
    distance - 1. A copy may overlap its output, which repeats a pattern.
    """
    output = bytearray()
    position, end = 0, len(stream)
    while position < end and len(output) <= size:
        control = stream[position]
        if control < 32:
            output += stream[position + 1 : position + 2 + control]
            position += 2 + control
            continue
        length = (control >> 5) + 2
        if length == 9:
            position += 1
            length += stream[position]
        distance = ((control & 31) << 8 | stream[position + 1]) + 1
        position += 2
        start = len(output) - distance
        if start < 0:
            raise ValueError("a copy refers to before the beginning")
        pattern = output[start : start + length]
        output += pattern if distance >= length else (pattern * (length // distance + 1))[:length]
    whole = len(output) == size and position == end
    check(whole, f"its compressed data do not unpack to the declared {size} bytes. Is it damaged?")
    return bytes(output)


def _split_header(data: bytes, last: str) -> tuple[list[list[str]], int]:
    """The words of each line of a text header up to the line that begins with `last`, and the offset after it."""
    lines: list[list[str]] = []
    start = 0
    while (end := data.find(b"\n", start, 1 << 16)) >= 0:  # a header has a few hundred bytes
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words:
            lines.append(words)
            if words[0] == last:
                return lines, start
    raise ValueError(f"no line {last!r} to end its header")


def _whole(word: str) -> int:
    check(word.isascii() and word.isdigit() and len(word) <= 18, f"it declares {word[:24]!r}, not a whole number.")
    return int(word)


def _wrong_size(declared: int, present: int) -> str:
    return f"its header declares {declared} bytes, {present} follow it. Is it cut short or damaged?"
