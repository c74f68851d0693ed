"""Folder layouts of data sets: each layout finds the drives and scans of a data set, in order."""

import logging
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from r2flow.base.errors import InputError, warn_odd
from r2flow.data.options import SourceOptions
from r2flow.data.reading import Reading, labelled, lacks_reflectance, leaving_out
from r2flow.data.sources import ScanFiles, ScanSource, warn_of_other_sensor
from r2flow.lidar.scan_files import (
    FIRM_ENDINGS,
    LOOSE_ENDINGS,
    TABLE_ENDINGS,
    conversion_of,
    scan_ending,
)
from r2flow.store import manifest_of

log = logging.getLogger(__name__)

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


if TYPE_CHECKING:
    from r2flow.data.opening import Described


@dataclass(frozen=True)
class Drive:
    """One recording: consecutive scans."""

    name: str  # its name in `data.drives`
    # paths as strings: 100,000 Path objects take seconds and ten times the memory
    scans: tuple[str, ...]


class SourceKind(ABC):
    """A kind of scans, an entry of `SOURCES`: `data=NAME` in a run, `NAME:ROOT` in a command."""

    # standard split: names or numbers of each part's drives
    splits: Mapping[str, Sequence[int | str]] = {}
    sensor = "hdl64e"  # name of the default sensor
    reflectance_scale = 1.0  # default value of full reflectance
    levels: int | None = None  # reflectance is n / levels

    @abstractmethod
    def open(
        self, scans: "Described", reading: Reading, seed: int = 0, first_scene: int = 0
    ) -> ScanSource:
        """The scans in order, not yet read; `seed` and `first_scene` are for simulated scans.

        `reading.reflectance` is True or False.
        """

    def lacks_reflectance(self, scans: "Described", on_bad_scan: str = "error") -> str | None:
        """Reason why the scans count as without reflectance; None if they have it."""
        return None

    def levels_of(self, scans: "Described") -> int | None:
        """The levels of these scans' reflectance, n / levels; None if unknown."""
        return self.levels

    def find_drives(self, options: SourceOptions) -> list[Drive]:
        """The drives of scan files, in order."""
        raise InputError(
            f"{options.name} scans are not files in drives: train on them by data={options.name}."
        )

    def split_of(self, drive: str) -> str | None:
        """The part of the standard split that contains a drive, by its name, or None."""
        names = {drive, *_numbers(drive)}
        return next((part for part, members in self.splits.items() if names & set(members)), None)

    def chosen(
        self, drives: list[Drive], split: str | None, names: Sequence[str | int] | None
    ) -> list[Drive]:
        """Select drives by a part of the split, then by names or numbers; None takes all."""
        if split is not None:
            if split not in self.splits:
                known = ", ".join(self.splits) or "none, the data set has no standard split"
                raise InputError(f"no split named {split!r}; known: {known}.")
            drives = [drive for drive in drives if self.split_of(drive.name) == split]
        if names is None:
            return drives
        return list(dict.fromkeys(named_drive(drives, str(name)) for name in names))


@dataclass(frozen=True)
class Layout(SourceKind):
    """A data set of scan files; `find` lists its drives below a folder, in order."""

    # the first line of its docstring is the pattern of its files
    find: Callable[[Path], list[Drive]]
    splits: Mapping[str, Sequence[int | str]] = field(default_factory=dict)
    sensor: str = "hdl64e"
    reflectance_scale: float = 1.0
    levels: int | None = None

    def find_drives(self, options: SourceOptions) -> list[Drive]:
        """The drives of the split and the names in `options`, without empty drives."""
        name = options.name
        split = options.split
        root = options.folder
        self.chosen([], split, None)  # refuses an unknown split before any search
        if not root.is_dir():
            raise InputError(
                f"{root} is not a folder. Give that of the scans (data.root=FOLDER; in a verb "
                f"{name}:FOLDER)."
            )
        nonempty = [drive for drive in self.find(root) if drive.scans]
        if not nonempty:
            where = (self.find.__doc__ or "scan files").splitlines()[0]
            raise InputError(
                f"{root} holds no scan. Looked for ({name}): {where}{_elsewhere(root)}"
            )
        drives = self.chosen(nonempty, split, None)
        if not drives:
            names = ", ".join(f"{drive.name} ({self.split_of(drive.name)})" for drive in nonempty)
            raise InputError(
                f"{root} holds no scan of its {split} split; it holds {names[:200]}: give another "
                "data.split "
                "(--split), or null for all."
            )
        return self.chosen(drives, None, options.drives)

    def open(
        self, scans: "Described", reading: Reading, seed: int = 0, first_scene: int = 0
    ) -> ScanFiles:
        if reading.projection == "unfolding" and reading.sensor.name == "hdl64e":
            log.warning(
                "unfolded rows are the sensor's rings, which are not evenly spaced: "
                "sensor=hdl64e_rings has their "
                "elevations, sensor=hdl64e is up to 6 degrees off"
            )
        first = 0
        drives: dict[str, range] = {}
        for drive in scans.drives:
            drives[drive.name] = range(first, first + len(drive.scans))
            first += len(drive.scans)
        options = scans.options
        about = {"kind": options.name}
        if self.splits:
            about["split"] = options.split or "all"
        warn_of_other_sensor(scans.paths, reading, options.folder, scans.made_here)
        if reading.labels and not labelled(scans.paths):
            raise InputError(f"{options.folder}: no scan has labels, as 000000.label beside it.")
        return ScanFiles(scans.paths, reading, options.folder, drives, about)

    def lacks_reflectance(self, scans: "Described", on_bad_scan: str = "error") -> str | None:
        with leaving_out(on_bad_scan == "error"):
            return lacks_reflectance(scans.paths, on_bad_scan, scans.options.chosen.get("columns"))


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
    logs: dict[str, list[tuple[str, str]]] = {}
    for folder in (root / "samples" / "LIDAR_TOP", root / "sweeps" / "LIDAR_TOP", root):
        for path in _files(folder, (".pcd.bin",)) if folder.is_dir() else ():
            file = os.path.basename(path)
            logs.setdefault(file.partition("__")[0], []).append((file, path))
    return [
        Drive(log, tuple(path for _, path in sorted(scans))) for log, scans in sorted(logs.items())
    ]


def pandaset(root: Path) -> list[Drive]:
    """`NNN/lidar/FF.pkl.gz` with poses.json and timestamps.json beside them, or one drive."""
    folders = [f for f in (root, root / "lidar", *sorted(root.glob("*/lidar"))) if f.is_dir()]
    return [
        Drive(folder.resolve().parent.name, _files(folder, TABLE_ENDINGS))
        for folder in folders
        if folder.resolve().name == "lidar"
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
    below = sorted(Path(place) for place, _ in _walk(root))
    made = {place for place in below if place != root and manifest_of(place)}
    own = [place for place in below if made.isdisjoint((place, *place.parents))]
    for endings in (FIRM_ENDINGS, LOOSE_ENDINGS):
        for places in (own, below):
            drives = [
                Drive(str(place.relative_to(root)), _one_of_each(_files(place, endings)))
                for place in places
            ]
            if any(drive.scans for drive in drives):
                if len(places) < len(below):
                    warn_odd(
                        min(made),
                        "left out, since r2flow wrote it, as are other such folders below the "
                        "scans",
                    )
                return drives
    return []


def _walk(root: Path) -> Iterator[tuple[str, list[str]]]:
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
        yield place, names


def _elsewhere(root: Path) -> str:
    """Advice on how to convert the files of a folder without scans, if they hold scans in another
    form.
    """
    paths = (os.path.join(place, name) for place, names in _walk(root) for name in sorted(names))
    return next((f" {path} {advice}." for path in paths if (advice := conversion_of(path))), "")


def _one_of_each(paths: tuple[str, ...]) -> tuple[str, ...]:
    images_last = sorted(paths, key=lambda path: path.lower().endswith(".npy"))
    kept = set({path[: len(path) - len(scan_ending(path))]: path for path in images_last}.values())
    return tuple(path for path in paths if path in kept)


def named_drive(drives: list[Drive], name: str) -> Drive:
    """The only drive with a name, or with a number in its name; refuses names that match no drive
    or several.
    """
    matches = [
        d for d in drives if name == d.name or (name.isdecimal() and int(name) in _numbers(d.name))
    ]
    if len(matches) != 1:
        names = [drive.name for drive in drives]
        listed = "none, its scans are in one folder" if names == ["."] else ", ".join(names)
        raise InputError(f"{len(matches) or 'no'} drives named {name!r}; known: {listed}.")
    return matches[0]


def _numbers(name: str) -> set[int]:
    """The drive number in a KITTI name: the digits after 'drive', or the whole name."""
    parts = name.split("_")
    digits = parts[parts.index("drive") + 1] if "drive" in parts[:-1] else name
    return {int(digits)} if digits.isdecimal() else set()


def _files(folder: Path, endings: tuple[str, ...]) -> tuple[str, ...]:
    """The files of a folder with some endings, in order, without hidden files (macOS writes ._NAME
    next to NAME).
    """
    names = [n for n in os.listdir(folder) if n.lower().endswith(endings) and not n.startswith(".")]
    # By the numbers in a name: 2.bin comes before 10.bin.
    names.sort(
        key=lambda n: [
            (int(part) if part.isdecimal() else -1, part) for part in re.split(r"([0-9]+)", n)
        ]
    )
    return tuple(os.path.join(folder, name) for name in names)
