"""Files keep every field: what is written is read back with its name, type and bits."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.times import errors, scans
from r2flow.base.errors import InputError
from r2flow.lidar.added_times import times_of
from r2flow.lidar.scan_files import Cloud, read_cloud, read_points, write_cloud

FIELDS = [
    ("x", "f8"), ("y", "f4"), ("z", "f4"), ("intensity", "u1"), ("ring", "u2"), ("time", "f4"),
    ("ambient", "f4"), ("flags", "i2"),
]  # fmt: skip


def table(count: int = 50, kinds: list = FIELDS) -> np.ndarray:
    """Rows with every bit of their fields in use."""
    draws = np.random.default_rng(0)
    rows = np.zeros(count, kinds)
    for name in rows.dtype.names:
        kind = rows.dtype[name]
        if kind.base.kind == "f":
            rows[name] = draws.normal(size=(count, *kind.shape)) * 7
        else:
            info = np.iinfo(kind)
            rows[name] = draws.integers(info.min, info.max, count, kind.newbyteorder("="), True)
    return rows


def assert_same(cloud: Cloud, rows: np.ndarray) -> None:
    assert cloud.names == rows.dtype.names
    for name, column in zip(cloud.names, cloud.columns, strict=True):
        assert column.dtype.newbyteorder("=") == rows[name].dtype.newbyteorder("="), name
        assert column.astype(rows[name].dtype).tobytes() == rows[name].tobytes(), name


@pytest.mark.parametrize("ending", [".pcd", ".ply", ".npy"])
def test_all_fields_are_read_back_to_the_bit(tmp_path: Path, ending: str):
    kinds = FIELDS if ending == ".ply" else [*FIELDS, ("stamp", "u8"), ("normal", "f4", (3,))]
    write_cloud(tmp_path / f"a{ending}", Cloud.of(table(kinds=kinds)))
    assert_same(read_cloud(tmp_path / f"a{ending}"), table(kinds=kinds))


def test_the_order_of_bytes_of_an_array_is_kept(tmp_path: Path):
    rows = table(kinds=[(name, f">{kind}") for name, kind in FIELDS])
    write_cloud(tmp_path / "a.npy", Cloud.of(rows))
    assert np.load(tmp_path / "a.npy").tobytes() == rows.tobytes()


@pytest.mark.parametrize("ending", [".feather", ".parquet"])
def test_a_table_keeps_its_types_and_notes(tmp_path: Path, ending: str):
    pa = pytest.importorskip("pyarrow")
    from pyarrow import feather, parquet

    rows = table()
    words = ["a", None] * 25
    columns = {name: rows[name] for name in rows.dtype.names} | {"word": words}
    stored = pa.table(columns).replace_schema_metadata({"by": "hand"})
    write = feather.write_feather if ending == ".feather" else parquet.write_table
    write(stored, tmp_path / f"a{ending}")
    write_cloud(tmp_path / f"b{ending}", read_cloud(tmp_path / f"a{ending}"))
    read = feather.read_table if ending == ".feather" else parquet.read_table
    again = read(tmp_path / f"b{ending}")
    assert again.equals(stored)
    assert again.schema.metadata[b"by"] == b"hand"


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_las_keeps_its_dimensions(tmp_path: Path, ending: str):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [5.0, 0, 0]
    header.add_extra_dim(laspy.ExtraBytesParams("ambient", "f4"))
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(40, header=header))
    draws = np.random.default_rng(0)
    las.X, las.Y, las.Z = draws.integers(-90_000, 90_000, (3, 40), np.int32)
    las.intensity, las.gps_time = np.arange(40) * 1000, draws.normal(size=40)
    las.return_number, las.ambient = np.arange(40) % 4, draws.normal(size=40).astype("f4")
    las.write(tmp_path / f"a{ending}")
    cloud = read_cloud(tmp_path / f"a{ending}")
    write_cloud(tmp_path / f"b{ending}", cloud.with_fields({"measured": np.ones(40, np.uint8)}))
    again = laspy.read(tmp_path / f"b{ending}")
    for name in las.point_format.dimension_names:
        assert np.array_equal(las[name], again[name]), name
    assert np.array_equal(again.measured, np.ones(40))
    assert np.array_equal(again.header.offsets, header.offsets)


def test_text_keeps_names_and_integers_that_floats_round(tmp_path: Path):
    stamps = 1_700_000_000_000_000_001 + np.arange(3)
    lines = [f"{x + 0.1},2.5,-1,{x},{t}\n" for x, t in enumerate(stamps)]
    (tmp_path / "a.csv").write_text("x,y,z,RING,t (ns)\n" + "".join(lines))
    write_cloud(tmp_path / "b.csv", read_cloud(tmp_path / "a.csv"))
    assert (tmp_path / "b.csv").read_text() == (tmp_path / "a.csv").read_text()
    cloud = read_cloud(tmp_path / "b.csv")
    assert list(cloud.columns[4]) == list(stamps)
    assert [column.dtype for column in cloud.columns[3:]] == [np.int32, np.int64]


def test_text_keeps_the_types_of_whole_numbers(tmp_path: Path):
    (tmp_path / "a.csv").write_text("x,y,z,ring,t,late\n1,2,3,0,0.0,1\n4,5,6,1,1.0,2.0\n")
    write_cloud(tmp_path / "b.csv", read_cloud(tmp_path / "a.csv"))
    lines = (tmp_path / "b.csv").read_text().split()
    assert lines == ["x,y,z,ring,t,late", "1,2,3,0,0.0,1.0", "4,5,6,1,1.0,2.0"]
    for name in ("a.csv", "b.csv"):
        kinds = "".join(column.dtype.kind for column in read_cloud(tmp_path / name).columns)
        assert kinds == "fffiff"


@pytest.mark.parametrize(("name", "width"), [("a.bin", 4), ("a.pcd.bin", 5), ("a.npy", 4)])
def test_what_rows_without_names_cannot_hold_lies_beside_them(tmp_path, name: str, width: int):
    rows = np.random.default_rng(0).normal(size=(30, width)).astype("f4") ** 2
    rows[:, 4:] //= 1
    np.save(tmp_path / name, rows) if name == "a.npy" else rows.tofile(tmp_path / name)
    cloud = read_cloud(tmp_path / name)
    measured = (np.arange(30) < 20).astype(np.uint8)
    write_cloud(tmp_path / "b" / name, cloud.with_fields({"measured": measured}))
    assert (tmp_path / "b" / name).read_bytes() == (tmp_path / name).read_bytes()
    again = read_cloud(tmp_path / "b" / name)
    assert np.array_equal(again.column("measured"), measured)
    assert len(again.measured()) == 20
    assert len(read_points(tmp_path / "b" / name).xyz) == 30
    write_cloud(tmp_path / "b" / name, cloud.take(np.arange(9)).with_fields({}))
    with pytest.raises(InputError, match="fields.npz is not of its 9 points"):
        read_cloud(tmp_path / "b" / name)


def test_a_pcd_keeps_its_viewpoint_and_drops_padding(tmp_path: Path):
    head = (
        "VERSION 0.7\nFIELDS x _ y z _\nSIZE 4 1 4 4 1\nTYPE F U F F U\nCOUNT 1 3 1 1 2\n"
        "WIDTH 2\nHEIGHT 2\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 4\nDATA ascii\n"
    )
    (tmp_path / "a.pcd").write_text(head + "1 0 0 0 2 3 0 0\n" * 4)
    cloud = read_cloud(tmp_path / "a.pcd")
    assert cloud.names == ("x", "y", "z")
    write_cloud(tmp_path / "b.pcd", cloud)
    assert b"VIEWPOINT 1 2 3 1 0 0 0\n" in (tmp_path / "b.pcd").read_bytes()


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("a.ply", {"stamp": np.zeros(50, "u8")}, "field stamp is uint64, which a PLY cannot hold"),
        ("a.pcd", {"word": np.full(50, "a")}, "field word is <U1, which a PCD cannot hold"),
        ("a.ply", {"two words": np.zeros(50)}, "field 'two words' has a name that a PLY cannot"),
    ],
)
def test_what_a_format_cannot_hold_is_one_line(tmp_path: Path, name, fields, message):
    with pytest.raises(InputError, match=message):
        write_cloud(tmp_path / name, Cloud.of(table()).with_fields(fields))
    assert not [*tmp_path.iterdir()]


def test_two_fields_of_one_name_are_refused(tmp_path: Path):
    cloud = Cloud(("x", "y", "z", "t", "t"), tuple(np.zeros((5, 2), "f4")))
    with pytest.raises(InputError, match="two fields of the name t: rename one"):
        write_cloud(tmp_path / "a.pcd", cloud)


TURN = 2 * np.pi


def sweep(clockwise: bool, start: float, seconds: float = 0.1) -> tuple[np.ndarray, ...]:
    """Rows, azimuths and times of 16 beams by 900 rays; beams look 0.5 degrees apart and fire one
    after another.
    """
    row, step = np.divmod(np.arange(16 * 900), 900)
    time = (step + row / 16) / 900 * seconds
    turned = TURN * step / 900 * (-1 if clockwise else 1)
    return row, start + turned + np.radians(0.5) * row, time


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("start", [0.0, np.pi, -2.5])
@pytest.mark.parametrize(
    ("kind", "unit", "zero"),
    [
        ("f4", 1, 0),
        ("f8", 1, 1.7e9),
        ("f4", 1, -0.1),
        (">f8", 1e3, 5),
        ("u4", 1e9, 0),
        ("u8", 1e9, 17 * 10**17 + 1),
        (">u4", 1e6, 3),
    ],
)
def test_times_are_those_of_the_rays(clockwise, start, kind, unit, zero):
    """Half of the rays of each row, and every second row, are hidden: their times are known."""
    row, azimuth, seconds = sweep(clockwise, start)
    kind = np.dtype(kind)
    exact = seconds * unit if kind.kind == "f" else np.rint(seconds * unit).astype("u8")
    time = (zero + exact).astype(kind)
    draws = np.random.default_rng(0)
    hidden = (row % 2 == 1) | (draws.random(len(row)) < 0.5)
    hidden[row == 15] = False  # rays between the outermost
    found = times_of(time[~hidden], row[~hidden], azimuth[~hidden], row[hidden], azimuth[hidden])
    assert found.dtype == kind
    measured = time[~hidden]
    assert (found >= measured.min()).all()
    assert (found <= measured.max()).all()
    got = (found.astype(kind.newbyteorder("=")) - measured.min()).astype(float) / unit
    error = abs(got - (seconds[hidden] - seconds[~hidden].min()))
    assert np.median(error) < 1e-5 + (2e-4 if zero == 1.7e9 else 0)
    assert np.mean(error > 1e-4 + (2e-4 if zero == 1.7e9 else 0)) < 0.02  # where the turn begins


def test_beams_of_an_ouster_look_different_ways():
    """Four beams 7 degrees apart fire together: rows that were hidden are known from the others."""
    row, step = np.divmod(np.arange(16 * 1024), 1024)
    azimuth = np.pi - TURN * step / 1024 - np.radians(7) * (row % 4)
    hidden = (row % 2 == 1) & (row < 15)
    time = step / 10240
    found = times_of(time[~hidden], row[~hidden], azimuth[~hidden], row[hidden], azimuth[hidden])
    assert np.quantile(abs(found - time[hidden]), 0.95) < 1e-5


def test_times_of_real_scans_are_known_to_a_tenth_of_a_millisecond(shared: Path):
    """VLP-16, HDL-64E, three Ousters, and a Pandar64 whose file has the true times: every second
    row, or nine of ten points, are hidden.
    """
    for scan in scans(shared / "real"):
        for hidden, error in errors(scan):
            assert np.median(error) < 0.1 or hidden == "3 of 4 rows", (scan[0], hidden)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t * 0 + 4, "stamp is 4.0 for every point. Give --columns stamp=_"),
        (lambda t: np.random.default_rng(0).permutation(t), "times run backwards or jump"),
        (lambda t: t * np.nan, "has no finite time"),
        (lambda t: t.astype("S8"), "no time a point"),
    ],
)
def test_times_that_are_none_are_one_line(spoil, message: str):
    row, azimuth, time = sweep(True, 0)
    with pytest.raises(InputError, match=message):
        times_of(spoil(time), row, azimuth, row[:1], azimuth[:1], "stamp")
