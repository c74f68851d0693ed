"""Damaged scan files give one line with the file's name, or finite points."""

import os
import pickle
import re
import struct
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import Points, read_points, write_points
from tests.conftest import memory_below

# A reader that warns has met something it was not made for.
pytestmark = pytest.mark.filterwarnings("error")

# small, so that every cut and every header bit can be tried; 16 divides 20 COUNT and 12 COUNT
COUNT = 16
RNG = np.random.default_rng(7)
XYZ = np.round(RNG.standard_normal((COUNT, 3)) * [20, 20, 2], 2).astype(np.float32)
REFLECTANCE = np.round(RNG.random(COUNT), 2).astype(np.float32)
RING = (np.arange(COUNT) % 32).astype(np.float32)
TABLE = np.column_stack([XYZ, REFLECTANCE])

FORMATS = ("bin", "pcd.bin", "npy", "ply", "ply ascii", "pcd ascii", "pcd binary")
if find_spec("lzf"):
    FORMATS += ("pcd binary_compressed",)
BODY_STARTS = {"npy": rb"\} *\n", "ply": rb"end_header\n", "pcd": rb"DATA \w+\n"}


def in_every_format(folder: Path) -> dict[str, bytes]:
    """The bytes of the same scan; some are written into the folder."""
    files = {
        "bin": TABLE.tobytes(),
        "pcd.bin": np.column_stack([TABLE, RING]).tobytes(),
        "ply ascii": ply_ascii(),
        "pcd ascii": PCD_OF_4.format("ascii").encode() + TEXT,
        "pcd binary_compressed": PCD_OF_4.format("binary_compressed").encode()
        + compressed(TABLE.T.tobytes()),
    }
    for name in ("npy", "ply", "pcd binary"):
        path = folder / f"a.{name.partition(' ')[0]}"
        write_points(path, XYZ, REFLECTANCE)
        files[name] = path.read_bytes()
    return files


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, bytes]:
    return in_every_format(tmp_path_factory.mktemp("originals"))


TEXT = "".join(" ".join(str(value) for value in row) + "\n" for row in TABLE).encode()
PCD_OF_4 = (
    "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    f"WIDTH {COUNT}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {COUNT}\nDATA {{}}\n"
)


def ply_ascii() -> bytes:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    return f"ply\nformat ascii 1.0\nelement vertex {COUNT}\n{names}end_header\n".encode() + TEXT


def compressed(plain: bytes) -> bytes:
    """LZF of literals alone, with the sizes before it."""
    parts = [plain[start : start + 32] for start in range(0, len(plain), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(plain)) + packed


def read(path: Path) -> Points | None:
    """The points, checked for what every caller relies on, or None when the file was refused as it
    should be.
    """
    began, points, refusal = time.perf_counter(), None, ""
    try:
        points = read_points(path)
    except InputError as error:
        refusal = str(error)
    assert time.perf_counter() - began < 5
    if points is None:
        assert str(path) in refusal
        assert not re.search(r"\n|Warning", refusal)
        return None
    assert points.xyz.dtype == np.float32
    assert points.xyz.shape == (len(points.xyz), 3)
    assert 0 < len(points.xyz) <= COUNT
    assert np.isfinite(points.xyz).all()
    if points.reflectance is not None:
        assert points.reflectance.shape == (len(points.xyz),)
        assert np.isfinite(points.reflectance).all()
    return points


def read_bytes(folder: Path, name: str, content: bytes) -> Points | None:
    path = folder / f"damaged.{name.partition(' ')[0]}"
    path.write_bytes(content)
    return read(path)


def body_start(name: str, content: bytes) -> int:
    match = re.search(BODY_STARTS[name.partition(" ")[0]], content)
    assert match
    return match.end()


@pytest.mark.parametrize("name", FORMATS)
def test_every_truncated_file_is_refused_where_that_can_be_detected(tmp_path, originals, name):
    whole = originals[name]
    accepted = []
    for length in range(len(whole) + 1):
        points = read_bytes(tmp_path, name, whole[:length])
        if points is not None:
            accepted.append(length)
            np.testing.assert_array_equal(points.xyz, XYZ[: len(points.xyz)])
    np.testing.assert_array_equal(
        points.reflectance, REFLECTANCE
    )  # of the whole file, the last one
    if name in ("bin", "pcd.bin"):  # a cut between two rows leaves a shorter scan
        row = len(whole) // COUNT
        assert accepted == list(range(row, len(whole) + 1, row))
    elif name.endswith("ascii"):  # the last number, a reflectance, may lose digits
        assert min(accepted) > whole.rfind(b" ") + 1
    else:
        assert accepted == [len(whole)]


@pytest.mark.parametrize("name", FORMATS[2:])
def test_no_flipped_bit_in_a_header_changes_a_coordinate(tmp_path, originals, name):
    whole = originals[name]
    refused = 0
    for bit in range(8 * body_start(name, whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        points = read_bytes(tmp_path, name, bytes(damaged))
        if points is None:
            refused += 1
        else:
            np.testing.assert_array_equal(points.xyz, XYZ)
    assert refused > 100


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("name", FORMATS)
def test_flipped_bits_in_the_body_cost_their_own_points_at_most(tmp_path, originals, name, seed):
    whole = originals[name]
    start = 0 if name in ("bin", "pcd.bin") else body_start(name, whole)
    rng = np.random.default_rng(seed)
    damaged = bytearray(whole)
    for bit in rng.integers(8 * start, 8 * len(whole), 2):
        damaged[bit // 8] ^= 1 << bit % 8
    points = read_bytes(tmp_path, name, bytes(damaged))
    if points is not None and not name.endswith("compressed"):  # a damaged copy repeats itself
        assert len(points.xyz) + points.dropped == COUNT
        assert np.abs(points.xyz).max() <= 1e4  # what no LiDAR measures costs its own point
        known = {tuple(row) for row in XYZ.tolist()}
        assert sum(tuple(row) not in known for row in points.xyz.tolist()) <= 2


@pytest.mark.parametrize("name", FORMATS[2:])
@pytest.mark.parametrize("junk", [b"\x01", b"1 2 3 4\n", bytes(range(1, 33))])
def test_bytes_behind_the_last_point_are_refused(tmp_path, originals, name, junk):
    assert read_bytes(tmp_path, name, originals[name] + junk) is None


def layouts() -> dict[str, bytes]:
    """Bytes that are no KITTI rows, all of a size that rows of 16 bytes divide."""
    return {
        "big-endian": TABLE.astype(">f4").tobytes(),
        "float64": TABLE.astype("<f8").tobytes(),
        "float16": TABLE.astype("<f2").tobytes(),
        "half metres in int16": np.tile(TABLE * 2, (32, 1)).astype("<i2").tobytes(),
        "millimetres in int32": (TABLE * 1000).astype("<i4").tobytes(),
        "rows of 3": XYZ.tobytes(),
        "one byte aside": b"\n" + TABLE.tobytes()[:-1],
        "rows of 5": np.column_stack([TABLE, RING]).tobytes(),
        "noise": np.random.default_rng(0).bytes(1 << 16),
        "zeros": bytes(1024),
        "NaN": np.full((COUNT, 4), np.nan, "<f4").tobytes(),
        "mostly NaN": np.where(np.arange(COUNT)[:, None] < 0.6 * COUNT, np.nan, TABLE)
        .astype("<f4")
        .tobytes(),
        "map coordinates": (TABLE + np.float32([450000, 5400000, 110, 0])).tobytes(),
        "text": b"1.25 3.50 -0.25 0.5\n" * 64,
    }


@pytest.mark.parametrize("name", ["bin", "npy", "ply", "pcd"])
@pytest.mark.parametrize("layout", layouts())
def test_other_layouts_are_refused(tmp_path, name, layout):
    content = layouts()[layout]
    assert len(content) % 16 == 0
    assert read_bytes(tmp_path, name, content) is None


@pytest.mark.parametrize("shown", FORMATS)
@pytest.mark.parametrize("given", ["bin", "pcd.bin", "npy", "ply", "pcd"])
def test_every_format_is_refused_under_the_endings_of_others(tmp_path, originals, shown, given):
    if shown.partition(" ")[0] != given:
        content = originals[shown]
        assert read_bytes(tmp_path, given, content + bytes(-len(content) % 80)) is None


HUGE = 10**12
PCD = (
    "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"
)
PLY = "ply\nformat {1} 1.0\nelement vertex {0}\n{2}property float x\nproperty float y\nproperty float z\nend_header\n"
ROWS_OF_3 = {"ascii": b"1 2 3\n" * 9, "binary": XYZ.tobytes()}


def declarations() -> dict[str, tuple[str, bytes]]:
    """Headers that promise far more than the file holds."""
    packed = struct.pack("<II", 40, 2**32 - 1) + bytes(40)
    files = {
        "pcd ascii": ("pcd", PCD.format(HUGE, "ascii").encode() + ROWS_OF_3["ascii"]),
        "pcd binary": ("pcd", PCD.format(HUGE, "binary").encode() + ROWS_OF_3["binary"]),
        "pcd binary_compressed": ("pcd", PCD.format(HUGE, "binary_compressed").encode() + packed),
        "pcd bomb": ("pcd", PCD.format((2**32 - 1) // 12, "binary_compressed").encode() + packed),
        "pcd count": (
            "pcd",
            PCD.format(1, "binary").replace("1 1 1", f"1 1 {HUGE}").encode() + bytes(99),
        ),
        "pcd digits": ("pcd", PCD.format("9" * 5000, "ascii").encode() + ROWS_OF_3["ascii"]),
        "ply ascii": ("ply", PLY.format(HUGE, "ascii", "").encode() + ROWS_OF_3["ascii"]),
    }
    for order in ("little", "big"):
        kind = f"binary_{order}_endian"
        long_list = "property list int double echoes\n"
        empty = f"element nothing {HUGE}\nelement vertex"
        files |= {
            kind: ("ply", PLY.format(HUGE, kind, "").encode() + ROWS_OF_3["binary"]),
            f"{kind} lists": ("ply", PLY.format(HUGE, kind, long_list).encode() + b"\x7f" * 999),
            f"{kind} negative "
            "list": ("ply", PLY.format(9, kind, long_list).encode() + b"\xff" * 999),
            f"{kind} empty element": (
                "ply", PLY.format(HUGE, kind, "").replace("element vertex", empty).encode() + bytes(99)
            ),
        }  # fmt: skip
    for shape in ((HUGE, 3), (2**62, 4), (2**64, 3), (-1, 3)):
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}\n".encode()
        content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + XYZ.tobytes()
        files[f"npy {shape}"] = ("npy", content)
    return files


@pytest.mark.parametrize("name", declarations())
def test_memory_is_not_allocated_for_a_declared_size(tmp_path, name):
    ending, content = declarations()[name]
    with memory_below(1 << 20):
        assert read_bytes(tmp_path, ending, content) is None


ROW = PCD.format(1, "ascii").encode() + b"1 2 3\n"
WRONG = {
    "a ring between two": ("pcd.bin", np.column_stack([TABLE, RING + 0.5]).astype("<f4").tobytes()),
    "another kind of file": ("obj", b"# a mesh"),
    "unknown data": ("pcd", ROW.replace(b"ascii", b"zip")),
    "no z": ("pcd", ROW.replace(b"x y z", b"x y w")),
    "a field too few": ("pcd", ROW.replace(b"x y z", b"x y")),
    "unknown type": ("pcd", ROW.replace(b"F F F", b"F F U").replace(b"4 4 4", b"4 4 3")),
    "a short line": ("pcd", ROW.replace(b"1 2 3", b"1 2")),
    "a long line": ("pcd", ROW.replace(b"1 2 3", b"1 2 3 4")),
    "a word": ("pcd", ROW.replace(b"1 2 3", b"1 2 six")),
    "an accent": ("pcd", ROW.replace(b"1 2 3", b"\xe9 2 3")),
    "NaN alone": ("pcd", ROW.replace(b"1 2 3", b"nan 2 3")),
    "another count of points": ("xyz", b"3\n1 2 3\n4 5 6\n"),
    "no vertex": ("ply", ply_ascii().replace(b"vertex", b"vertices")),
    "no format": ("ply", ply_ascii().replace(b"format ascii 1.0\n", b"")),
    "a list": ("ply", ply_ascii().replace(b"property float x", b"property list uchar float x")),
    "unknown property": ("ply", ply_ascii().replace(b"float x", b"long x")),
    "a negative count": ("ply", ply_ascii().replace(f"vertex {COUNT}".encode(), b"vertex -4")),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_headers_and_rows_are_refused(tmp_path, case):
    assert read_bytes(tmp_path, *WRONG[case]) is None


def test_a_list_of_scans_pickled_as_a_pcd_is_not_read_and_its_cure_named(tmp_path):
    with (tmp_path / "samples.pcd").open("wb") as file:
        pickle.dump([np.zeros((4, 3), np.float32)], file)
    with pytest.raises(InputError, match=r"is a pickle.*joblib\.load"):
        read_points(tmp_path / "samples.pcd")


def test_paths_that_are_not_regular_files_are_refused(tmp_path):
    (tmp_path / "folder.bin").mkdir()
    (tmp_path / "link.bin").symlink_to(tmp_path / "gone.bin")
    (tmp_path / "loop.bin").symlink_to(tmp_path / "loop.bin")
    os.mkfifo(tmp_path / "pipe.bin")
    for name in ("folder", "link", "loop", "pipe", "missing", "missing/a", "n" * 300, "nul\0"):
        assert read(tmp_path / f"{name}.bin") is None


def test_a_file_too_large_for_one_scan_is_not_loaded(tmp_path):
    for name in ("a.bin", "a.pcd", "a.ply", "a.npy"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(1 << 40)  # sparse: takes no disk
        assert read(tmp_path / name) is None
