"""Clouds in memory are completed with all their fields, as the command line completes files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import r2flow
from r2flow.base.errors import InputError
from r2flow.lidar.scan_files import Cloud, read_cloud, write_cloud
from r2flow.lidar.sensors import SENSORS, Sensor

KINDS = [
    ("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "u1"), ("ring", "u2"), ("t", ">u8"),
    ("ambient", "f4"), ("flags", "i2"),
]  # fmt: skip
START = 17 * 10**17
ADDED = ("measured", "image_row", "error_68", "error_95", "p_return")
OWN = [name for name, _ in KINDS]


def room(step: int = 900) -> np.ndarray:
    """A VLP-16 in a round room, firing clockwise from behind; every 50th ray is lost (NaN)."""
    ring, fired = np.divmod(np.arange(16 * step), step)
    e = np.radians(np.asarray(SENSORS["vlp16"].elevations)[::-1][ring])
    turn = 2 * np.pi * fired / step
    rows = np.zeros(len(ring), KINDS)
    a = np.pi - turn
    rows["x"], rows["y"], rows["z"] = 9 * np.cos(a), 9 * np.sin(a), 9 * np.tan(e)
    rows["x"][::50] = np.nan
    rows["intensity"] = 40 + ring
    rows["ring"] = ring
    rows["t"] = START + np.rint(turn / 2 / np.pi * 1e8).astype("u8")
    rows["ambient"] = np.random.default_rng(0).normal(size=len(rows))
    rows["flags"] = -ring.astype(int)
    return rows


@pytest.fixture(scope="module")
def flow():
    return r2flow.load("densify_small").through(SENSORS["vlp16"].resized(32, 256))


@pytest.fixture(scope="module")
def completed(flow) -> np.ndarray:
    return flow.completer("vlp16")(room())


def test_measured_points_come_first_with_every_bit(completed):
    """Rays lost as NaN are no points."""
    rows = room()
    kept = rows[np.isfinite(rows["x"])]
    assert completed.dtype.names == (*OWN, *ADDED)
    for name in OWN:
        assert completed[name][: len(kept)].tobytes() == kept[name].tobytes(), name
    assert np.array_equal(completed["measured"], np.arange(len(completed)) < len(kept))


def test_added_points_have_ring_time_intensity_and_nothing_invented(completed):
    added = completed[completed["measured"] == 0]
    assert len(added) > 2000
    e = np.degrees(np.arctan2(added["z"], np.hypot(added["x"], added["y"])))
    rows = np.asarray(SENSORS["vlp16"].resized(32, 256).elevations)
    assert np.array_equal(added["ring"], abs(e[:, None] - rows).argmin(1))
    assert np.array_equal(added["ring"], added["image_row"])
    turn = (np.pi - np.arctan2(added["y"], added["x"])) % (2 * np.pi)
    error = abs((added["t"] - np.uint64(START)).astype(float) / 1e8 - turn / 2 / np.pi)
    assert np.median(error) < 1e-4  # of a turn: 0.01 ms
    assert np.mean(error > 1e-3) < 0.02
    assert added["t"].min() >= START
    assert added["t"].max() < START + 10**8
    assert np.percentile(added["intensity"], 5) > 25
    assert np.percentile(added["intensity"], 95) < 70
    assert np.isnan(added["ambient"]).all()
    assert not added["flags"].any()


def test_the_rows_of_measured_points_are_those_of_their_beams(completed):
    measured = completed[completed["measured"] == 1]
    # beam b from the top, in the upper part of the view, is row 2 b + 1 of twice as many
    assert np.array_equal(measured["image_row"], 2 * (15 - measured["ring"].astype(int)) + 1)


def test_rows_of_added_points_are_rings_of_the_points_that_were_hidden(flow):
    """An uneven sensor in a round room: every 2nd of its beams is hidden, and filled in again."""
    gaps = 0.6 + np.random.default_rng(0).random(24)
    sensor = Sensor("uneven", tuple((12 - np.cumsum(gaps)).round(3)), columns=256)
    ring, fired = np.divmod(np.arange(24 * 256), 256)
    a = np.pi * (1 - (2 * fired + 1) / 256)
    z = 9 * np.tan(np.radians(sensor.elevations)[ring])
    rows = np.zeros(len(ring), [(name, "f4") for name in "xyz"] + [("ring", "u2")])
    rows["x"], rows["y"], rows["z"], rows["ring"] = 9 * np.cos(a), 9 * np.sin(a), z, ring
    known = replace(sensor, name="known", elevations=sensor.elevations[::2])
    whole = flow.through(sensor).completer(known)(rows[ring % 2 == 0])
    added = whole[whole["measured"] == 0]
    assert len(added) > 0.9 * 11 * 256
    e = np.degrees(np.arctan2(added["z"], np.hypot(added["x"], added["y"])))
    truth = 2 * abs(e[:, None] - sensor.elevations[1::2]).argmin(1) + 1
    assert np.array_equal(added["image_row"], truth)
    assert np.array_equal(added["ring"], truth)


def test_added_points_are_not_taken_for_measured_ones(flow, completed):
    again = flow.completer("vlp16")(completed)
    assert again.tobytes() == completed.tobytes()


def test_rows_and_grids_are_completed_too(flow, completed):
    completer = flow.completer("vlp16")
    grid = completer(room().reshape(16, -1))
    assert grid.tobytes() == completed.tobytes()
    rows = room()
    plain = completer(
        np.stack([rows[name].astype("f4") for name in ("x", "y", "z", "intensity")], 1)
    )
    assert plain.dtype.names == ("x", "y", "z", "reflectance", *ADDED)
    assert np.array_equal(plain["z"], completed["z"])
    assert completer.sensor == flow.sensor
    assert isinstance(completer(Cloud.of(rows)), Cloud)


def test_the_scale_of_reflectance_does_not_depend_on_the_order(flow):
    dark, bright = room(), room()
    bright["intensity"] = np.resize(np.arange(256), len(bright))
    first, second = flow.completer("vlp16"), flow.completer("vlp16")
    one = [first(dark), first(bright)]
    other = [second(bright), second(dark)]
    assert one[0].tobytes() == other[1].tobytes()
    assert one[1].tobytes() == other[0].tobytes()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"t": 7}, {}, r"field t is 7 for every point. Give columns=\['t=_'\]"),
        ({"ring": "mixed"}, {}, "ring numbers contradict the beams.*Give columns="),
        ({"intensity": 200}, {"reflectance_scale": 100}, "often 255: reflectance_scale=255"),
    ],
)
def test_errors_name_arguments_of_python(flow, change, options, message):
    rows = room()
    for name, value in change.items():
        draws = np.random.default_rng(0)
        rows[name] = draws.integers(16, size=len(rows)) if value == "mixed" else value
    with pytest.raises(InputError, match=f"points in memory: .*{message}"):
        flow.completer("vlp16", **options)(rows)


def test_times_and_rings_that_are_all_zero_stay_so(flow):
    """Drivers without them write 0."""
    rows = room()
    rows["t"] = rows["ring"] = 0
    found = flow.completer("vlp16")(rows)
    assert not found["t"].any()
    assert not found["ring"].any()


def test_times_that_are_none_may_be_passed_through(flow):
    rows = room()
    rows["t"] = 7
    found = flow.completer("vlp16", columns=["t=_"])(rows)
    assert set(found["t"][found["measured"] == 0]) == {0}


@pytest.mark.parametrize("ending", [".pcd", ".ply", ".npy", ".csv", ".feather"])
def test_the_command_line_completes_a_file_as_a_completer(
    r2flow, flow, completed, tmp_path: Path, ending: str
):
    """Also a folder, and a completed file again."""
    rows = room()
    if ending == ".ply":
        rows = rows.astype([(name, "f8" if name == "t" else kind) for name, kind in KINDS])
    header = None
    if ending == ".csv":
        (tmp_path / "c.csv").write_text("x,y,z\n1,2,3\n")
        header = read_cloud(tmp_path / "c.csv").header
    if ending == ".feather":
        pytest.importorskip("pyarrow")
        from pyarrow import feather, table

        rows = rows.astype(rows.dtype.newbyteorder("="))
        (tmp_path / "in").mkdir()
        feather.write_feather(table({name: rows[name] for name in OWN}), tmp_path / "in/a.feather")
    else:
        cloud = Cloud.of(rows)
        write_cloud(
            tmp_path / "in" / f"a{ending}", Cloud(cloud.names, cloud.columns, header=header)
        )
    how = "--from", "vlp16", "--to", "vlp16", "--size", "32x256", "-c", "densify_small"
    said = r2flow("complete", tmp_path / "in", *how, "--out", tmp_path / "out", "--pictures", 0)
    assert "NaN or 0 for added points: ambient, flags" in said.said
    found = read_cloud(tmp_path / "out" / f"a{ending}")
    assert found.names == completed.dtype.names
    precise = ending not in (".csv", ".ply")
    for name, column in zip(found.names, found.columns, strict=True):
        if name == "t" and not precise:  # digits
            continue
        assert np.array_equal(
            column.astype(completed[name].dtype), completed[name], equal_nan=True
        ), name
    again = r2flow("complete", tmp_path / "out", *how, "--out", tmp_path / "b", "--pictures", 0)
    assert "points that a completion added are left out" in again.stderr
    assert (tmp_path / "b" / f"a{ending}").read_bytes() == (
        tmp_path / "out" / f"a{ending}"
    ).read_bytes()
