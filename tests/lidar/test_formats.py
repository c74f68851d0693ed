"""Scans of other formats, written by their own libraries, are the points that were written."""

import resource
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import ELSEWHERE, NoPointsError, read_points, write_points
from tests.conftest import refused
from tests.lidar.conftest import assert_points

DRAW = np.random.default_rng(3)
XYZ = np.round(DRAW.standard_normal((500, 3)) * [20, 20, 2], 3)
INTENSITY = DRAW.integers(0, 256, 500)
RING = DRAW.integers(0, 64, 500)
F4 = XYZ.astype(np.float32)


def same(points, ring=None, intensity=INTENSITY, xyz=F4) -> None:
    assert_points(points, xyz, intensity, ring)


TABLE = np.column_stack([XYZ, INTENSITY])
WIDE = np.column_stack([np.arange(500), XYZ[:, 2], XYZ[:, 0], XYZ[:, 1], RING, INTENSITY]).astype(
    np.float32
)
NAMES = ("time", "z", "x", "y", "ring", "intensity")


@pytest.mark.parametrize("ending", ["csv", "txt", "xyz"])
@pytest.mark.parametrize(
    "options",
    [
        {"delimiter": " "},
        {"delimiter": ","},
        {"delimiter": "\t"},
        {"delimiter": ";", "header": "X;Y;Z;Intensity", "comments": ""},
        {"delimiter": ",", "header": "x [m],y [m],z [m],intensity", "comments": ""},
        {"delimiter": " ", "header": "X Y Z Intensity", "comments": "//"},
        {
            "delimiter": ",",
            "header": '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","intensity"',
            "comments": "",
        },
        {"delimiter": " ", "header": "a scan of mine\nof today", "comments": "# "},
        {"delimiter": " ", "header": "here are x y z in metres", "comments": "# "},
        {"delimiter": " ", "header": "500", "comments": ""},
        {"delimiter": ",", "header": "0,1,2,3", "comments": ""},
    ],
    ids=[
        "spaces",
        "commas",
        "tabs",
        "semi",
        "units",
        "names",
        "VeloView",
        "comments",
        "words",
        "count",
        "pandas",
    ],
)
def test_columns_of_text(tmp_path: Path, ending: str, options: dict):
    path = tmp_path / f"a.{ending}"
    np.savetxt(path, TABLE, fmt=["%.3f"] * 3 + ["%d"], **options)
    same(read_points(path))
    np.savetxt(path, TABLE[:, :3], fmt='"%.3f"', delimiter=options["delimiter"])
    same(read_points(path), intensity=None)


def test_columns_are_named_where_the_file_does_not(tmp_path: Path):
    WIDE.tofile(tmp_path / "a.bin")
    np.save(tmp_path / "a.npy", WIDE.astype(np.float64))
    np.savetxt(tmp_path / "a.txt", WIDE, fmt="%.6g")
    for name in ("a.bin", "a.npy", "a.txt"):
        same(read_points(tmp_path / name, NAMES), RING)
        same(read_points(tmp_path / name, ("_", "z", "x", "y", "_", "_")), intensity=None)
        for wrong in (("x", "y"), ("x", "y", "z", "x"), ("x", "y", "z", "intensity", "i")):
            with pytest.raises(InputError, match="columns must name x, y and z"):
                read_points(tmp_path / name, wrong)
    for name in ("a.npy", "a.txt"):
        with pytest.raises(InputError, match=r"6 columns, not 4: name all by --columns x,y,z"):
            read_points(tmp_path / name)
        with pytest.raises(InputError, match=r"6 columns, not 5: name all"):
            read_points(tmp_path / name, ("x", "y", "z", "_", "_"))


def test_files_that_name_their_columns_take_no_others(tmp_path: Path):
    np.savetxt(tmp_path / "a.csv", TABLE, delimiter=",", header="x,y,z,intensity", comments="")
    with pytest.raises(InputError, match="names its columns"):
        read_points(tmp_path / "a.csv", ("x", "y", "z", "intensity"))


def write_named(path: Path, strength: str) -> None:
    """A table of named columns: x, y, z, the ring as `channel`, and `strength`, INTENSITY."""
    table = np.column_stack([XYZ, RING, INTENSITY])
    header = f"x,y,z,channel,{strength}"
    np.savetxt(path, table, "%.6g", ",", header=header, comments="")


@pytest.mark.parametrize("name", ["intensities", "Signal", "scalar_amplitude"])
def test_a_field_that_may_be_the_reflectance_is_named_and_renamed(tmp_path, caplog, name):
    path = tmp_path / f"{name}.csv"
    write_named(path, name)
    same(read_points(path), RING, intensity=None)
    assert f"not used: {name}. --columns {name}=reflectance" in caplog.text
    caplog.clear()
    for role in ("reflectance", "Intensity"):
        same(read_points(path, [f"{name.lower()}={role}"]), RING)
    assert read_points(path, [f"{name}=i", "channel=_"]).ring is None
    assert not caplog.records


@pytest.mark.parametrize("other", ["", "gain"])
def test_fields_that_a_completion_wrote_are_not_offered_as_reflectance(tmp_path, caplog, other):
    names = ["x", "y", "z", "measured", "image_row", "error_68", "error_95", "p_return"]
    header = ",".join([*names, *filter(None, [other])])
    table = np.column_stack([XYZ, np.ones((500, header.count(",") - 2))])
    np.savetxt(tmp_path / "a.csv", table, "%.6g", ",", header=header, comments="")
    same(read_points(tmp_path / "a.csv"), intensity=None)
    assert ("not used: gain." in caplog.text) == bool(other)
    assert bool(caplog.records) == bool(other)


def test_a_rename_precedes_the_usual_names(tmp_path):
    path = tmp_path / "a.npy"
    names = ("x", "y", "z", "intensity", "strength", "ring", "beam")
    table = np.zeros(500, [(name, "f4") for name in names])
    for name, column in zip(
        ("x", "y", "z", "strength", "beam"), (*XYZ.T, INTENSITY, RING), strict=True
    ):
        table[name] = column
    table["intensity"] = 9
    np.save(path, table)
    same(read_points(path), 0 * RING, intensity=np.full(500, 9))
    same(read_points(path, ("strength=reflectance", "beam=ring")), RING)
    for wrong, words in (
        (["power=reflectance"], "no field power; it has: x, y, z, intensity, strength"),
        (["strength=power"], "columns rename fields to x, y, z, reflectance, ring"),
        (["strength"], "columns must name x, y and z"),
        (["x", "y", "z"], "rename some, as --columns intensities=reflectance"),
    ):
        with pytest.raises(InputError, match=words):
            read_points(path, wrong)
    TABLE.astype("<f4").tofile(tmp_path / "a.bin")
    np.savetxt(tmp_path / "a.txt", TABLE)
    for name in ("a.bin", "a.txt"):
        with pytest.raises(InputError, match="does not name its columns: name all"):
            read_points(tmp_path / name, ["i=reflectance"])


def test_fields_of_arrow_and_las_are_renamed(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    from pyarrow import feather

    x, y, z = F4.T.copy()
    feather.write_feather(
        pyarrow.table({"x": x, "y": y, "z": z, "signal": INTENSITY}), tmp_path / "a.feather"
    )
    same(read_points(tmp_path / "a.feather", ["signal=reflectance"]))
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    cloud.x, cloud.y, cloud.z = XYZ.T
    cloud.add_extra_dim(laspy.ExtraBytesParams(name="Amplitude", type=np.float32))
    cloud["Amplitude"] = INTENSITY
    cloud.write(tmp_path / "a.las")
    points = read_points(tmp_path / "a.las", ["amplitude=reflectance"])
    np.testing.assert_array_equal(points.reflectance, INTENSITY)


def test_ousters_table_of_a_scan(tmp_path):
    """As ouster-cli of ouster-sdk 1.0.1 writes it, of one and of two returns; the first is read."""
    head = (
        "frame num: 7\nTIMESTAMP (ns), ROW, DESTAGGERED IMAGE COLUMN, MEASUREMENT_ID, RANGE (mm), "
    )
    head += "REFLECTIVITY (%), X1 (m), Y1 (m), Z1 (m)"
    n = np.arange(500)
    table = np.column_stack([n + 10**12, RING, n, n, 1000 * n, INTENSITY, XYZ])
    for more, width in ((", X2 (m), Y2 (m), Z2 (m)", 3), ("", 0)):
        np.savetxt(
            tmp_path / "a.csv",
            np.column_stack([table, XYZ[:, :width] + 1]),
            ["%d"] * 6 + ["%.4f"] * (3 + width),
            delimiter=",",
            header=head + more,
        )
        same(read_points(tmp_path / "a.csv"), RING)


def test_arrays_of_images_in_another_order_say_which_is_read(tmp_path):
    path = tmp_path / "a.npy"
    for shape in ((16, 64, 2), (16, 64, 3), (16, 64)):
        np.save(path, np.ones(shape, np.float32))
        with pytest.raises(InputError, match=r"Range images are floats \(2, H, W\)"):
            read_points(path)


def test_arrays_with_named_fields(tmp_path: Path):
    fields = np.zeros(
        500, [("x", "f4"), ("y", "f4"), ("z", "f8"), ("ring", "u1"), ("intensity", "u2")]
    )
    for name, column in zip(
        ("x", "y", "z", "ring", "intensity"), (*XYZ.T, RING, INTENSITY), strict=True
    ):
        fields[name] = column
    np.save(tmp_path / "a.npy", fields)
    same(read_points(tmp_path / "a.npy"), RING)
    for array, words in (
        (np.array([object()]), "objects"),
        (F4[None], r"\(1, 500, 3\), not points"),
    ):
        np.save(tmp_path / "a.npy", array)
        with pytest.raises(InputError, match=words):
            read_points(tmp_path / "a.npy")


def test_tables_of_arrow(tmp_path: Path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    from pyarrow import feather, parquet

    x, y, z = F4.astype(np.float16).T.copy()
    bytes_of = {"intensity": INTENSITY.astype(np.uint8), "laser_number": RING.astype(np.uint8)}
    argoverse = {"x": x, "y": y, "z": z, **bytes_of, "offset_ns": np.arange(500, dtype=np.int32)}
    for compression in ("uncompressed", "lz4", "zstd"):
        feather.write_feather(
            pyarrow.table(argoverse), tmp_path / "a.feather", compression=compression
        )
        same(
            read_points(tmp_path / "a.feather"), RING, xyz=F4.astype(np.float16).astype(np.float32)
        )
    table = pyarrow.table(
        {
            "x": XYZ[:, 0],
            "y": XYZ[:, 1],
            "z": XYZ[:, 2],
            "Intensity": INTENSITY,
            "label": ["car"] * 500,
        }
    )
    for compression in ("none", "snappy"):
        parquet.write_table(
            table, tmp_path / "a.parquet", compression=compression, row_group_size=100
        )
        same(read_points(tmp_path / "a.parquet"))
    parquet.write_table(pyarrow.table({"x": ["a"], "y": [1.0], "z": [1.0]}), tmp_path / "b.parquet")
    with pytest.raises(InputError, match="in the place of"):
        read_points(tmp_path / "b.parquet")
    parquet.write_table(
        pyarrow.table({"points": [[1.0]], "intensity": [1.0]}), tmp_path / "c.parquet"
    )
    with pytest.raises(InputError, match="no field x, y, z; it has: points, intensity"):
        read_points(tmp_path / "c.parquet")


@pytest.mark.parametrize(("version", "form"), [("1.2", 0), ("1.4", 6)])
def test_las(tmp_path: Path, version: str, form: int):
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    header = laspy.LasHeader(version=version, point_format=form)
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    path = tmp_path / "a.las"
    cloud.write(path)
    points = read_points(path)
    np.testing.assert_allclose(points.xyz, XYZ, atol=6e-4)
    assert points.reflectance is None  # LAS has a field for it, which nobody has filled
    cloud.add_extra_dim(laspy.ExtraBytesParams(name="ring", type=np.uint16))
    cloud.intensity, cloud["ring"] = INTENSITY * 256, RING
    cloud.write(path)
    points = read_points(path)
    np.testing.assert_array_equal(points.reflectance, INTENSITY * 256)
    np.testing.assert_array_equal(points.ring, RING)


@pytest.mark.parametrize("name", ["a.las", "a.feather", "a.parquet"])
def test_an_extra_that_is_missing_is_one_line_with_the_command(
    tmp_path: Path, monkeypatch, name: str
):
    monkeypatch.setattr("r2flow.base.errors.find_spec", lambda package: None)
    (tmp_path / name).write_bytes(b"something")
    with pytest.raises(InputError, match=r"python -m pip install 'r2flow\[formats\]'"):
        read_points(tmp_path / name)


def test_a_small_file_takes_little_memory(tmp_path: Path):
    """Headers of a .las that declare many points or long records."""
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    cloud = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    cloud.x, cloud.y, cloud.z = XYZ.T
    path = tmp_path / "a.las"
    cloud.write(path)
    whole = path.read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for place, width in ((96, 4), (100, 4), (105, 2), (243, 4), (247, 8)):
        for value in (2 ** (8 * width - 1) - 1, 1 << 20):
            path.write_bytes(
                whole[:place]
                + (value % 256**width).to_bytes(width, "little")
                + whole[place + width :]
            )
            with suppress(InputError):
                read_points(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + (100 << 10)


@pytest.mark.parametrize("ending", [*chain(*ELSEWHERE)])
def test_what_is_not_read_says_which_tool_converts_it(tmp_path: Path, ending: str):
    path = tmp_path / f"recording{ending}"
    for problem in ("does not exist", ""):
        with pytest.raises(InputError, match=f"^{path} {problem}") as caught:
            read_points(path)
        path.touch()
    assert not any(word in str(caught.value) for word in ("{", "rename"))


def test_text_that_is_no_scan_is_refused(tmp_path: Path):
    for text, words in (
        ("", "empty"),
        ("# nothing\n", "no line of numbers"),
        ("x,y,z\n", "no line"),
        ("1 2\n3 4\n", "2 columns, not 3"),
        ("1,2,,4\n" * 3, "NaN"),
        ("x y z\n1 2 3 4\n", "longer than the names"),  # numbers of rows, as of R
        ("time;lat;rgb\n1;2;0,0,255\n", "no field x, y, z; it has: time, lat, rgb"),
        ("1 2 3\n4 5\n", "number of columns changed"),
        ("1 2 3\nfour 5 6\n", "four"),
        ("1 2 \xe9\n", "convert"),
    ):
        (tmp_path / "a.txt").write_text(text, encoding="latin-1")
        with refused(words):
            read_points(tmp_path / "a.txt")


def test_a_table_may_have_units_gaps_and_words(tmp_path: Path):
    """VeloView's numbers of lasers, a sign of degrees in the header, and no numbers in the row of a
    lost ray.
    """
    table = zip(XYZ, INTENSITY, RING, strict=True)
    rows = "\n".join(
        f"{x:.3f},{y:.3f},{z:.3f},{strength},{ring},0" for (x, y, z), strength, ring in table
    )
    head = "Points:0,Points:1,Points:2,intensity,laser_id,azimuth \u00b0\n,,,,3,\n"
    (tmp_path / "a.csv").write_text(head + rows + "\n", encoding="utf-8")
    points = read_points(tmp_path / "a.csv")
    same(points, RING)
    assert points.dropped == 1
    (tmp_path / "b.csv").write_text(
        "x,y,z,intensity\n" + "".join(f"{x},{y},{z},7,\n" for x, y, z in F4)
    )
    same(read_points(tmp_path / "b.csv"), intensity=np.full(500, 7))
    (tmp_path / "c.csv").write_text(
        "x,y,z,class\n" + "".join(f'"{x}","{y}","{z}","a car"\n' for x, y, z in F4)
    )
    same(read_points(tmp_path / "c.csv"), intensity=None)
    np.savetxt(
        tmp_path / "d.csv",
        np.c_[np.arange(500), WIDE],
        "%.6g",
        ";",
        header=f";{';'.join(NAMES)}",
        comments="",
    )
    same(read_points(tmp_path / "d.csv"), RING)  # of pandas, a column without a name
    for head in (
        "# range,azimuth,elevation,intensity",
        "x (mm),y (mm),z (mm),intensity",
        "# x [ft],y [ft],z [ft],i",
    ):
        np.savetxt(tmp_path / "e.csv", TABLE, delimiter=",", header=head, comments="")
        with pytest.raises(
            InputError, match=r"no field x, y, z; it has: (range, azimuth|x \(mm\)|x \[ft\]), "
        ):
            read_points(tmp_path / "e.csv")


def test_an_intensity_that_nobody_measured_leaves_the_reflectivity(tmp_path: Path):
    table = np.zeros(500, [(name, "f4") for name in ("x", "y", "z", "reflectivity", "intensity")])
    for name, column in zip("xyz", F4.T, strict=True):
        table[name] = column
    sevens = np.full(500, 7)
    for reflectivity, intensity, read in (
        (0, 0, 0 * sevens),
        (INTENSITY, 0, INTENSITY),
        (INTENSITY, sevens, sevens),
    ):
        table["reflectivity"], table["intensity"] = reflectivity, intensity
        np.save(tmp_path / "a.npy", table)
        same(read_points(tmp_path / "a.npy"), intensity=read)


@pytest.mark.parametrize("kind", ["S3", "(2,)f4", "(1,)f4", "c8"])
@pytest.mark.parametrize("name", ["x", "intensity", "ring"])
def test_fields_that_hold_no_numbers_are_refused(tmp_path: Path, name: str, kind: str):
    table = np.zeros(
        4, [(one, kind if one == name else "f4") for one in ("x", "y", "z", "intensity", "ring")]
    )
    np.save(tmp_path / "a.npy", table)
    with pytest.raises(InputError, match="in the place of one number"):
        read_points(tmp_path / "a.npy")


@pytest.mark.parametrize("ending", ["bin", "pcd", "ply"])
def test_a_scan_without_a_point_is_one(tmp_path: Path, ending: str):
    """As r2flow writes them; what may be empty, as a generated scan, is told from what is damaged."""
    write_points(tmp_path / f"a.{ending}", np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    with pytest.raises(NoPointsError):
        read_points(tmp_path / f"a.{ending}")


@pytest.mark.parametrize("words", ["t x y z intensity", "#time x y z intensity", "intensity y x z"])
def test_a_comment_with_a_name_for_each_number_names_the_columns(tmp_path: Path, words: str):
    columns = {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "intensity": INTENSITY}
    table = np.column_stack(
        [columns.get(name, np.full(len(XYZ), 0.5)) for name in words.strip("#").split()]
    )
    np.savetxt(tmp_path / "a.txt", table, fmt="%.3f", header=words)
    same(read_points(tmp_path / "a.txt"))
