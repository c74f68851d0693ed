"""Which scans are to be prepared, and how: decided before the first of them is."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2flow import simulator
from r2flow.data.layouts import Drive
from r2flow.data.manifest import Recipe, checksum, describe_sensor
from r2flow.data.opening import find_drives
from r2flow.data.options import SIMULATED
from r2flow.data.quantise import OTHER_LEVELS, RangeCodes, ReflectanceCodes, find_levels
from r2flow.data.sources import Reading, ScanFiles, ScanSource, SimulatedScans, spread, stored_reflectance
from r2flow.errors import InputError
from r2flow.lidar.sensors import Sensor

log = logging.getLogger(__name__)

SHARD_SCANS = 512  # 100 MB at 64 x 1024, held in memory while they are made
PROBED = 8  # scans that tell whether a data set has reflectance, and in which steps

PROJECTION = 1  # to be raised when the same files give other images, or images other codes


@dataclass(frozen=True)
class Plan:
    """The scans to prepare, and how."""

    recipe: Recipe
    drives: tuple[Drive, ...]
    source: ScanSource


def plan_files(
    layout: str,
    root: str | Path,
    sensor: Sensor,
    projection: str = "spherical",
    convention: str = "centre",
    split: str | None = None,
    drives: Sequence[str | int] | None = None,
    reflectance_scale: float = 1.0,
    levels: int | None = None,
    shard_scans: int = SHARD_SCANS,
) -> Plan:
    """The scans of a data set (`find_drives`). Without `levels`, some of the scans tell those of reflectance.

    Raises:
        InputError: no such scans, or levels out of their range.
    """
    root = Path(root).expanduser()
    found = find_drives(layout, root, split, drives)
    paths = [path for drive in found for path in drive.scans]
    named = tuple(Drive(d.name, tuple(Path(os.path.relpath(p, root)).as_posix() for p in d.scans)) for d in found)
    known = _reflectance_levels(paths, reflectance_scale, levels)
    recipe = _recipe(layout, named, sensor, projection, convention, reflectance_scale, known, shard_scans)
    reading = Reading(sensor, projection, convention, reflectance_scale, known is not None, "error", within_limits=True)  # type: ignore[arg-type]
    return Plan(recipe, named, ScanFiles(paths, reading))


def plan_simulated(
    num: int, seed: int, sensor: Sensor, levels: int | None = None, shard_scans: int = SHARD_SCANS
) -> Plan:
    """The first `num` scenes of the simulator under a seed."""
    drives = (Drive(SIMULATED, tuple(f"scene {scene}" for scene in range(num))),)
    source = SimulatedScans(sensor, seed, range(num))
    known = levels or find_levels(source[0][1])
    recipe = _recipe(SIMULATED, drives, sensor, "spherical", "centre", 1.0, known, shard_scans, seed)
    return Plan(recipe, drives, source)


def _recipe(
    layout: str, drives: tuple[Drive, ...], sensor: Sensor, projection: str, convention: str, scale: float,
    levels: int | None, shard_scans: int, seed: int | None = None,
) -> Recipe:  # fmt: skip
    names = [name for drive in drives for name in drive.scans]
    codes = RangeCodes(sensor.min_range, sensor.max_range)
    if levels is not None:
        ReflectanceCodes(levels)
    revision = PROJECTION if seed is None else simulator.REVISION
    return Recipe(
        revision, layout, len(names), checksum(names), describe_sensor(sensor), projection, convention,
        scale, levels, codes.describe(), shard_scans, seed,
    )  # fmt: skip


def _reflectance_levels(paths: Sequence[str], scale: float, levels: int | None) -> int | None:
    """Levels of reflectance, `levels` where given; None where one of some scans has none, or all have 0 throughout."""
    found = []
    for index in spread(len(paths), PROBED):
        try:
            reflectance = stored_reflectance(paths[index])
        except InputError:  # it is met again, and dealt with, when its turn comes
            continue
        if reflectance is None:
            return None
        found.append(reflectance / np.float32(scale))
    if found and not any(one.any() for one in found):
        return None
    if levels is not None:
        return levels
    return _found_levels(np.concatenate(found), scale) if found else OTHER_LEVELS


def _found_levels(reflectance: np.ndarray, scale: float) -> int:
    levels, highest = find_levels(reflectance), float(reflectance.max())
    if highest < 0.25 and not ReflectanceCodes(levels).fits(reflectance):
        log.warning(
            "reflectance goes up to %.3g of 1 alone and is kept in steps of 1/%d: --reflectance-scale %.3g spreads it",
            highest, levels, highest * scale,
        )  # fmt: skip
    return levels
