"""From a data config to its scans, none of them read yet."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.data.layouts import SPLITS, find_drives, split_of
from r2flow.data.manifest import read_manifest
from r2flow.data.prepared import open_prepared
from r2flow.data.sources import ScanFiles, ScanSource, SimulatedScans
from r2flow.errors import InputError
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import Sensor
from r2flow.registry import check_options

log = logging.getLogger(__name__)

SIMULATED, PREPARED, MIXED = "simulated", "prepared", "mixed"

AUTO = "auto"


@dataclass(frozen=True)
class SourceOptions:
    """One data set of a run; the keys are those of `ScanDataModule`, where they are explained.

    Raises:
        InputError: no scene, or a reflectance scale that is not positive.
    """

    name: str = SIMULATED
    root: str | int | None = None
    split: str | None = None
    drives: list[str | int] | None = None
    scenes: int = 512
    projection: str = "spherical"
    convention: str = "centre"
    reflectance_scale: float = 1.0
    on_bad_scan: str = "error"

    def __post_init__(self) -> None:
        if not 0 < self.reflectance_scale < math.inf:
            raise InputError(f"data.reflectance_scale must be a positive number, found {self.reflectance_scale}.")
        if self.scenes < 1:
            raise InputError(f"data.scenes must be at least 1, found {self.scenes}.")

    @property
    def folder(self) -> str:
        """`root`, which is a folder's name even where it looks like a number.

        Raises:
            InputError: there is none.
        """
        if self.root is None:
            raise InputError(f"data={self.name} needs the folder of its scans: data.root=FOLDER.")
        return str(self.root)


@dataclass(frozen=True)
class PartOptions(SourceOptions):
    """One data set among several; `weight` is its share of the images of a run, beside the others' weights."""

    weight: float | None = None


def split_parts(options: SourceOptions, parts: Sequence[Mapping[str, Any]] | None) -> list[PartOptions]:
    """The parts of a mixture; what one does not say is the run's, but for root, split and drives.

    Raises:
        InputError: no part, an option that a part does not know, weights on some alone, or a part of which nobody said
            whether its test drives are meant too.
    """
    if not parts:
        example = "[{name: kitti_360, root: FOLDER, split: train, weight: 3}, {name: folder, root: FOLDER, weight: 1}]"
        raise InputError(f"data=mixed needs its parts: data.parts='{example}'.")
    common = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in ("root", "split", "drives")}
    made = []
    for number, part in enumerate(parts):
        what = f"data.parts[{number}]"
        if not isinstance(part, Mapping):
            raise InputError(f"{what} must be a group of keys, as {{name: folder, root: FOLDER}}; found {part!r}.")
        check_options(what, PartOptions, part)
        if "name" not in part or part["name"] in (MIXED, "pairs"):
            raise InputError(f"{what} needs the name of a data set, found {part.get('name')!r}.")
        if part["name"] in SPLITS and "split" not in part:
            known = ", ".join(SPLITS[part["name"]])
            raise InputError(
                f"{what}: {part['name']} has a standard split: give split, one of {known}, or null for all."
            )
        made.append(PartOptions(**{**common, **part}))
    if len({part.weight is None for part in made}) > 1:
        raise InputError("data.parts: give every part a weight, or none, for shares by size.")
    if sum(part.name == SIMULATED for part in made) > 1:
        raise InputError("data.parts: simulated scenes are numbered; give one simulated part, with all its scenes.")
    return made


def open_source(
    options: SourceOptions, sensor: Sensor, seed: int, reflectance: bool, first_scene: int = 0
) -> tuple[ScanSource, list[int]]:
    """The scans of a data set in their order, and the number of the first one of each drive.

    Args:
        reflectance: Whether the images hold reflectance.
        first_scene: Number of the first simulated scene.

    Raises:
        InputError: a folder that is missing or holds no such scans, an unknown split or drive.
    """
    if options.name == SIMULATED:
        scenes = range(first_scene, first_scene + options.scenes)
        return SimulatedScans(sensor, seed, scenes, reflectance), []
    if options.name == PREPARED:
        return _open_prepared(options, sensor, reflectance)
    if options.projection == "unfolding" and sensor.name == "hdl64e":
        log.warning(
            "unfolded rows are the sensor's rings, which are not evenly spaced: sensor=hdl64e_rings has their "
            "elevations, sensor=hdl64e is up to 6 degrees off"
        )
    root = Path(options.folder).expanduser()  # as the paths begin that are found in it, however it was written
    drives = find_drives(options.name, root, options.split, options.drives)
    paths = [path for drive in drives for path in drive.scans]
    source = ScanFiles(
        paths,
        sensor,
        options.on_bad_scan,
        root,
        projection=options.projection,
        convention=options.convention,
        reflectance=reflectance,
        reflectance_scale=options.reflectance_scale,
    )
    return source, np.cumsum([0, *(len(drive.scans) for drive in drives[:-1])]).tolist()


def _open_prepared(options: SourceOptions, sensor: Sensor, reflectance: bool) -> tuple[ScanSource, list[int]]:
    source = open_prepared(
        options.folder, sensor, options.split, options.drives, reflectance, options.projection, options.convention
    )
    drives, layout = source.manifest.drives, source.manifest.recipe.layout
    if options.split is None and options.drives is None:
        held = sorted({part for drive in drives if (part := split_of(layout, drive.name))})
        if len(held) > 1:
            log.warning("%s holds %s drives, and data.split=null takes all of them", options.folder, " and ".join(held))
    drive_of = {name: number for number, drive in enumerate(drives) for name in drive.scans}
    numbers = np.array([drive_of[name] for name in source.names])
    return source, [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist()]


def lacks_reflectance(options: SourceOptions) -> str | None:
    """Where a data set has no reflectance, judged by its first scan: what is missing, or None where it has one.

    A reflectance that is 0 throughout is none: a KITTI .bin has a column for it, whatever the sensor reports.

    Raises:
        InputError: the folder is missing or holds no such scan, or its first scan cannot be read.
    """
    if options.name == SIMULATED:
        return None
    if options.name == PREPARED:
        lacks = read_manifest(Path(options.folder).expanduser()).recipe.levels is None
        return f"the scans in {options.folder} have no reflectance" if lacks else None
    for drive in find_drives(options.name, options.folder, options.split, options.drives):
        for path in drive.scans:
            try:
                found = read_points(path).reflectance
            except InputError:
                if options.on_bad_scan == "error":
                    raise
                continue
            if found is None:
                return f"{path} has no reflectance"
            return None if found.any() else f"the reflectance in {path} is 0 throughout"
    return None  # none can be read, which is said when they are


def resolve_reflectance(wanted: Any, data: Mapping[str, Any]) -> bool:
    """`encoding.reflectance` for a config's `data`: `auto` is true where each of its data sets has reflectance.

    Raises:
        InputError: another value than true, false and auto; or, under auto, a data set that cannot be opened.
    """
    if isinstance(wanted, bool):
        return wanted
    if wanted != AUTO:
        raise InputError(f"encoding.reflectance must be true, false or auto, found {wanted!r}.")
    for options in described_sources(data):
        lacking = lacks_reflectance(options)
        if lacking:
            log.info("encoding.reflectance=auto is false here, a flow of range alone: %s", lacking)
            return False
    log.info("encoding.reflectance=auto is true here: the scans have it")
    return True


def described_sources(data: Mapping[str, Any]) -> list[SourceOptions]:
    """The data sets that a config's `data` names, to train on and to hold out; none where it names pairs."""
    if data.get("name") == "pairs":
        return []
    options = source_options(data)
    sources: list[SourceOptions] = [*split_parts(options, data.get("parts"))] if options.name == MIXED else [options]
    other = (data.get("validation") or {}).get("data")
    return sources if other is None else [*sources, validation_source(options, other)]


def source_options(data: Mapping[str, Any]) -> SourceOptions:
    """The part of a config's `data` that says where its scans are."""
    return SourceOptions(**{f.name: data[f.name] for f in fields(SourceOptions) if f.name in data})


def validation_source(options: SourceOptions, other: Mapping[str, Any]) -> SourceOptions:
    """`data.validation.data`: what it does not say is the run's, but for split and drives.

    Raises:
        InputError: an option that it does not know.
    """
    check_options("data.validation.data", SourceOptions, other)
    held = replace(options, **{"split": None, "drives": None, **other})
    if held.name in (MIXED, "pairs"):
        raise InputError(f"data.validation.data must name one data set, found {held.name}; hold out a part of it.")
    return held
