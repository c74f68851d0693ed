"""Fill in the defaults of a run's `data`, once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from r2flow.base.errors import InputError
from r2flow.base.registry import construct
from r2flow.data.opening import SOURCES, Described, Layout, Prepared
from r2flow.data.options import (
    MIXED,
    PAIRS,
    SIMULATED,
    Data,
    DataOptions,
    PartOptions,
    ReadingOptions,
    SourceOptions,
)
from r2flow.data.reading import scaled_reflectance
from r2flow.data.sources import readable
from r2flow.lidar.sensors import Sensor, build_sensor, sensor_options

Options = TypeVar("Options", bound=SourceOptions)

# Options that a kind of scans would ignore.
IGNORED = {
    SIMULATED: ("root", "split", "drives"),
    PAIRS: ("split", "drives"),
    MIXED: ("split", "drives"),
}


@dataclass(frozen=True)
class DataPlan:
    """The sets of scans of a run, complete: each reading and sensor has all its options."""

    sets: Sequence[Described]  # to train on, with `PartOptions`; empty for pairs
    held_out: Described | None  # to validate on; None: a share of `sets`
    scans: Described | None  # next to pairs


def plan_data(options: DataOptions, sensor: Sensor) -> DataPlan:
    """The sets of scans of a run's `data`, on a sensor.

    Parts and held-out scans inherit missing keys of the run, except split and drives.

    Raises:
        InputError: an unknown data set or option, or one that would be ignored.
    """
    _refuse_ignored("data", options)
    sets: list[Described] = []
    if options.name == MIXED:
        sets = _parts(options, sensor)
    elif options.name != PAIRS:
        single = {field.name: getattr(options, field.name) for field in fields(SourceOptions)}
        sets = [_complete(PartOptions(**single), options.chosen, sensor)]
    held_out = None
    if options.validation.data is not None:
        if options.name == PAIRS:
            raise InputError("data.validation.data cannot be held out from pairs; leave it out.")
        held_out = _held_out(options, options.validation.data, sensor)
    scans = None
    if options.scans is not None:
        beside = _checked_set("data.scans", SourceOptions, options.scans, options)
        scans = _complete(beside, _without_scale(options.chosen), sensor)
    return DataPlan(sets, held_out, scans)


def _without_scale(reading: Data) -> Data:
    """What a reading says of other files, too, with other columns and scale."""
    own = ("columns", "reflectance_scale")
    return {key: value for key, value in reading.items() if key not in own}


def _complete(source: SourceOptions, usual: Data, sensor: Sensor) -> Described:
    """A set of scans with all fields of its reading: its own, else `usual`, else the defaults of
    its kind.
    """
    if isinstance(source, PartOptions) and source.sensor:
        sensor = build_sensor(**source.sensor)
    scans = Described(source.name, source)
    reading = {
        "projection": "spherical",
        "convention": "centre",
        "on_bad_scan": "error",
        "reflectance_scale": scans.scale(sensor.reflectance_scale),
        **usual,
        **source.chosen,
    }
    if scans.made_here:
        reading["reflectance_scale"] = scans.written_scale
    return scans.part(reading=ReadingOptions(**reading))


def _parts(run: DataOptions, sensor: Sensor) -> list[Described]:
    if not run.parts:
        example = (
            "[{name: kitti_360, root: FOLDER, weight: 3}, {name: folder, root: FOLDER, weight: 1}]"
        )
        raise InputError(f"data=mixed needs its parts: data.parts='{example}'.")
    parts: list[PartOptions] = []
    for number, given in enumerate(run.parts):
        part = {"scenes": run.scenes, **given}
        if part.get("sensor") is not None:
            part["sensor"] = sensor_options(part["sensor"])
        parts.append(_checked_set(f"data.parts[{number}]", PartOptions, part, run))
    if len({part.weight is None for part in parts}) > 1:
        raise InputError("data.parts: give every part a weight, or none, for shares by size.")
    return [_complete(part, run.chosen, sensor) for part in parts]


def _held_out(run: DataOptions, other: Mapping[str, Any], sensor: Sensor) -> Described:
    held = {"name": run.name, "root": run.root, "split": None, "scenes": run.scenes, **other}
    usual = run.chosen
    if held["name"] != run.name:
        usual = _without_scale(usual)
        held["root"] = other.get("root")
    return _complete(_checked_set("data.validation.data", SourceOptions, held, run), usual, sensor)


def _checked_set(
    what: str, kind: type[Options], options: Mapping[str, Any], run: DataOptions
) -> Options:
    """One set of scans. Refuses a data set with a standard split of which no part is named."""
    source = construct(what, kind, options)
    if options.get("name") in (None, MIXED, PAIRS):
        raise InputError(f"{what} needs the name of a data set, found {options.get('name')!r}.")
    splits = ", ".join(SOURCES[source.name].splits)
    if splits and "split" not in options:
        raise InputError(
            f"{what}: {source.name} has a standard split: give split, one of {splits}, or null for "
            "all."
        )
    _refuse_ignored(what, source)
    of_files = isinstance(SOURCES[source.name], Layout | Prepared)
    if of_files and options.get("scenes") not in (None, run.scenes):
        raise InputError(f"{what}.scenes does nothing for {source.name} scans: leave it out.")
    return source


def _refuse_ignored(what: str, options: SourceOptions) -> None:
    for key in IGNORED.get(options.name, ()):
        if getattr(options, key) is not None:
            raise InputError(f"{what}.{key} does nothing for {options.name} scans: leave it out.")


def lacking_reflectance(sets: Sequence[Described]) -> str | None:
    """Reason why one of some sets of scans counts as scans without reflectance; None if all have
    reflectance.
    """
    reasons = (one.kind.lacks_reflectance(one, one.options.chosen["on_bad_scan"]) for one in sets)
    return next(filter(None, reasons), None)


def check_intensities(plan: DataPlan) -> None:
    """Look at the first scan of each set of files, before any work.

    Raises:
        InputError: its reflectance goes beyond the scale that training would divide it by.
    """
    for scans in filter(None, (*plan.sets, plan.held_out, plan.scans)):
        reading = scans.options.reading
        checked = isinstance(scans.kind, Layout) and scans.options.folder.is_dir()
        if checked and reading and reading.on_bad_scan != "skip":
            for points in readable(scans.paths[:1], reading.columns):
                if points.reflectance is not None:
                    scaled_reflectance(scans.paths[0], points, reading.reflectance_scale)


def reflectance_levels(sets: Sequence[Described]) -> int | None:
    """The levels of reflectance that all of some sets share; None if they differ or are unknown."""
    levels = {one.kind.levels_of(one) for one in sets}
    return levels.pop() if len(levels) == 1 else None
