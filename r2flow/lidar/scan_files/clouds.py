"""PCD (Point Cloud Library) and PLY (Stanford): readers of all encodings, writers of binary.

The packages plyfile and pypcd4 do not serve. The one is under the GPL. The other returns half a
scan from half a file (of 1,163 cut ones it takes 65) and refuses COUNT 0 and COLUMNS. Compressed
PCDs need the package lzf.
"""

import math
import re
import struct
from pathlib import Path
from typing import IO

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError, check, quoted, require
from r2flow.lidar.scan_files.cloud import Cloud

_PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_CODES = {  # NumPy's codes of PLY's types
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "float": "f", "double": "d", "float32": "f", "float64": "d",
    "bool": "B",  # Open3D's
}  # fmt: skip
_PLY_TYPES = {  # by NumPy's
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint",
    "f4": "float", "f8": "double",
}  # fmt: skip
_PCD_SIZES = "integers of 1, 2, 4, 8 bytes and floats of 4, 8"

_PADDING = "_"  # PCL's name of bytes without meaning
_PICKLED = b"\x80"  # of protocol 2 and later
_UNPACK = (  # joblib's list of (N, 3) arrays, of which each becomes a file
    "python -c \"import joblib, numpy; [numpy.save(f'{i:06}.npy', x) for i, x in "
    "enumerate(joblib.load('samples.pcd'))]\", and give the folder."
)


def _read_pcd(path: Path) -> Cloud:
    """All fields of a PCD of version 0.7, or older ones, whose fields may be called COLUMNS.

    VIEWPOINT is not applied: points are in the sensor's frame. A field of COUNT 0 stores nothing.
    """
    data = path.read_bytes()
    if data.startswith(_PICKLED):
        raise InputError(f"it is a pickle, as LiDM's samples.pcd. If you trust it: {_UNPACK}")
    text, body = _split_header(data)
    header = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.strip()}
    declared = header.get("FIELDS") or header["COLUMNS"]
    counts = header.get("COUNT", ["1"] * len(declared))
    fields = zip(declared, header["TYPE"], header["SIZE"], map(int, counts), strict=True)
    stored = [field for field in fields if field[3]]
    row = np.dtype(
        [
            (
                str(number),
                f"<{kind.lower()}{size}",
                (width,) if width > 1 else (),
            )  # names may repeat
            for number, (_, kind, size, width) in enumerate(stored)
        ]
    )
    sizes = header.get("POINTS") or header["WIDTH"] + header["HEIGHT"]
    count = math.prod(map(int, sizes))
    encoding = header["DATA"][0]
    if encoding == "binary_compressed":
        columns = _decompressed(path, body, row, count)
    else:
        columns = _columns(body, row, count, encoding)
    kept = [place for place, (name, *_) in enumerate(stored) if name != _PADDING]
    return Cloud(
        tuple(stored[place][0] for place in kept),
        tuple(columns[place] for place in kept),
        header=header.get("VIEWPOINT"),
    )


def _decompressed(path: Path, body: bytes, row: np.dtype, count: int) -> list[ndarray]:
    """The columns of a compressed body: all x, then all y, ..."""
    require(str(path), "formats", "lzf")
    from lzf import decompress

    stored, size = struct.unpack_from("<II", body)
    if size != count * row.itemsize or body[8 + stored :].strip(b"\0"):
        raise InputError("its header declares another size than its data. Is it damaged?")
    blocks = decompress(body[8 : 8 + stored], size)
    fields = (row.fields or {}).values()
    return [np.frombuffer(blocks, kind, count, count * at) for kind, at, *_ in fields]


def write_pcd(file: IO[bytes], cloud: Cloud) -> None:
    """Write all fields as binary, little-endian."""
    rows = _little(cloud.array())
    fields = [row.subdtype or (row, ()) for row, *_ in (rows.dtype.fields or {}).values()]
    names = rows.dtype.names or ()
    kinds = [kind for kind, _ in fields]
    for name, kind in zip(names, kinds, strict=True):
        _check_type(name, kind, "PCD", kind.kind in "iuf" and kind.itemsize <= 8, _PCD_SIZES)
    viewpoint = " ".join(cloud.header or ["0", "0", "0", "1", "0", "0", "0"])
    file.write(
        f"VERSION 0.7\nFIELDS {' '.join(names)}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\n"
        f"COUNT {' '.join(str(math.prod(shape)) for _, shape in fields)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(rows)}\n"
        "DATA binary\n".encode()
    )
    file.write(rows.tobytes())


def _read_ply(path: Path) -> Cloud:
    """All properties of the element `vertex`, the first; later ones, as of a mesh, are ignored."""
    text, body = _split_header(path.read_bytes())
    head, *elements = text.split("\nelement ")
    check(elements, "it has no element 'vertex', the points.")
    vertex, *others = elements
    _, encoding, _ = re.split(r"^format (\w+)", head, flags=re.MULTILINE)
    properties = re.findall(r"^property (\w+) (.+)", vertex, re.MULTILINE)
    name, count = vertex.split()[:2]
    if name != "vertex":
        raise InputError("its first element is not 'vertex', the points.")
    for kind, named in properties:
        check(kind in _PLY_CODES, f"its vertices have a property {quoted(named)}, a {kind}.")
    codes = [_PLY_ORDERS[encoding] + _PLY_CODES[kind] for kind, _ in properties]
    row = np.dtype([(str(number), code) for number, code in enumerate(codes)])
    names = tuple(name.strip() for _, name in properties)
    columns = tuple(_columns(body, row, int(count), encoding, last=not others))
    comments = tuple(re.findall(r"^comment (.*\S)", text, re.MULTILINE))
    return Cloud(names, columns, header=comments)


def write_ply(file: IO[bytes], cloud: Cloud) -> None:
    """Write all fields of the vertices, little-endian."""
    rows = _little(cloud.array())
    properties = []
    for name, (kind, *_) in (rows.dtype.fields or {}).items():
        held = _PLY_TYPES.get(kind.str[1:])
        _check_type(name, kind, "PLY", held, "integers of 1, 2, 4 bytes and floats of 4, 8")
        properties.append(f"property {held} {name}\n")
    comments = "".join(f"comment {line}\n" for line in cloud.header or ())
    file.write(
        f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {len(rows)}\n"
        f"{''.join(properties)}end_header\n".encode()
    )
    file.write(rows.tobytes())


def _little(rows: ndarray) -> ndarray:
    """Rows in little-endian order, of equal values; booleans as bytes."""
    kinds = [
        (name, kind.base.newbyteorder("<") if kind.base.kind != "b" else "u1", kind.shape)
        for name, (kind, *_) in (rows.dtype.fields or {}).items()
    ]
    return rows.astype(kinds)


def _check_type(name: str, kind: np.dtype, form: str, held: object, holds: str) -> None:
    if not held:
        raise InputError(
            f"the field {name} is {kind}, which a {form} cannot hold ({holds}): convert it."
        )
    if not name.strip() or len(name.split()) > 1:
        raise InputError(f"the field {name!r} has a name that a {form} cannot hold: rename it.")


READERS = {".pcd": _read_pcd, ".ply": _read_ply}


def _split_header(data: bytes) -> tuple[str, bytes]:
    """A file's header of text, and its body."""
    end = re.search(rb"^(DATA|end_header)\b.*\n", data[: 1 << 16], re.MULTILINE)
    if end is None:
        raise InputError("it has no header of its format. Is it damaged?")
    return data[: end.end()].decode("utf-8", "replace"), data[end.end() :]


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
