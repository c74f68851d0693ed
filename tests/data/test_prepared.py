"""Prepared scans: their codes, their making and their reading."""

import errno
import os
import pickle
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from r2flow.base.errors import InputError
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.described import Described, describe
from r2flow.data.files import ScanFiles
from r2flow.data.kinds import SOURCES
from r2flow.data.layouts import Drive
from r2flow.data.options import SourceOptions
from r2flow.data.prepared import PreparedStore, refuse_other_images
from r2flow.data.preparing import plan, prepare
from r2flow.data.quantise import find_levels, range_codes, reflectance_codes
from r2flow.data.reading import Reading, read_image
from r2flow.lidar.labels import COMMON
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.store import MANIFEST, manifest_of
from tests.conftest import ROOT, files, find_drives, refused
from tests.killing import MOMENTS, die_at, in_child
from tests.training.conftest import TINY, in_process

SMALL = SENSORS["hdl64e"].resized(4, 16)
MILLIMETRE = 1e-3


def write_cloud(path: Path, seed: int, levels: int | None = 256) -> None:
    """200 returns all around, at 1 to 90 m, reflectance in n / levels; none where `levels` is None."""
    draw = np.random.default_rng(seed)
    azimuth, elevation = draw.uniform(-np.pi, np.pi, 200), np.deg2rad(draw.uniform(-27, 5, 200))
    ray = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        1,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    reflectance = (
        None if levels is None else (draw.integers(0, levels, 200) / levels).astype(np.float32)
    )
    write_points(path, ray * draw.uniform(1, 90, (200, 1)), reflectance)


@pytest.fixture(scope="module")
def clouds(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("clouds")
    for number in range(10):
        write_cloud(root / f"drive{number // 6}" / f"{number:06d}.bin", number)
    return root


def plan_of(
    root: Path, sensor: Sensor = SMALL, layout: str = "folder", shard_scans: int = 3, **how
) -> PreparedStore:
    return plan("unused", describe(f"{layout}:{root}"), Reading(sensor, **how), shard_scans)


def make(folder: Path, planned: PreparedStore, **options) -> Path:
    prepare(PreparedStore(folder, planned.described, planned.drives, planned.source), **options)
    return folder


def prepared_in(
    folder: Path, sensor: Sensor = SMALL, split=None, drives=None, reflectance=True, **how
):
    scans = Described(str(folder), SourceOptions("prepared", str(folder), split, drives))
    return scans.kind.open(scans, Reading(sensor, reflectance=reflectance, **how))


def raw_of(root: Path, sensor: Sensor = SMALL, layout: str = "folder", **options) -> ScanFiles:
    paths = [path for drive in find_drives(layout, root) for path in drive.scans]
    return ScanFiles(paths, Reading(sensor, reflectance=True, **options), root)


@pytest.mark.parametrize("far", [None, 120.0, 245.0, 500.0])
def test_ranges_are_within_a_millimetre_below_65_m(sensor: Sensor, far: float | None):
    near, far = sensor.min_range, far or sensor.max_range
    codes = range_codes(near, far)
    r = np.concatenate(
        [np.random.default_rng(0).uniform(near, far, 50_000), [near, 65.0, far]]
    ).astype(np.float32)
    r = r.clip(np.float32(near), np.float32(far))
    decoded = codes.values[codes.encode(r)]
    error = np.abs(decoded.astype(np.float64) - r)
    assert error[r < 65].max() <= MILLIMETRE
    # Beyond, at worst half of what is left of the codes: (500 - 65) m over some 31,000 of them.
    assert error.max() <= max(MILLIMETRE, (far - 65) / 31_000 / 2 * 1.01)
    assert decoded.min() >= np.float32(near)
    assert decoded.max() <= np.float32(far)


@pytest.mark.parametrize("levels", [256, 100, 255])
def test_reflectance_in_levels_is_kept_to_the_bit_and_the_levels_are_found(levels: int):
    reflectance = np.array(
        [step / levels for step in np.arange(min(levels + 1, 256))], dtype=np.float32
    )
    assert find_levels(reflectance) == levels
    codes = reflectance_codes(levels)
    assert np.array_equal(codes.values[codes.encode(reflectance)], reflectance)


def test_reflectance_without_levels_is_off_by_half_a_step_at_most():
    reflectance = np.random.default_rng(0).random(10_000, dtype=np.float32)
    assert find_levels(reflectance) == 255
    codes = reflectance_codes(255)
    assert np.abs(codes.values[codes.encode(reflectance)] - reflectance).max() <= 0.5 / 255 + 1e-7


def test_levels_are_found_although_somebody_multiplied_by_a_hundredth():
    reflectance = np.arange(101, dtype=np.float32) * np.float32(0.01)
    assert (reflectance != np.arange(101, dtype=np.float32) / 100).any()
    assert find_levels(reflectance) == 100


@pytest.mark.parametrize("levels", [256, 100, 255])
def test_the_scale_of_files_of_points_is_not_that_of_range_images(tmp_path: Path, levels: int):
    draw = np.random.default_rng(0)
    image = np.stack(
        [draw.uniform(2, 70, (4, 16)), draw.integers(0, levels, (4, 16)) / levels]
    ).astype(np.float32)
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "1.npy", image)
    assert plan_of(tmp_path / "scans", reflectance_scale=255.0).described["levels"] == levels


def test_prepared_scans_are_the_raw_ones_to_the_stated_quantisation(clouds: Path, tmp_path: Path):
    raw, prepared = raw_of(clouds), prepared_in(make(tmp_path, plan_of(clouds)), SMALL)
    assert prepared.names == raw.names == [f"drive{i // 6}/{i:06d}.bin" for i in range(10)]
    for index in range(10):
        image, other = raw[index], prepared[index]
        assert (other.shape, other.dtype) == ((2, 4, 16), np.float32)
        assert np.array_equal(image[0] == 0, other[0] == 0)
        assert np.abs(image[0] - other[0]).max() <= MILLIMETRE
        assert np.array_equal(image[1], other[1])
    part = prepared.subset([9, 0]).subset([0])
    assert part.names == ["drive1/000009.bin"]
    assert np.array_equal(part[0], prepared[9])
    assert np.array_equal(pickle.loads(pickle.dumps(part))[0], prepared[9])
    assert np.array_equal(prepared_in(tmp_path, SMALL, reflectance=False)[9], prepared[9][:1])


@pytest.mark.parametrize(
    ("layout", "folder", "most"),
    [("kitti_360", "kitti360", 2), ("kitti_raw", "raw", 2), ("object", "object", 1)],
)
def test_real_scans_keep_their_reflectance_to_the_bit(shared, tmp_path, layout, folder, most):
    sensor = SENSORS["hdl64e"]
    planned = plan_of(shared / "real" / folder, sensor, layout)
    few = PreparedStore(
        tmp_path,
        {**planned.described, "scans": most},
        [Drive("few", planned.drives[0].scans[:most])],
        planned.source,
    )
    prepared = prepared_in(make(tmp_path, few), sensor)
    assert few.described["levels"] == (256 if layout == "kitti_360" else 100)
    raw = raw_of(shared / "real" / folder, layout=layout, sensor=sensor)
    for index in range(most):
        image, other = raw[index], prepared[index]
        assert image[0].astype(bool).mean() > 0.5
        assert np.array_equal(image[1], other[1])
        assert np.abs(image[0] - other[0]).max() <= MILLIMETRE


def test_a_shard_is_three_bytes_a_pixel_and_readable_by_anybody(clouds: Path, tmp_path: Path):
    make(tmp_path, plan_of(clouds))
    assert list(files(tmp_path)) == [MANIFEST, *(f"scans-{i:06d}.safetensors" for i in range(4))]
    tensors = load_file(tmp_path / "scans-000003.safetensors")  # ten scans by threes: one is left
    found = {name: (tensor.dtype.name, tensor.shape) for name, tensor in tensors.items()}
    assert found == {"range": ("uint16", (1, 4, 16)), "reflectance": ("uint8", (1, 4, 16))}


def test_nothing_tells_where_the_files_lie_or_how_many_processes_read_them(
    clouds: Path, tmp_path: Path
):
    moved = tmp_path / "elsewhere"
    shutil.copytree(clouds, moved)
    one, other = (
        make(tmp_path / "one", plan_of(clouds)),
        make(tmp_path / "other", plan_of(moved), workers=2),
    )
    assert files(one) == files(other)
    for content in files(one).values():
        assert str(clouds).encode() not in content


def test_scans_without_reflectance_give_shards_without_it(tmp_path: Path):
    for number in range(2):
        write_cloud(tmp_path / "scans" / f"{number}.ply", number, levels=None)
    make(tmp_path / "out", plan_of(tmp_path / "scans"))
    size = 2 * 4 * 16 * 2
    assert size < (tmp_path / "out" / "scans-000000.safetensors").stat().st_size < size + 600
    assert prepared_in(tmp_path / "out", SMALL, reflectance=False)[1].shape == (1, 4, 16)
    with pytest.raises(
        InputError, match=r"holds scans without reflectance. Set encoding.reflectance=false"
    ):
        prepared_in(tmp_path / "out", SMALL)


@pytest.mark.parametrize(
    ("changes", "options", "said"),
    [
        ({"max_range": 100.0}, {}, "max_range=80.0 there, 100.0 here"),
        ({"columns": 32}, {}, "columns=16 there, 32 here"),
        ({"elevations": (3.0, 1.0, -9.0, -20.0)}, {}, "there, [3.0, 1.0, -9.0, -20.0] here"),
        ({}, {"projection": "unfolding"}, "projection=spherical there, unfolding here"),
        ({}, {"convention": "reference"}, "convention=centre there, reference here"),
    ],
)
def test_scans_prepared_for_other_images_are_refused(
    clouds, tmp_path, changes: dict, options: dict, said: str
):
    make(tmp_path, plan_of(clouds))
    with refused(said):
        prepared_in(tmp_path, replace(SMALL, **changes), **options)
    with pytest.raises(InputError, match="holds other scans: "):
        make(tmp_path, plan_of(clouds, replace(SMALL, **changes), **options))
    # no pixel depends on these
    prepared_in(tmp_path, replace(SMALL, name="mine", height=2.0, firing=(1, 0, 2, 3)))
    planned = plan_of(clouds, projection="unfolding")
    with refused("firing=None there"):
        refuse_other_images(
            planned, replace(planned.reading, sensor=replace(SMALL, firing=(1, 0, 2, 3)))
        )


def test_other_files_of_the_same_names_are_refused_and_a_mended_one_is_taken(
    clouds: Path, tmp_path: Path
):
    root, out = Path(shutil.copytree(clouds, tmp_path / "scans")), tmp_path / "out"
    bad, whole = root / "drive0" / "000004.bin", files(make(tmp_path / "whole", plan_of(clouds)))
    bad.write_bytes(b"")
    with pytest.raises(InputError, match="holds no points"):
        make(out, plan_of(root))
    shutil.copy(clouds / "drive0" / "000004.bin", bad)
    assert files(make(out, plan_of(root))) == whole
    write_cloud(bad, 99)  # of equal size
    for _ in range(2):
        with pytest.raises(InputError, match="scans-000001.safetensors holds scans of other files"):
            make(out, plan_of(root))
        (out / "scans-000002.safetensors").unlink(missing_ok=True)  # then as if killed
    (out / "scans-000001.safetensors").unlink()
    mended = files(make(out, plan_of(root)))
    assert [name for name in mended if mended[name] != whole[name]] == ["scans-000001.safetensors"]


def test_what_is_finished_is_only_read(clouds: Path, tmp_path: Path, monkeypatch):
    make(tmp_path, plan_of(clouds))
    refused = Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    for name in ("mkdir", "unlink", "rmdir"):
        monkeypatch.setattr(Path, name, refused)
    monkeypatch.setattr("os.replace", refused)
    make(tmp_path, plan_of(clouds))
    assert len(prepared_in(tmp_path)) == 10


def test_bad_scans_stop_the_preparation_or_are_left_out_by_name(
    clouds: Path, tmp_path: Path, caplog
):
    root = tmp_path / "scans"
    shutil.copytree(clouds, root)
    for name in (
        "drive0/000001.bin",
        "drive0/000003.bin",
        "drive0/000004.bin",
        "drive0/000005.bin",
    ):
        (root / name).write_bytes(b"")
    planned = plan_of(root)
    with pytest.raises(InputError, match=r"000001.bin: it holds no points"):
        make(tmp_path / "out", planned)
    with pytest.raises(
        InputError, match="is not finished: the same r2flow prepare command resumes"
    ):
        prepared_in(tmp_path / "out", SMALL)
    make(tmp_path / "out", planned, on_bad_scan="skip")
    assert caplog.text.count("left out:") == 4
    shards = PreparedStore(tmp_path / "out", planned.described, planned.drives, planned.source)
    assert (*prepare(shards), [shards.head(i)["left_out"] for i in shards.shards]) == (
        4,
        [],
        [[1], [3, 4, 5], [], []],
    )
    prepared, raw = prepared_in(tmp_path / "out", SMALL), raw_of(clouds)
    assert prepared.names == [raw.names[i] for i in (0, 2, 6, 7, 8, 9)]  # the second shard is empty
    for index, number in enumerate((0, 2, 6, 7, 8, 9)):
        assert np.array_equal(prepared[index][1], raw[number][1])
    assert prepared_in(tmp_path / "out", SMALL, drives=["drive1"]).names == raw.names[6:]
    for path in root.rglob("*.bin"):
        path.write_bytes(b"no scan")
    with pytest.raises(InputError, match="all 10 scans were left out as unusable"):
        make(tmp_path / "none", plan_of(root), on_bad_scan="skip")
    assert [path.name for path in (tmp_path / "none").iterdir()] == ["manifest.json"]


def test_a_scan_that_has_no_reflectance_among_others_is_a_bad_one(tmp_path: Path):
    for number in range(40):
        write_cloud(
            tmp_path / "scans" / f"{number:02d}.ply", number, levels=None if number == 1 else 100
        )
    # nothing is made, so that the folder takes another recipe
    for convention in ("centre", "reference"):
        with pytest.raises(InputError, match=r"01.ply has no reflectance"):
            make(tmp_path / "out", plan_of(tmp_path / "scans", convention=convention))


# At any number of attempts, by any number of processes; test_pairs.py has stores that several
# commands share


def test_killed_again_and_again_the_same_command_ends_alike(clouds: Path, tmp_path: Path):
    planned = plan_of(clouds, shard_scans=1)
    one = files(make(tmp_path / "one", planned))
    folder, kept = tmp_path / "killed", []
    for dies in MOMENTS:
        child = in_child(lambda: (die_at(*dies), make(folder, planned)))  # noqa: B023
        assert os.waitpid(child, 0)[1] == signal.SIGKILL
        kept.append(len(list(folder.glob("scans-*"))))
    assert kept == sorted(kept)  # what was whole stays
    assert files(make(folder, planned)) == one


def swapped(path: Path) -> None:
    other = path.with_name("scans-000002.safetensors")
    data = other.read_bytes()
    other.write_bytes(path.read_bytes())
    path.write_bytes(data)


DAMAGES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-100]),
    "swapped": swapped,
    "renamed": lambda path: path.write_bytes(path.read_bytes().replace(b"left_out", b"left_0ut")),
    "missing": Path.unlink,
    "dangling": lambda path: (path.unlink(), path.symlink_to(path.with_name("nowhere"))),
    "folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_shard_is_refused_by_name_and_made_again(clouds: Path, tmp_path: Path, damage):
    planned = plan_of(clouds)
    opened, whole = prepared_in(make(tmp_path, planned)), files(tmp_path)
    path = tmp_path / "scans-000001.safetensors"
    DAMAGES[damage](path)
    if damage not in ("swapped", "renamed"):
        with refused(path):
            opened[len(opened) // 2]
    said = (
        "scans-000001.safetensors is da"
        if damage in ("cut", "swapped", "renamed")
        else "is not finished"
    )
    with pytest.raises(InputError, match=said):
        prepared_in(tmp_path)
    if damage == "folder":
        path.rmdir()
    _, made = prepare(PreparedStore(tmp_path, planned.described, planned.drives, planned.source))
    assert made == ([1, 2] if damage == "swapped" else [1])  # these alone
    assert files(tmp_path) == whole


def test_a_manifest_that_is_damaged_or_missing_is_named(clouds: Path, tmp_path: Path):
    make(tmp_path, plan_of(clouds))
    path = tmp_path / MANIFEST
    for content in (b"", b"{}", b"[]", b"null", b"\xff", path.read_bytes()[:-10], b"[" * 100_000):
        path.write_bytes(content)
        with pytest.raises(InputError, match=MANIFEST):
            prepared_in(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match="holds no prepared scans"):
        prepared_in(tmp_path)


def test_a_data_set_is_prepared(r2flow, kitti_360, tmp_path, monkeypatch):
    # no pause
    monkeypatch.setattr(
        "r2flow.base.progress.Bar.__init__.__defaults__", ("scans", None, False, 0, 0.0)
    )
    out = tmp_path / "out"
    typed = (
        "prepare",
        f"kitti_360:{kitti_360}",
        "--out",
        out,
        "--split",
        "test",
        "--size",
        "4x16",
        "--shard-scans",
        2,
    )
    assert (
        f"{out}: 6 scans in 3 shards, 0.0 MiB, reflectance as n/256"
        in r2flow(*typed, "--workers", 1).said
    )
    for shard in (1, 2):
        (out / f"scans-{shard:06d}.safetensors").unlink()
    done = r2flow(*typed, "--workers", 1)
    assert "6 scans in 3 shards, 0.0 MiB, reflectance as n/256, 1 there already" in done.said
    assert "preparing 2/2 shards" in done.stderr
    source = prepared_in(out)
    assert (
        np.abs(
            source[5] - read_image(kitti_360 / source.names[5], Reading(SMALL, reflectance=True))
        ).max()
        <= 1e-3
    )


def test_nuscenes_has_its_own_sensor_and_scale(r2flow, tmp_path):
    config = yaml.safe_load((ROOT / "conf" / "data" / "nuscenes.yaml").read_text())
    # the first and the last out of an HDL-64E's view
    r, e = np.full(3, 10.0), np.deg2rad([10.0, 0.0, -30.0])
    points = np.stack([r * np.cos(e), np.zeros(3), r * np.sin(e), [0, 100, 255], [31, 23, 0]], 1)
    path = tmp_path / "scans" / "n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin"
    path.parent.mkdir()
    path.write_bytes(points.astype("<f4").tobytes())
    code, _, error = r2flow(
        "prepare", f"nuscenes:{path.parent}", "--out", tmp_path / "out", "--workers", 1
    )
    assert (code, error.split("error")[1:]) == (0, [])
    recipe = manifest_of(tmp_path / "out")["recipe"]["reading"]
    assert {"override /sensor@_global_.sensor": recipe["sensor"]["name"]} in config["defaults"]
    assert recipe["reflectance_scale"] == SOURCES["nuscenes"].reflectance_scale
    image = prepared_in(tmp_path / "out", SENSORS["hdl32e"])[0]
    assert np.count_nonzero(image[0]) == 3
    assert np.array_equal(np.unique(image[1]), np.array([0, 100 / 255, 1], np.float32))


@pytest.fixture
def wide(numbered: Path, tmp_path: Path) -> Path:
    """The numbered scans as rows of time, z, y, x, reflectance and ring."""
    folder = tmp_path / "wide"
    folder.mkdir()
    for path in numbered.iterdir():
        x, y, z, reflectance = np.fromfile(path, np.float32).reshape(-1, 4).T
        np.save(
            folder / f"{path.stem}.npy", np.column_stack([x * 0 + 7, z, y, x, reflectance, x * 0])
        )
    return folder


def test_columns_are_named_where_files_do_not(r2flow, numbered, wide, tmp_path):
    columns, small = ("--columns", "time,z,y,x,intensity,_"), ("--size", "4x16", "--workers", 1)
    for out, given in (("one", (numbered,)), ("two", (wide, *columns))):
        assert r2flow("prepare", *given, *small, "--out", tmp_path / out).quiet
    for one, two in zip(prepared_in(tmp_path / "one"), prepared_in(tmp_path / "two"), strict=False):
        assert np.array_equal(one, two)
    other = "prepare", wide, "--columns", "z,_,y,x,intensity,_", *small, "--out", tmp_path / "two"
    assert "reading.columns=" in r2flow(*other).refusal
    scan = wide / "000000.npy"
    assert (
        r2flow(
            "show", scan, *columns, "--size", "4x16", "--format", "npy", "-o", tmp_path / "image"
        )[0]
        == 0
    )
    expected = read_image(numbered / "000000.bin", Reading(SMALL, reflectance=True))
    np.testing.assert_array_equal(np.load(tmp_path / "image" / "000000.npy"), expected)
    assert r2flow("evaluate", wide, scan, "--size", "4x16", "--metrics", "jsd", *columns)[0] == 0


def test_a_run_is_told_the_columns_too(wide, tmp_path):
    given = [*TINY, f"data.root={wide}", "trainer.max_steps=1", "trainer.fast_dev_run=true"]
    in_process(tmp_path, [*given, "data.reading.columns=[_,z,y,x,intensity,_]"])
    assert "6 columns, no" in in_process(tmp_path, given, check=False).refusal


def test_labels_are_kept_where_scans_have_them(r2flow, clouds: Path, tmp_path: Path):
    root = Path(shutil.copytree(clouds, tmp_path / "scans"))
    scans = sorted(root.rglob("*.bin"))
    for number, scan in enumerate(scans):
        ids = np.random.default_rng(number).choice([0, 40, 48, 10, 252, 99], 200)
        scan.with_suffix(".label").write_bytes(ids.astype("<u4").tobytes())
    out = tmp_path / "out"
    typed = "prepare", root, "--out", out, "--size", "4x16", "--shard-scans", 4, "--workers", 1
    assert "reflectance as n/256, labels" in r2flow(*typed).said
    prepared = prepared_in(out, labels=True)
    plain = prepared_in(make(tmp_path / "plain", plan_of(clouds)))
    for number, scan in enumerate(scans):
        labelled = read_image(scan, Reading(SMALL, reflectance=True, labels=True))
        assert set(np.unique(labelled[2])) == {0, 1, 2, 6, 8}
        assert np.array_equal(prepared[number][2], labelled[2])
        assert np.array_equal(prepared[number][:2], plain[number])
        assert np.array_equal(prepared_in(out)[number], plain[number])
    encoding = {"reflectance": True, "labels": True}
    data = ScanDataModule("prepared", root=str(out), sensor=SMALL, encoding=encoding, batch_size=4)
    data.setup()
    assert next(iter(data.train_dataloader()))["x_1"].shape == (4, 2 + len(COMMON), 4, 16)
    other = ScanDataModule("prepared", root=f"{tmp_path}/plain", sensor=SMALL, encoding=encoding)
    with refused("plain holds scans without labels. Prepare points that have files of labels"):
        other.setup()
    # Changed labels are refused as changed scans are.
    scans[0].with_suffix(".label").write_bytes(bytes(800))
    assert "scans-000000.safetensors holds scans of other files" in r2flow(*typed).refusal
    for scan in scans:
        assert "label" in plan_of(root).codes
        scan.with_suffix(".label").unlink()
    assert "label" not in plan_of(root).codes
