"""Where the scans of a data set lie: each layout finds its drives, in order."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from r2flow.errors import InputError
from r2flow.lidar.scan_files import SCAN_ENDINGS
from r2flow.registry import Registry

KITTI_360_SPLIT = {"train": (3, 4, 5, 6, 7, 9, 10), "test": (0, 2)}
ODOMETRY_SPLIT = {
    "train": (0, 1, 2, 3, 4, 5, 6, 7, 9, 10),
    "validation": (8,),
    "test": tuple(range(11, 22)),
}
OBJECT_SPLIT = {"train": ("training",), "test": ("testing",)}

# What a layout's `split` may be; those that are not here have no standard split.
SPLITS: Mapping[str, Mapping[str, Sequence[int | str]]] = MappingProxyType(
    {"kitti_360": KITTI_360_SPLIT, "odometry": ODOMETRY_SPLIT, "object": OBJECT_SPLIT}
)


@dataclass(frozen=True)
class Drive:
    """One recording: scans that follow each other.

    Attributes:
        name: What `data.drives` may call it.
        scans: Paths, as strings: of a hundred thousand, Path objects take seconds and ten times the memory.
    """

    name: str
    scans: tuple[str, ...]


def kitti_360(root: Path, split: str | None = None) -> list[Drive]:
    """`data_3d_raw/2013_05_28_drive_XXXX_sync/velodyne_points/data/*.bin` and its standard split."""
    base = root / "data_3d_raw" if (root / "data_3d_raw").is_dir() else root
    folders = sorted(base.glob("2013_05_28_drive_*_sync/velodyne_points/data"))
    chosen = _of_split(folders, split, KITTI_360_SPLIT, lambda f: int(f.parent.parent.name.split("_")[4]))
    return [_drive(folder.parent.parent.name, folder) for folder in chosen]


def kitti_raw(root: Path, split: str | None = None) -> list[Drive]:
    """`DATE/DATE_drive_XXXX_sync/velodyne_points/data/*.bin`; it has no standard split."""
    _no_split("kitti_raw", split)
    below = "*_drive_*_sync/velodyne_points/data"
    folders = sorted([*root.glob(f"*/{below}"), *root.glob(below)])
    return [_drive(folder.parent.parent.name, folder) for folder in folders]


def odometry(root: Path, split: str | None = None) -> list[Drive]:
    """`sequences/XX/velodyne/*.bin`, also below `dataset/`: KITTI odometry and SemanticKITTI, and its split."""
    base = root / "dataset" if (root / "dataset" / "sequences").is_dir() else root
    folders = sorted(f for f in base.glob("sequences/*/velodyne") if f.parent.name.isdigit())
    chosen = _of_split(folders, split, ODOMETRY_SPLIT, lambda f: int(f.parent.name))
    return [_drive(folder.parent.name, folder) for folder in chosen]


def kitti_object(root: Path, split: str | None = None) -> list[Drive]:
    """`training/velodyne/*.bin` and `testing/velodyne/*.bin`: KITTI object, each scan another place."""
    folders = [folder for name in ("training", "testing") if (folder := root / name / "velodyne").is_dir()]
    chosen = _of_split(folders, split, OBJECT_SPLIT, lambda f: f.parent.name)
    return [_drive(folder.parent.name, folder) for folder in chosen]


def nuscenes(root: Path, split: str | None = None) -> list[Drive]:
    """`samples/LIDAR_TOP/*.pcd.bin` and `sweeps/LIDAR_TOP/*.pcd.bin`, or such files in the folder itself.

    A drive is a log, named at the head of each file: n015-2018-07-24-11-22-45+0800. Samples are the annotated scans
    among its sweeps; here they follow each other as they were recorded.
    """
    _no_split("nuscenes", split)
    logs: dict[str, list[tuple[str, str]]] = {}
    for folder in (root / "samples" / "LIDAR_TOP", root / "sweeps" / "LIDAR_TOP", root):
        for path in _files(folder, (".pcd.bin",)) if folder.is_dir() else ():
            file = os.path.basename(path)
            logs.setdefault(file.partition("__")[0], []).append((file, path))
    return [Drive(log, tuple(path for _, path in sorted(scans))) for log, scans in sorted(logs.items())]


def folder(root: Path, split: str | None = None) -> list[Drive]:
    """Any folder of scans; each folder below it that holds some is a drive."""
    _no_split("folder", split)
    below = sorted(Path(place) for place, _, _ in os.walk(root))
    return [Drive(str(place.relative_to(root)), _files(place, SCAN_ENDINGS)) for place in below]


Layout = Callable[[Path, str | None], list[Drive]]
LAYOUTS: Registry[Layout] = Registry(
    "data layout",
    kitti_360=kitti_360,
    kitti_raw=kitti_raw,
    odometry=odometry,
    object=kitti_object,
    nuscenes=nuscenes,
    folder=folder,
)


def find_drives(
    layout: str, root: str | Path, split: str | None = None, drives: Sequence[str | int] | None = None
) -> list[Drive]:
    """The drives of a data set, in order.

    Args:
        layout: A name in `LAYOUTS`.
        root: Folder of the data set.
        split: A part of the layout's standard split; None takes all.
        drives: Names or numbers of the drives to take; None takes all.

    Raises:
        InputError: a root that is missing or holds no scan in this layout, an unknown split, or a drive
            that is not there.
    """
    find, root = LAYOUTS[layout], Path(root).expanduser()
    if not root.is_dir():
        raise InputError(f"data.root={root} is not a folder. Give the folder of your {layout} scans.")
    found = [drive for drive in find(root, split) if drive.scans]
    if not found:
        part = f" of its {split} split" if split else ""
        where = (find.__doc__ or "").splitlines()[0]
        raise InputError(f"data.root={root} holds no {layout} scan{part}. Looked for: {where}")
    return found if drives is None else [named_drive(found, str(name)) for name in drives]


def named_drive(drives: list[Drive], name: str) -> Drive:
    """The drive of a name, or of a number in its name.

    Raises:
        InputError: none, or several.
    """
    matches = [d for d in drives if name == d.name or (name.isdigit() and int(name) in _numbers(d.name))]
    if len(matches) != 1:
        known = ", ".join(d.name for d in drives)
        problem = "no drive" if not matches else f"{len(matches)} drives"
        raise InputError(f"{problem} named {name!r}; known: {known}.")
    return matches[0]


def split_of(layout: str, drive: str) -> str | None:
    """The part of a layout's standard split that a drive belongs to, by its name; None where it is in none."""
    names = {drive, *_numbers(drive)}
    return next((part for part, members in SPLITS.get(layout, {}).items() if names & set(members)), None)


def _numbers(name: str) -> set[int]:
    """The drive number in a KITTI name: the digits after 'drive', or the whole name."""
    parts = name.split("_")
    digits = parts[parts.index("drive") + 1] if "drive" in parts[:-1] else name
    return {int(digits)} if digits.isdigit() else set()


def _drive(name: str, folder: Path) -> Drive:
    return Drive(name, _files(folder, (".bin",)))


def _files(folder: Path, endings: tuple[str, ...]) -> tuple[str, ...]:
    """The files of a folder by their endings, in order; hidden ones (macOS leaves ._NAME beside NAME) are none."""
    names = sorted(n for n in os.listdir(folder) if n.lower().endswith(endings) and not n.startswith("."))
    return tuple(os.path.join(folder, name) for name in names)


def _of_split(
    folders: list[Path],
    split: str | None,
    parts: Mapping[str, Sequence[int | str]],
    number: Callable[[Path], int | str],
) -> list[Path]:
    if split is None:
        return folders
    if split not in parts:
        raise InputError(f"no split named {split!r}; known: {', '.join(parts)}.")
    return [folder for folder in folders if number(folder) in parts[split]]


def _no_split(layout: str, split: str | None) -> None:
    if split is not None:
        raise InputError(f"{layout} has no standard split, found split={split!r}; name data.drives=[...] instead.")
