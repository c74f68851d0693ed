import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from r2flow.base.errors import InputError
from r2flow.data.described import describe
from r2flow.data.kinds import SOURCES, Layout
from r2flow.store import Store
from tests.conftest import find_drives, write_scan


def names(drives) -> list[str]:
    return [drive.name.split("_")[-2] if "drive" in drive.name else drive.name for drive in drives]


def test_the_standard_split_of_kitti_360(kitti_360: Path):
    assert names(find_drives("kitti_360", kitti_360, "train")) == ["0003", "0004", "0010"]
    assert names(find_drives("kitti_360", kitti_360, "test")) == ["0000", "0002"]
    assert names(find_drives("kitti_360", kitti_360)) == ["0000", "0002", "0003", "0004", "0010"]
    assert names(find_drives("kitti_360", kitti_360 / "data_3d_raw", "test")) == ["0000", "0002"]


def test_drives_are_taken_by_number_and_by_name(kitti_360: Path):
    assert names(find_drives("kitti_360", kitti_360, drives=[10, 2])) == ["0010", "0002"]
    assert names(find_drives("kitti_360", kitti_360, drives=["2013_05_28_drive_0003_sync"])) == [
        "0003"
    ]
    with pytest.raises(InputError, match=r"no drives named '7'; known: 2013_05_28_drive_0000_sync"):
        find_drives("kitti_360", kitti_360, drives=[7])


def test_kitti_raw_and_odometry(tmp_path: Path):
    for day, drive in ((26, "0005"), (28, "0001"), (28, "0005")):
        name = f"2011_09_{day}/2011_09_{day}_drive_{drive}_sync"
        write_scan(tmp_path / "raw" / name / "velodyne_points/data/0000000000.bin", 0)
    assert names(find_drives("kitti_raw", tmp_path / "raw")) == ["0005", "0001", "0005"]
    with pytest.raises(InputError, match="2 drives named '5'; known: 2011_09_26_drive_0005_sync, "):
        find_drives("kitti_raw", tmp_path / "raw", drives=[5])
    assert names(find_drives("kitti_raw", tmp_path / "raw/2011_09_26")) == ["0005"]
    for sequence in ("00", "08", "11"):
        write_scan(tmp_path / f"odo/dataset/sequences/{sequence}/velodyne/000000.bin", 0)
    assert names(find_drives("odometry", tmp_path / "odo", "train")) == ["00"]
    assert names(find_drives("odometry", tmp_path / "odo/dataset", "validation")) == ["08"]


def test_kitti_object(tmp_path: Path):
    for place in (
        "training/velodyne/000000",
        "training/velodyne/000001",
        "testing/velodyne/000000",
    ):
        write_scan(tmp_path / f"{place}.bin", 0)
    assert names(find_drives("object", tmp_path)) == ["training", "testing"]
    assert [len(drive.scans) for drive in find_drives("object", tmp_path, "train")] == [2]
    assert names(find_drives("object", tmp_path, "test")) == ["testing"]


def test_nuscenes_is_read_log_by_log_in_the_order_of_time(tmp_path: Path, caplog):
    log, other = "n015-2018-07-24-11-22-45+0800", "n008-2018-08-01-15-16-36-0400"
    files = [f"samples/LIDAR_TOP/{log}__LIDAR_TOP__1532402927647951.pcd.bin",
             f"sweeps/LIDAR_TOP/{log}__LIDAR_TOP__1532402927597000.pcd.bin",
             f"sweeps/LIDAR_TOP/{log}__LIDAR_TOP__1532402927697000.pcd.bin",
             f"sweeps/LIDAR_TOP/{other}__LIDAR_TOP__1533151603547590.pcd.bin"]  # fmt: skip
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    drives = find_drives("nuscenes", tmp_path)
    assert [drive.name for drive in drives] == [other, log]
    assert drives[1].scans == tuple(str(tmp_path / files[i]) for i in (1, 0, 2))
    assert [drive.name for drive in find_drives("nuscenes", tmp_path / "samples/LIDAR_TOP")] == [
        log
    ]
    assert find_drives("nuscenes", tmp_path, drives=[log]) == drives[1:]
    assert not caplog.messages
    assert find_drives("folder", tmp_path)
    assert "nuscenes:FOLDER, reads its lidar alone" in caplog.text


@pytest.mark.parametrize(
    "layout", [name for name, kind in SOURCES.items() if isinstance(kind, Layout)]
)
def test_a_missing_or_empty_root_says_what_was_looked_for(layout: str, tmp_path: Path):
    with pytest.raises(InputError, match="is not a folder"):
        find_drives(layout, tmp_path / "missing")
    with pytest.raises(InputError, match=rf"holds no scan\. Looked for \({layout}\)"):
        find_drives(layout, tmp_path)


def test_a_folder_that_may_not_be_entered_is_left_out_with_its_name(
    tmp_path: Path, monkeypatch, caplog
):
    Store(tmp_path / "day", "samples", {}).begin()
    # of a disk, for root alone; of what was deleted there
    for place in ("day", "lost+found", ".Trash-0"):
        write_scan(tmp_path / place / "0.bin", 1)
    scandir, closed = (
        os.scandir,
        Mock(side_effect=PermissionError(13, "Permission denied", tmp_path / "lost+found")),
    )
    monkeypatch.setattr(os, "access", lambda path, mode: "lost" not in str(path))
    monkeypatch.setattr(
        os, "scandir", lambda path: (closed if "lost" in str(path) else scandir)(path)
    )
    assert describe(tmp_path).manifests
    assert names(find_drives("folder", tmp_path)) == ["day"]
    assert "lost+found: left out, not readable" in caplog.text


def test_a_split_that_holds_nothing_says_what_there_is_and_how_to_take_it(tmp_path: Path):
    for drive in ("08", "11", "12"):
        write_scan(tmp_path / "sequences" / drive / "velodyne" / "000000.bin", 1)
    with pytest.raises(
        InputError,
        match=r"holds 08 \(validation\), 11 \(test\), 12 \(test\): give another data.split",
    ):
        find_drives("odometry", tmp_path, "train")


def test_a_folder_of_recordings_says_which_tool_unpacks_them(tmp_path: Path):
    (tmp_path / "day").mkdir()
    (tmp_path / "day" / "drive.mcap").write_bytes(b"recorded")
    with pytest.raises(
        InputError, match=r"holds no scan\. .*day/drive\.mcap holds many scans: r2flow unpack"
    ):
        find_drives("folder", tmp_path)


def test_notes_beside_scans_are_no_scans(tmp_path: Path):
    notes = [tmp_path / name for name in ("notes.txt", "poses.csv")]
    for note in notes:
        note.write_text("x,y,z\n1,2,3\n")
    assert find_drives("folder", tmp_path)[0].scans == tuple(map(str, notes))
    write_scan(tmp_path / "scans" / "0.bin", 1)
    assert [d.scans for d in find_drives("folder", tmp_path) if d.scans] == [
        (str(tmp_path / "scans" / "0.bin"),)
    ]
    write_scan(tmp_path / "0.bin", 1)
    assert find_drives("folder", tmp_path)[0].scans == (str(tmp_path / "0.bin"),)


def test_linked_folders_are_looked_into_and_circles_end(tmp_path: Path):
    write_scan(tmp_path / "elsewhere" / "deep" / "b.bin", 0)
    write_scan(tmp_path / "scans" / "here" / "a.bin", 0)
    (tmp_path / "scans" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "circle").symlink_to(tmp_path / "scans")
    assert [(drive.name, len(drive.scans)) for drive in find_drives("folder", tmp_path / "scans")] == [
        ("here", 1), ("linked/deep", 1),
    ]  # fmt: skip


def test_scans_are_in_the_order_of_their_numbers_in_whichever_format(tmp_path: Path):
    for name in ("10", "9", "100", "1", "scan_2", "scan_10"):
        write_scan(tmp_path / f"{name}.bin", 1)
    # a scan in several formats; what a Mac leaves next to a file
    for name in ("9.ply", "9.NPY", "9.xyz", "._9.bin"):
        (tmp_path / name).touch()
    (drive,) = find_drives("folder", tmp_path)
    assert [Path(scan).stem for scan in drive.scans] == ["1", "9", "10", "100", "scan_2", "scan_10"]
    assert Path(drive.scans[1]).name == "9.NPY"
