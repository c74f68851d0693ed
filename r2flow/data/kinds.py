"""Kinds of scans by name: `data=NAME` in a run, `NAME:ROOT` in a command.

To add one, register in `SOURCES` a `Layout(find_mine)` of scan files that `find_mine(root)` lists,
a `r2flow.data.own.DatasetKind`, or a subclass of `SourceKind`.
"""

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from r2flow.base.errors import InputError
from r2flow.base.registry import Registry
from r2flow.data import layouts
from r2flow.data.files import ScanFiles
from r2flow.data.layouts import Drive
from r2flow.data.options import FOLDER, ReadingOptions, SourceOptions
from r2flow.data.prepared import PreparedScans, PreparedStore, refuse_other_images, stored_scans
from r2flow.data.reading import Reading, labelled, leaving_out
from r2flow.data.reflectance import lacks_reflectance
from r2flow.data.sensor_checks import warn_of_other_sensor
from r2flow.data.simulated import SimulatedScans
from r2flow.data.sources import ScanSource

if TYPE_CHECKING:
    from r2flow.data.described import Described

_log = logging.getLogger(__name__)

HowRead = Reading | ReadingOptions


@dataclass(frozen=True, kw_only=True)
class SourceKind(ABC):
    """A kind of scans."""

    # standard split: names or numbers of each part's drives
    splits: Mapping[str, Sequence[int | str]] = field(default_factory=dict)
    sensor: str = "hdl64e"  # name of the default sensor
    reflectance_scale: float = 1.0  # default value of full reflectance
    levels: int | None = None  # reflectance is n / levels

    @abstractmethod
    def open(self, scans: "Described", reading: Reading) -> ScanSource:
        """The scans in order, not yet read; `reading.reflectance` is True or False."""

    def lacks_reflectance(self, scans: "Described", reading: HowRead) -> str | None:
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
        names = {drive, *layouts.numbers(drive)}
        return next((part for part, members in self.splits.items() if names & set(members)), None)

    def part(self, drives: list[Drive], split: str | None) -> list[Drive]:
        """The drives of a part of the split; None takes all."""
        if split is None:
            return drives
        if split not in self.splits:
            known = ", ".join(self.splits) or "none, the data set has no standard split"
            raise InputError(f"no split named {split!r}; known: {known}.")
        return [drive for drive in drives if self.split_of(drive.name) == split]


class _Simulated(SourceKind):
    """Street scenes of a seed."""

    def open(self, scans: "Described", reading: Reading) -> ScanSource:
        scenes = range(scans.first_scene, scans.first_scene + scans.options.scenes)
        return SimulatedScans(
            reading.sensor, scans.seed, scenes, bool(reading.reflectance), reading.labels
        )


@dataclass(frozen=True)
class Layout(SourceKind):
    """A data set of scan files; `find` lists its drives below a folder, in order."""

    # the first line of its docstring is the pattern of its files
    find: Callable[[Path], list[Drive]]

    def find_drives(self, options: SourceOptions) -> list[Drive]:
        """The drives of the split and the names in `options`, without empty drives."""
        name = options.name
        split = options.split
        root = options.folder
        self.part([], split)  # refuses an unknown split before any search
        if not root.is_dir():
            raise InputError(
                f"{root} is not a folder. Give that of the scans (data.root=FOLDER; in a verb "
                f"{name}:FOLDER)."
            )
        nonempty = [drive for drive in self.find(root) if drive.scans]
        if not nonempty:
            where = (self.find.__doc__ or "scan files").splitlines()[0]
            raise InputError(
                f"{root} holds no scan. Looked for ({name}): {where}{layouts.elsewhere(root)}"
            )
        drives = self.part(nonempty, split)
        if not drives:
            names = ", ".join(f"{drive.name} ({self.split_of(drive.name)})" for drive in nonempty)
            raise InputError(
                f"{root} holds no scan of its {split} split; it holds {names[:200]}: give another "
                "data.split (--split), or null for all."
            )
        return layouts.named_drives(drives, options.drives)

    def open(self, scans: "Described", reading: Reading) -> ScanFiles:
        if reading.projection == "unfolding" and reading.sensor.name == "hdl64e":
            _log.warning(
                "unfolded rows are the sensor's rings, which are not evenly spaced: "
                "sensor=hdl64e_rings has their elevations, sensor=hdl64e is up to 6 degrees off"
            )
        options = scans.options
        warn_of_other_sensor(scans, reading)
        if reading.labels and not labelled(scans.paths):
            raise InputError(f"{options.folder}: no scan has labels, as 000000.label beside it.")
        about = {"kind": "file" if scans.file else options.name}
        if self.splits:
            about["split"] = options.split or "all"
        numbers = {} if scans.file else _numbers_of(scans.drives)
        return ScanFiles(scans.paths, reading, options.folder, numbers, about)

    def lacks_reflectance(self, scans: "Described", reading: HowRead) -> str | None:
        with leaving_out(reading.on_bad_scan == "error" and not scans.file):
            return lacks_reflectance(scans.paths, reading.on_bad_scan, reading.columns)


def _numbers_of(drives: Sequence[Drive]) -> dict[str, range]:
    """By drive: the numbers of its scans in the set."""
    numbers = {}
    first = 0
    for drive in drives:
        numbers[drive.name] = range(first, first + len(drive.scans))
        first += len(drive.scans)
    return numbers


class _Prepared(SourceKind):
    """Shards of `r2flow prepare`."""

    def open(self, scans: "Described", reading: Reading) -> ScanSource:
        options = scans.options
        store = stored_scans(options.folder, scans.manifest)
        refuse_other_images(store, reading)
        layout = store.described["layout"]
        kind = SOURCES[layout if layout in SOURCES else FOLDER]
        if options.split is None and options.drives is None:
            _warn_of_parts(store, kind)
        drives = layouts.named_drives(kind.part(store.drives, options.split), options.drives)
        place = {name: number for number, name in enumerate(store.names)}
        numbers = [place[name] for drive in drives for name in drive.scans]
        return PreparedScans(store, numbers, bool(reading.reflectance), reading.labels)

    def lacks_reflectance(self, scans: "Described", reading: HowRead) -> str | None:
        if self.levels_of(scans) is None:
            return f"the scans in {scans.options.folder} have no reflectance"
        return None

    def levels_of(self, scans: "Described") -> int | None:
        levels: int | None = stored_scans(scans.options.folder, scans.manifest).described["levels"]
        return levels


def _warn_of_parts(store: PreparedStore, kind: SourceKind) -> None:
    """Warn of prepared scans of several parts of the split, all of which are taken."""
    parts = {kind.split_of(drive.name) for drive in store.drives} - {None}
    if len(parts) > 1:
        _log.warning(
            "%s holds %s drives, and data.split=null takes all of them",
            store.folder,
            " and ".join(sorted(map(str, parts))),
        )


SOURCES: Registry[SourceKind] = Registry(
    "data set",
    simulated=_Simulated(levels=100),
    prepared=_Prepared(),
    kitti_360=Layout(layouts.kitti_360, splits=layouts.KITTI_360_SPLIT, levels=256),
    kitti_raw=Layout(layouts.kitti_raw, levels=100),
    odometry=Layout(layouts.odometry, splits=layouts.ODOMETRY_SPLIT, levels=100),
    object=Layout(layouts.kitti_object, splits=layouts.OBJECT_SPLIT, levels=100),
    nuscenes=Layout(layouts.nuscenes, sensor="hdl32e", reflectance_scale=255.0, levels=255),
    pandaset=Layout(
        layouts.pandaset,
        splits=layouts.PANDASET_SPLIT,
        sensor="pandar64",
        reflectance_scale=255.0,
        levels=255,
    ),
    folder=Layout(layouts.folder),
)
