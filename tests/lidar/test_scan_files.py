"""Scan files against bytes assembled here, by hand or with struct, and against themselves."""

import struct
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import read_points, write_points
from tests.lidar.conftest import assert_points

# Three points with values that float32 holds exactly, a reflectance each, and a ring.
ROWS = [(1.5, -2.0, 0.25, 0.5, 3), (-10.0, 20.0, -1.75, 0.0, 0), (0.0, 0.0, 7.0, 1.0, 31)]
XYZ = [row[:3] for row in ROWS]
REFLECTANCE = [row[3] for row in ROWS]
RING = [row[4] for row in ROWS]


def saved(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def pcd_header(fields: str, size: str, kind: str, data: str, count: int = 3) -> str:
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\n"
        f"COUNT {' '.join('1' for _ in fields.split())}\nWIDTH {count}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    )


def expect_rows(points, reflectance=REFLECTANCE, ring=None):
    assert_points(points, XYZ, reflectance, ring)
    assert points.dropped == 0


def test_pcd_ascii_in_any_order_and_case_with_other_fields(tmp_path):
    text = pcd_header("label Z Remission X ring y", "2 4 8 4 2 4", "U F F F U F", "ascii")
    text += "".join(f"9 {z} {i} {x} {ring} {y}\n" for x, y, z, i, ring in ROWS)
    expect_rows(read_points(saved(tmp_path, "a.PCD", text)), ring=RING)


def test_pcd_binary_of_mixed_types_with_a_field_of_several_numbers(tmp_path):
    # Padding fields share the name "_" in PCL's own files.
    header = (
        "VERSION .7\nFIELDS _ x y z _ intensity normal ring\nSIZE 1 8 4 4 1 1 4 1\nTYPE U F F F U "
        "U F I\n"
        "COUNT 3 1 1 1 2 1 3 1\nWIDTH 1\nHEIGHT 3\nPOINTS 3\nDATA binary\n"
    )
    rows = [
        struct.pack("<3Bdff2BB3fb", 7, 7, 7, x, y, z, 7, 7, int(i * 2), 9, 9, 9, ring)
        for x, y, z, i, ring in ROWS
    ]
    points = read_points(saved(tmp_path, "a.pcd", header.encode() + b"".join(rows)))
    expect_rows(points, reflectance=[1, 0, 2], ring=RING)  # as stored, not rescaled


def test_pcd_without_count_and_points_lines_and_without_reflectance(tmp_path):
    text = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nDATA ascii\n"
    text += "\n".join(f"{x} {y} {z}" for x, y, z in XYZ)
    expect_rows(read_points(saved(tmp_path, "a.pcd", text)), reflectance=None)


def test_pcd_headers_of_old_drivers(tmp_path):
    """Fields that store nothing, a size in POINTS alone, and the key COLUMNS."""
    head = "FIELDS x y z _ intensity\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 0 1\n"
    head += "WIDTH 0\nHEIGHT 0\nPOINTS 3\n"
    rows = np.array([row[:4] for row in ROWS], "<f4")
    text = "".join(f"{x} {y} {z} {i}\n" for x, y, z, i in rows)
    for start in (head, head.replace("FIELDS", "COLUMNS")):
        expect_rows(read_points(saved(tmp_path, "a.pcd", f"{start}DATA ascii\n{text}")))
        binary = f"{start}DATA binary\n".encode() + rows.tobytes()
        expect_rows(read_points(saved(tmp_path, "a.pcd", binary)))


def test_a_channel_is_a_ring(tmp_path):
    """Autoware's XYZIRC."""
    head = pcd_header("x y z intensity return_type channel", "4 4 4 1 1 2", "F F F U U U", "binary")
    rows = [struct.pack("<3fBBH", x, y, z, int(2 * i), 1, ring) for x, y, z, i, ring in ROWS]
    points = read_points(saved(tmp_path, "a.pcd", head.encode() + b"".join(rows)))
    expect_rows(points, reflectance=[1, 0, 2], ring=RING)


PLY_ASCII = """ply
format ascii 1.0
comment by hand
element vertex 3
property double X
property float y
property uchar echoes
property float z
property float scalar_Intensity
element camera 2
property float f
property int pixels
element face 1
property list uchar int vertex_indices
end_header
1.5 -2 2 0.25 0.5
-10 2e1 0 -1.75 0
0 0 1 7 1
0.5 2
0.7 3
3 0 1 2
"""


def test_ply_ascii_before_other_elements(tmp_path):
    expect_rows(read_points(saved(tmp_path, "a.ply", PLY_ASCII)))
    expect_rows(read_points(saved(tmp_path, "b.ply", PLY_ASCII.replace("\n", "\r\n"))))


@pytest.mark.parametrize(("order", "name"), [("<", "little"), (">", "big")])
def test_ply_binary_in_both_byte_orders_before_other_elements(tmp_path, order, name):
    header = (
        f"ply\nformat binary_{name}_endian 1.0\nelement vertex 3\n"
        "property uchar red\nproperty float x\nproperty double y\nproperty float32 z\nproperty "
        "ushort ring\n"
        "property uint8 reflectance\nelement pose 2\nproperty short p\nelement face 1\nproperty "
        "list uchar int vertex_indices\nend_header\n"
    )
    rows = [struct.pack(order + "BfdfHB", 9, *row[:3], row[4], int(row[3] * 2)) for row in ROWS]
    body = b"".join(rows) + struct.pack(order + "hhB3i", 1, 2, 3, 0, 1, 2)
    expect_rows(
        read_points(saved(tmp_path, "a.ply", header.encode() + body)),
        reflectance=[1, 0, 2],
        ring=RING,
    )


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f4", "<f8", ">f8"])
def test_npy_of_any_float_type_and_order(tmp_path, dtype):
    np.save(
        tmp_path / "a.npy", np.array(ROWS, [(name, dtype) for name in ("x", "y", "z", "i", "ring")])
    )
    expect_rows(read_points(tmp_path / "a.npy"), ring=RING)
    np.save(tmp_path / "b.npy", np.asfortranarray(np.array([row[:4] for row in ROWS], dtype=dtype)))
    expect_rows(read_points(tmp_path / "b.npy"))


def test_rows_of_another_width_are_read_by_the_names_of_their_columns(tmp_path):
    rows = [[*row[:3], 1, row[3], 3e-45, 0, 9] for row in ROWS]
    path = saved(tmp_path, "a.bin", np.array(rows, dtype="<f4").tobytes())
    assert_points(read_points(path, [*"xyz", "_", "intensity", *"___"]), XYZ, REFLECTANCE)
    with pytest.raises(InputError, match="rows of 7 float32: 12 bytes are left.*--columns"):
        read_points(path, [*"xyz", *"____"])
    with pytest.raises(InputError, match="integer reflectance"):
        read_points(
            saved(
                tmp_path,
                "b.bin",
                np.array([(*xyz, 9) for xyz in XYZ], dtype="<f4,<f4,<f4,<u4").tobytes(),
            )
        )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", range(4))
def test_a_row_that_is_not_finite_is_dropped_and_counted(tmp_path, bad, column):
    rows = np.array(ROWS, dtype=np.float32)
    rows[1, column] = bad
    points = read_points(saved(tmp_path, "a.pcd.bin", rows.tobytes()))
    assert points.dropped == 1
    assert_points(points, XYZ[::2], REFLECTANCE[::2], RING[::2])


def test_an_organised_pcd_may_be_mostly_nan(tmp_path):
    text = pcd_header("x y z", "4 4 4", "F F F", "ascii", count=4) + "nan nan nan\n" * 3 + "1 2 3\n"
    points = read_points(saved(tmp_path, "a.pcd", text))
    assert points.dropped == 3
    np.testing.assert_array_equal(points.xyz, [[1, 2, 3]])


def test_a_coordinate_beyond_float32_is_dropped_as_infinite(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1.0, 2.0, 3.0], [1e300, 0.0, 0.0]]))
    assert read_points(tmp_path / "a.npy").dropped == 1


def scan(count: int = 5000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xyz = (rng.standard_normal((count, 3)) * [20, 20, 2]).astype(np.float32)
    return xyz, rng.integers(0, 100, count).astype(np.float32) / np.float32(100)


@pytest.mark.parametrize("ending", ["bin", "ply", "npy", "pcd"])
def test_written_scans_are_read_back_bit_for_bit(tmp_path, ending):
    xyz, reflectance = scan()
    path = tmp_path / "new folder" / f"a.{ending}"
    write_points(path, xyz, reflectance)
    points = read_points(path)
    assert_points(points, xyz, reflectance)
    assert points.dropped == 0
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no temporary file stays
    assert points.xyz.flags.c_contiguous
    assert points.xyz.flags.writeable  # PyTorch warns of arrays that are views of a file's bytes
    assert points.reflectance.flags.writeable
    if ending != "bin":
        write_points(path, xyz)
        assert read_points(path).reflectance is None


@pytest.mark.parametrize(
    ("name", "change", "word"),
    [
        ("a.bin", {"reflectance": None}, "reflectance"),
        ("a.pcd.bin", {}, "written as"),
        ("a.las", {}, ".npy"),
    ],
)
def test_a_refused_write_leaves_the_old_file(tmp_path, name, change, word):
    path = saved(tmp_path, name, b"old")
    with pytest.raises(InputError, match=word):
        write_points(
            path, **({"xyz": np.array(XYZ), "reflectance": np.array(REFLECTANCE)} | change)
        )
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1
