"""Where the scans of a data set lie: each layout finds its drives, in order."""

import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from r2flow.data.options import SourceOptions
from r2flow.data.reading import Reading, lacks_reflectance
from r2flow.data.sources import ScanFiles, ScanSource, warn_of_other_sensor
from r2flow.errors import InputError
from r2flow.lidar.scan_files import ELSEWHERE, FIRM_ENDINGS, LOOSE_ENDINGS, scan_ending

log = logging.getLogger(__name__)

KITTI_360_SPLIT = {"train": (3, 4, 5, 6, 7, 9, 10), "test": (0, 2)}
ODOMETRY_SPLIT = {"train": (0, 1, 2, 3, 4, 5, 6, 7, 9, 10), "validation": (8,), "test": tuple(range(11, 22))}
OBJECT_SPLIT = {"train": ("training",), "test": ("testing",)}


@dataclass(frozen=True)
class Drive:
    """One recording: scans that follow each other."""

    name: str  # what `data.drives` may call it
    scans: tuple[str, ...]  # paths: of a hundred thousand, Path objects take seconds and ten times the memory


class SourceKind:
    """A kind of scans that a name opens, `data=NAME` in a run and `NAME:ROOT` in a verb; an entry of `SOURCES`."""

    splits: Mapping[str, Sequence[int | str]] = {}  # names or numbers of the drives of each part of a standard split
    sensor = "hdl64e"  # name of the usual sensor
    reflectance_scale = 1.0  # the usual value that means full reflectance
    levels: int | None = None  # reflectance is n / levels

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanSource:
        """The scans in their order, none of them read yet; `seed` and `first_scene` are for simulated ones.

        `reading.reflectance` is True or False.
        """
        raise NotImplementedError

    def lacks_reflectance(self, options: SourceOptions, on_bad_scan: str = "error") -> str | None:
        """Why the scans count as scans without reflectance; None where they have it."""
        return None

    def levels_of(self, options: SourceOptions) -> int | None:
        """The levels of these scans' reflectance, n / levels; None if they are not known."""
        return self.levels

    def find_drives(self, options: SourceOptions) -> list[Drive]:
        """The drives of scan files, in order."""
        raise InputError(f"{options.name} scans are no files in drives.")

    def split_of(self, drive: str) -> str | None:
        """The part of the standard split that a drive belongs to, by its name; None where it is in none."""
        names = {drive, *_numbers(drive)}
        return next((part for part, members in self.splits.items() if names & set(members)), None)

    def chosen(self, drives: list[Drive], split: str | None, names: Sequence[str | int] | None) -> list[Drive]:
        """Those of a part of the standard split; of these, those of some names or numbers; None takes all."""
        if split is not None:
            if split not in self.splits:
                known = f"known: {', '.join(self.splits)}" if self.splits else "the data set has no standard split"
                raise InputError(f"no split named {split!r}; {known}.")
            drives = [drive for drive in drives if self.split_of(drive.name) == split]
        if names is None:
            return drives
        return list(dict.fromkeys(named_drive(drives, str(name)) for name in names))


@dataclass(frozen=True)
class Layout(SourceKind):
    """A data set of scan files, whose drives `find` finds below its folder, in order."""

    find: Callable[[Path], list[Drive]]  # the first line of its docstring says what it looks for
    splits: Mapping[str, Sequence[int | str]] = field(default_factory=dict)
    sensor: str = "hdl64e"
    reflectance_scale: float = 1.0
    levels: int | None = None

    def find_drives(self, options: SourceOptions) -> list[Drive]:
        """Those of the split and the drives that `options` names; a drive without a scan is none."""
        name, split, root = options.name, options.split, Path(options.folder).expanduser()
        self.chosen([], split, None)  # a split that is not known is refused before anything is looked for
        if not root.is_dir():
            raise InputError(
                f"{root} is not a folder. Give that of the scans (data.root=FOLDER; in a verb {name}:FOLDER)."
            )
        held = [drive for drive in self.find(root) if drive.scans]
        if not held:
            where = (self.find.__doc__ or "").splitlines()[0]
            raise InputError(f"{root} holds no scan. Looked for ({name}): {where}{_elsewhere(root)}")
        found = self.chosen(held, split, None)
        if not found:
            names = ", ".join(f"{drive.name} ({self.split_of(drive.name)})" for drive in held)
            raise InputError(
                f"{root} holds no scan of its {split} split; it holds {names[:200]}: give another data.split "
                "(--split), or null for all."
            )
        return self.chosen(found, None, options.drives)

    def open(self, options: SourceOptions, reading: Reading, seed: int = 0, first_scene: int = 0) -> ScanFiles:
        if reading.projection == "unfolding" and reading.sensor.name == "hdl64e":
            log.warning(
                "unfolded rows are the sensor's rings, which are not evenly spaced: sensor=hdl64e_rings has their "
                "elevations, sensor=hdl64e is up to 6 degrees off"
            )
        found = self.find_drives(options)
        drives = {drive.name: span for drive, span in zip(found, spans_of(found), strict=True)}
        about = {"kind": options.name, **({"split": options.split or "all"} if self.splits else {})}
        root = Path(options.folder).expanduser()  # as the paths begin that are found in it, however it was written
        paths = [path for drive in found for path in drive.scans]
        warn_of_other_sensor(paths, reading, root)
        return ScanFiles(paths, reading, root, drives, about)

    def lacks_reflectance(self, options: SourceOptions, on_bad_scan: str = "error") -> str | None:
        paths = (path for drive in self.find_drives(options) for path in drive.scans)
        return lacks_reflectance(paths, on_bad_scan, options.columns)


def kitti_360(root: Path) -> list[Drive]:
    """`data_3d_raw/2013_05_28_drive_XXXX_sync/velodyne_points/data/*.bin`."""
    base = root / "data_3d_raw" if (root / "data_3d_raw").is_dir() else root
    folders = sorted(base.glob("2013_05_28_drive_*_sync/velodyne_points/data"))
    return [Drive(folder.parent.parent.name, _files(folder, (".bin",))) for folder in folders]


def kitti_raw(root: Path) -> list[Drive]:
    """`DATE/DATE_drive_XXXX_sync/velodyne_points/data/*.bin`."""
    below = "*_drive_*_sync/velodyne_points/data"
    folders = sorted([*root.glob(f"*/{below}"), *root.glob(below)])
    return [Drive(folder.parent.parent.name, _files(folder, (".bin",))) for folder in folders]


def odometry(root: Path) -> list[Drive]:
    """`sequences/XX/velodyne/*.bin`, also below `dataset/`: KITTI odometry and SemanticKITTI."""
    base = root / "dataset" if (root / "dataset" / "sequences").is_dir() else root
    folders = sorted(f for f in base.glob("sequences/*/velodyne") if f.parent.name.isdecimal())
    return [Drive(folder.parent.name, _files(folder, (".bin",))) for folder in folders]


def kitti_object(root: Path) -> list[Drive]:
    """`training/velodyne/*.bin` and `testing/velodyne/*.bin`: KITTI object, each scan another place."""
    folders = [folder for name in ("training", "testing") if (folder := root / name / "velodyne").is_dir()]
    return [Drive(folder.parent.name, _files(folder, (".bin",))) for folder in folders]


def nuscenes(root: Path) -> list[Drive]:
    """`samples/LIDAR_TOP/*.pcd.bin` and `sweeps/LIDAR_TOP/*.pcd.bin`, or such files in the folder itself.

    A drive is a log, named at the head of each file: n015-2018-07-24-11-22-45+0800. Samples are the annotated scans
    among its sweeps; here they follow each other as they were recorded.
    """
    logs: dict[str, list[tuple[str, str]]] = {}
    for folder in (root / "samples" / "LIDAR_TOP", root / "sweeps" / "LIDAR_TOP", root):
        for path in _files(folder, (".pcd.bin",)) if folder.is_dir() else ():
            file = os.path.basename(path)
            logs.setdefault(file.partition("__")[0], []).append((file, path))
    return [Drive(log, tuple(path for _, path in sorted(scans))) for log, scans in sorted(logs.items())]


def folder(root: Path) -> list[Drive]:
    """Any folder of .bin, .pcd.bin, .pcd, .ply, .npy, .xyz, .las, .laz, .feather, .parquet, else of .csv, .txt, .npz.

    Each folder below it that holds some is a drive. Of a scan that lies there in several formats, one file is taken:
    its range image, else the last by its ending.
    """
    below = sorted(Path(place) for place, _ in _walk(root))
    for endings in (FIRM_ENDINGS, LOOSE_ENDINGS):
        drives = [Drive(str(place.relative_to(root)), _one_of_each(_files(place, endings))) for place in below]
        if any(drive.scans for drive in drives):
            break
    return drives


def _walk(root: Path) -> Iterator[tuple[str, list[str]]]:
    """Every folder from a root down and its files, through links to folders too, each folder once."""
    seen: set[str] = set()
    for place, folders, names in os.walk(root, followlinks=True):
        real = os.path.realpath(place)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders.sort()
        yield place, names


def _elsewhere(root: Path) -> str:
    """What turns the files of a folder that holds no scan into some, where they hold scans in another form."""
    for place, names in _walk(root):
        for name in sorted(names):
            for ending, advice in ELSEWHERE.items():
                if name.lower().endswith(ending):
                    path = os.path.join(place, name)
                    return f" {path} {advice.format(path=path)}."
    return ""


def _one_of_each(paths: tuple[str, ...]) -> tuple[str, ...]:
    images_last = sorted(paths, key=lambda path: path.endswith(".npy"))
    kept = set({path[: len(path) - len(scan_ending(path))]: path for path in images_last}.values())
    return tuple(path for path in paths if path in kept)


def spans_of(drives: Sequence[Drive]) -> list[range]:
    """The numbers of each drive's scans, where the drives lie end to end."""
    ends = accumulate(len(drive.scans) for drive in drives)
    return [range(end - len(drive.scans), end) for drive, end in zip(drives, ends, strict=True)]


def named_drive(drives: list[Drive], name: str) -> Drive:
    """The drive of a name, or of a number in its name; none and several are refused."""
    matches = [d for d in drives if name == d.name or (name.isdecimal() and int(name) in _numbers(d.name))]
    if len(matches) != 1:
        names = [drive.name for drive in drives]
        known = "none, its scans lie in one folder" if names == ["."] else ", ".join(names)
        problem = "no drive" if not matches else f"{len(matches)} drives"
        raise InputError(f"{problem} named {name!r}; known: {known}.")
    return matches[0]


def _numbers(name: str) -> set[int]:
    """The drive number in a KITTI name: the digits after 'drive', or the whole name."""
    parts = name.split("_")
    digits = parts[parts.index("drive") + 1] if "drive" in parts[:-1] else name
    return {int(digits)} if digits.isdecimal() else set()


def _in_order(name: str) -> list[tuple[int, str]]:
    """By the numbers in a name: 2.bin comes before 10.bin."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"([0-9]+)", name)]


def _files(folder: Path, endings: tuple[str, ...]) -> tuple[str, ...]:
    """The files of a folder by their endings, in order; hidden ones (macOS leaves ._NAME beside NAME) are none."""
    names = sorted(
        (n for n in os.listdir(folder) if n.lower().endswith(endings) and not n.startswith(".")), key=_in_order
    )
    return tuple(os.path.join(folder, name) for name in names)
