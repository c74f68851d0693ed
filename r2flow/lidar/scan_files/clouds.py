"""PCD (Point Cloud Library) and PLY (Stanford): readers of all encodings, writers of binary.

The packages plyfile and pypcd4 do not serve. The one is under the GPL. The other returns half a
scan from half a file (of 1,163 cut ones it takes 65) and refuses COUNT 0 and COLUMNS. Compressed
PCDs need the package lzf.
"""

import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, require

PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
PLY_CODES = {  # NumPy's codes of PLY's types
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
}  # fmt: skip

Table = tuple[list[str] | None, list[ndarray]]  # names of the columns, or None; columns


PICKLED = b"\x80"  # of protocol 2 and later
UNPACK = (  # joblib's list of (N, 3) arrays, of which each becomes a file
    "python -c \"import joblib, numpy; [numpy.save(f'{i:06}.npy', x) for i, x in "
    "enumerate(joblib.load('samples.pcd'))]\", and give the folder."
)


def read_pcd(path: Path) -> Table:
    """All fields of a PCD of version 0.7, or older ones, whose fields may be called COLUMNS.

    VIEWPOINT is not applied: points are in the sensor's frame. A field of COUNT 0 stores nothing.
    """
    data = path.read_bytes()
    if data.startswith(PICKLED):
        raise InputError(f"it is a pickle, as LiDM's samples.pcd. If you trust it: {UNPACK}")
    text, body = _split_header(data)
    header = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.strip()}
    declared = header.get("FIELDS") or header["COLUMNS"]
    counts = map(int, header.get("COUNT", ["1"] * len(declared)))
    names: list[str] = []
    kinds: list[tuple[str, str, tuple[int, ...]]] = []
    for name, kind, size, width in zip(
        declared, header["TYPE"], header["SIZE"], counts, strict=True
    ):
        if width:
            number = str(len(names))  # names may repeat
            kinds.append((number, f"<{kind.lower()}{size}", (width,) if width > 1 else ()))
            names.append(name)
    row = np.dtype(kinds)
    sizes = header.get("POINTS") or header["WIDTH"] + header["HEIGHT"]
    count = math.prod(map(int, sizes))
    encoding = header["DATA"][0]
    if encoding != "binary_compressed":
        return names, _columns(body, row, count, encoding)
    require(str(path), "formats", "lzf")
    from lzf import decompress

    stored, size = struct.unpack_from("<II", body)
    if size != count * row.itemsize or body[8 + stored :].strip(b"\0"):
        raise InputError("its header declares another size than its data. Is it damaged?")
    blocks = decompress(body[8 : 8 + stored], size)  # all x, then all y, ...
    fields = (row.fields or {}).values()
    return names, [np.frombuffer(blocks, kind, count, count * at) for kind, at, *_ in fields]


def write_pcd(file: IO[bytes], table: ndarray, names: Sequence[str]) -> None:
    """Write fields as binary float32."""
    count, width = table.shape
    ones, fours, floats = (" ".join(mark * width) for mark in "14F")
    file.write(
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {fours}\nTYPE {floats}\nCOUNT {ones}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n".encode()
    )
    file.write(table.tobytes())


def read_ply(path: Path) -> Table:
    """All properties of the element `vertex`, the first; later ones, as of a mesh, are ignored."""
    text, body = _split_header(path.read_bytes())
    head, vertex, *others = text.split("\nelement ")
    _, encoding, _ = re.split(r"^format (\w+)", head, flags=re.MULTILINE)
    properties = re.findall(r"^property (\w+) (.+)", vertex, re.MULTILINE)
    codes = [PLY_ORDERS[encoding] + PLY_CODES[kind] for kind, _ in properties]
    row = np.dtype([(str(number), code) for number, code in enumerate(codes)])
    name, count = vertex.split()[:2]
    if name != "vertex":
        raise InputError("its first element is not 'vertex', the points.")
    names = [name.strip() for _, name in properties]
    return names, _columns(body, row, int(count), encoding, last=not others)


def write_ply(file: IO[bytes], table: ndarray, names: Sequence[str]) -> None:
    """Write vertices as little-endian float32."""
    properties = "".join(f"property float {name}\n" for name in names)
    file.write(
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(table)}\n"
        f"{properties}end_header\n".encode()
    )
    file.write(table.tobytes())


READERS = {".pcd": read_pcd, ".ply": read_ply}
WRITERS = {".pcd": write_pcd, ".ply": write_ply}


def _split_header(data: bytes) -> tuple[str, bytes]:
    """A file's header of text, and its body."""
    end = re.search(rb"^(DATA|end_header)\b.*\n", data[: 1 << 16], re.MULTILINE)
    if end is None:
        raise InputError("it has no header of its format. Is it damaged?")
    return data[: end.end()].decode("ascii", "replace"), data[end.end() :]


def _columns(
    body: bytes, row: np.dtype, count: int, encoding: str, last: bool = True
) -> list[ndarray]:
    """The columns of `count` rows, text or binary; `last`: nothing may follow them."""
    if encoding == "ascii":
        lines = [line for line in body.decode("ascii").splitlines() if line.strip()]
        more = len(lines) > count
        table = (
            np.loadtxt(lines[:count], row, comments=None, ndmin=1) if lines else np.empty(0, row)
        )
    else:
        more = body[count * row.itemsize :].strip(b"\0\r\n ") != b""  # pages are padded
        table = np.frombuffer(body, row, count)
    if len(table) != count or (last and more):
        raise InputError(f"it does not hold the {count} points that it declares. Is it damaged?")
    return [table[name] for name in row.names or ()]
