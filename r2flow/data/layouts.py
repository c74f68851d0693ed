"""Folder layouts of data sets: each function finds the drives and scans of a data set, in order."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from r2flow.base.errors import InputError, warn_odd
from r2flow.lidar.scan_files import (
    FIRM_ENDINGS,
    LOOSE_ENDINGS,
    TABLE_ENDINGS,
    conversion_of,
    scan_ending,
)
from r2flow.store import MANIFEST, manifest_of

_Names = tuple[str, ...]  # paths of files, or endings of their names

KITTI_360_SPLIT = {"train": (3, 4, 5, 6, 7, 9, 10), "test": (0, 2)}
ODOMETRY_SPLIT = {
    "train": (0, 1, 2, 3, 4, 5, 6, 7, 9, 10),
    "validation": (8,),
    "test": tuple(range(11, 22)),
}
OBJECT_SPLIT = {"train": ("training",), "test": ("testing",)}
# OpenPCDet's split of PandaSet.
_PANDASET_HELD = {
    "validation": (
        3, 11, 20, 21, 27, 42, 43, 45, 51, 55, 56, 57, 59, 73, 78, 80, 94, 97, 101, 109,
    ),
    "test": (
        1, 4, 8, 13, 17, 29, 32, 53, 54, 62, 65, 68, 70, 72, 74, 86, 90, 103, 110, 112,
        115, 149,
    ),
}  # fmt: skip
PANDASET_SPLIT = {
    "train": tuple(set(range(159)).difference(*_PANDASET_HELD.values())),
    **_PANDASET_HELD,
}


@dataclass(frozen=True)
class Drive:
    """One recording: consecutive scans."""

    name: str  # its name in `data.drives`
    # paths as strings: 100,000 Path objects take seconds and ten times the memory
    scans: _Names


def kitti_360(root: Path) -> list[Drive]:
    """`data_3d_raw/2013_05_28_drive_XXXX_sync/velodyne_points/data/*.bin`."""
    base = root / "data_3d_raw" if (root / "data_3d_raw").is_dir() else root
    return _drives(base.glob("2013_05_28_drive_*_sync/velodyne_points/data"), 1)


def kitti_raw(root: Path) -> list[Drive]:
    """`DATE/DATE_drive_XXXX_sync/velodyne_points/data/*.bin`."""
    below = "*_drive_*_sync/velodyne_points/data"
    return _drives([*root.glob(f"*/{below}"), *root.glob(below)], 1)


def odometry(root: Path) -> list[Drive]:
    """`sequences/XX/velodyne/*.bin`, also below `dataset/`: KITTI odometry and SemanticKITTI."""
    base = root / "dataset" if (root / "dataset" / "sequences").is_dir() else root
    folders = base.glob("sequences/*/velodyne")
    return _drives((folder for folder in folders if folder.parent.name.isdecimal()), 0)


def kitti_object(root: Path) -> list[Drive]:
    """`training/velodyne/*.bin` and `testing/velodyne/*.bin`: KITTI object, each scan another
    place.
    """
    return _drives(root.glob("training/velodyne"), 0) + _drives(root.glob("testing/velodyne"), 0)


def _drives(folders: Iterable[Path], up: int) -> list[Drive]:
    """Drives of .bin in folders, named by a folder above them."""
    return [Drive(folder.parents[up].name, _files(folder, (".bin",))) for folder in sorted(folders)]


def nuscenes(root: Path) -> list[Drive]:
    """`samples/LIDAR_TOP/*.pcd.bin` and `sweeps/LIDAR_TOP/*.pcd.bin`, or such files in the folder
    itself.

    A drive is a log, named at the start of each file name: n015-2018-07-24-11-22-45+0800. Samples,
    the annotated scans, and sweeps are merged in the order of recording.
    """
    logs: dict[str, list[str]] = {}
    folders = (root / "samples" / "LIDAR_TOP", root / "sweeps" / "LIDAR_TOP", root)
    paths = [path for folder in folders for path in _files(folder, (".pcd.bin",))]
    for path in sorted(paths, key=os.path.basename):
        logs.setdefault(os.path.basename(path).partition("__")[0], []).append(path)
    return [Drive(log, tuple(scans)) for log, scans in sorted(logs.items())]


def pandaset(root: Path) -> list[Drive]:
    """`NNN/lidar/FF.pkl.gz` with poses.json and timestamps.json beside them, or one drive."""
    folders = [root, root / "lidar", *sorted(root.glob("*/lidar"))]
    return [
        Drive(place.parent.name, _files(folder, TABLE_ENDINGS))
        for folder in folders
        if (place := folder.resolve()).name == "lidar"
    ]


def folder(root: Path) -> list[Drive]:
    """Any folder of .bin, .pcd, .ply, .npy, .xyz, .las, .feather, .parquet, else .csv, .txt, .pth.

    Each folder below it with such files is a drive. If a scan exists in several formats, one file
    is taken: its range image, else the last by its ending. Folders that r2flow wrote below a folder
    of other scans are left out: answers would be taken for measurements.
    """
    if (root / "samples" / "LIDAR_TOP").is_dir():
        warn_odd(
            root / "samples",
            "of nuScenes? data=nuscenes, in a verb nuscenes:FOLDER, reads its lidar alone",
        )
    files = dict(sorted(_walk(root)))
    marked = {place for place in files if MANIFEST in files[place] and place != root}
    for endings in (FIRM_ENDINGS, LOOSE_ENDINGS):
        found = {place: _one_of_each(_scans(place, files[place], endings)) for place in files}
        found = {place: scans for place, scans in found.items() if scans}
        others = [place for place in found if marked.isdisjoint((place, *place.parents))]
        if others and len(others) < len(found):
            made = {place for place in marked if manifest_of(place)}
            kept = [place for place in found if made.isdisjoint((place, *place.parents))]
            if len(kept) < len(found):
                warn_odd(
                    min(made),
                    "left out, since r2flow wrote it, as are other such folders below the scans",
                )
            found = {place: found[place] for place in kept}
        if found:
            return [Drive(str(place.relative_to(root)), found[place]) for place in found]
    return []


def _walk(root: Path) -> Iterator[tuple[Path, list[str]]]:
    """All folders from a root down with their files, following links, each folder once, without
    hidden folders.
    """
    seen: set[str] = set()
    walk = os.walk(
        root,
        onerror=lambda e: warn_odd(Path(e.filename), "left out, not readable"),
        followlinks=True,
    )
    for place, folders, names in walk:
        if (real := os.path.realpath(place)) in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield Path(place), names


def elsewhere(root: Path) -> str:
    """Advice on how to convert the files of a folder without scans, if they hold scans in another
    form.
    """
    paths = (place / name for place, names in _walk(root) for name in sorted(names))
    return next((f" {path} {advice}." for path in paths if (advice := conversion_of(path))), "")


def _one_of_each(paths: _Names) -> _Names:
    images_last = sorted(paths, key=lambda path: path.lower().endswith(".npy"))
    kept = set({path[: len(path) - len(scan_ending(path))]: path for path in images_last}.values())
    return tuple(path for path in paths if path in kept)


def named_drives(drives: list[Drive], names: Sequence[str | int] | None) -> list[Drive]:
    """Drives by their names, or by the numbers in these; None takes all.

    Raises:
        InputError: a name that matches no drive or several.
    """
    if names is None:
        return drives
    return list(dict.fromkeys(_named(drives, str(name)) for name in names))


def _named(drives: list[Drive], name: str) -> Drive:
    number = {int(name)} if name.isdecimal() else set()
    matches = [drive for drive in drives if name == drive.name or number & numbers(drive.name)]
    if len(matches) != 1:
        names = [drive.name for drive in drives]
        listed = "none, its scans are in one folder" if names == ["."] else ", ".join(names)
        raise InputError(f"{len(matches) or 'no'} drives named {name!r}; known: {listed}.")
    return matches[0]


def numbers(name: str) -> set[int]:
    """The drive number in a KITTI name: the digits after 'drive', or the whole name."""
    parts = name.split("_")
    digits = parts[parts.index("drive") + 1] if "drive" in parts[:-1] else name
    return {int(digits)} if digits.isdecimal() else set()


def _files(folder: Path, endings: _Names) -> _Names:
    """The files of a folder with some endings, in order; none without such a folder."""
    return _scans(folder, os.listdir(folder), endings) if folder.is_dir() else ()


def _scans(folder: Path, names: Iterable[str], endings: _Names) -> _Names:
    """The files with some endings, in the order of the numbers in their names (2.bin before
    10.bin), without hidden files (macOS writes ._NAME next to NAME).
    """
    kept = [n for n in names if n.lower().endswith(endings) and not n.startswith(".")]
    return tuple(os.path.join(folder, name) for name in sorted(kept, key=_by_numbers))


def _by_numbers(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"([0-9]+)", name)
    return [(int(part) if part.isdecimal() else -1, part) for part in parts]
