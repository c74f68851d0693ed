"""Fill in the defaults of a run's `data`, once."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, construct
from r2flow.data.described import Described
from r2flow.data.kinds import SOURCES, Layout
from r2flow.data.options import (
    MIXED,
    PAIRS,
    SIMULATED,
    DataOptions,
    PartOptions,
    ReadingOptions,
    SourceOptions,
)
from r2flow.data.reflectance import scaled_reflectance
from r2flow.data.sensor_checks import readable
from r2flow.lidar.sensors import Sensor, build_sensor, sensor_options

Source = TypeVar("Source", bound=SourceOptions)

# Options that a kind of scans would ignore.
_IGNORED = {
    SIMULATED: ("root", "split", "drives"),
    PAIRS: ("split", "drives"),
    MIXED: ("split", "drives"),
}


@dataclass(frozen=True)
class DataPlan:
    """The sets of scans of a run, complete: each reading and sensor has all its options."""

    sets: Sequence[Described]  # to train on, with `PartOptions`; empty for pairs
    sensors: Sequence[Sensor]  # of each of `sets`
    weights: Sequence[float]  # likewise; empty: shares by size
    held_out: Described | None  # to validate on; None: a share of `sets`
    scans: Described | None  # next to pairs

    @property
    def all(self) -> list[Described]:
        return [*self.sets, *filter(None, (self.held_out, self.scans))]


def plan_data(options: DataOptions, sensor: Sensor, seed: int = 0) -> DataPlan:
    """The sets of scans of a run's `data`, on a sensor; `seed` is that of simulated scans.

    Parts and held-out scans inherit missing keys of the run, except split and drives.

    Raises:
        InputError: an unknown data set or option, or one that would be ignored.
    """
    _refuse_ignored("data", options)
    inherited = options.reading_fields
    parts: list[PartOptions] = []
    if options.name == MIXED:
        parts = _parts(options)
    elif options.name != PAIRS:
        single = {field.name: getattr(options, field.name) for field in fields(SourceOptions)}
        parts = [PartOptions(**single)]
    sensors = [build_sensor(**part.sensor) if part.sensor else sensor for part in parts]
    weights = [part.weight for part in parts if part.weight is not None]
    sets = [_complete(*part, inherited) for part in zip(parts, sensors, strict=True)]
    held_out = None
    if options.validation.data is not None:
        if options.name == PAIRS:
            raise InputError("data.validation.data cannot be held out from pairs; leave it out.")
        held_out = _held_out(options, options.validation.data, sensor)
    scans = None
    if options.scans is not None:
        beside = _checked_set("data.scans", SourceOptions, options.scans)
        scans = _complete(beside, sensor, _of_other_files(inherited))
    plan = DataPlan(sets, sensors, weights, held_out, scans)
    first_scene = 0  # parts and held-out scans have different simulated scenes
    for one in plan.all:
        one.seed = seed
        one.first_scene = first_scene
        first_scene += one.options.scenes if one.options.name == SIMULATED else 0
    return plan


def _of_other_files(reading: Config) -> Config:
    """What a reading says of other files, too, with other columns and scale."""
    of_files = ("columns", "reflectance_scale")
    return {key: value for key, value in reading.items() if key not in of_files}


def _complete(source: SourceOptions, sensor: Sensor, inherited: Config) -> Described:
    """A set of scans with all fields of its reading: its own, else `inherited`, else the defaults
    of its kind.
    """
    scans = Described(source.name, source)
    reading = {
        "projection": "spherical",
        "convention": "centre",
        "on_bad_scan": "error",
        "reflectance_scale": scans.scale(sensor.reflectance_scale),
        **inherited,
        **source.reading_fields,
    }
    if scans.manifests:
        reading["reflectance_scale"] = scans.written_scale
    scans.options = replace(source, reading=ReadingOptions(**reading))
    return scans


def _parts(run: DataOptions) -> list[PartOptions]:
    if not run.parts:
        example = (
            "[{name: kitti_360, root: FOLDER, weight: 3}, {name: folder, root: FOLDER, weight: 1}]"
        )
        raise InputError(f"data=mixed needs its parts: data.parts='{example}'.")
    parts = []
    for number, part in enumerate(run.parts):
        options = {"scenes": run.scenes, **part}
        if part.get("sensor") is not None:
            options["sensor"] = sensor_options(part["sensor"])
        parts.append(_checked_set(f"data.parts[{number}]", PartOptions, options))
    if len({part.weight is None for part in parts}) > 1:
        raise InputError("data.parts: give every part a weight, or none, for shares by size.")
    return parts


def _held_out(run: DataOptions, other: Options, sensor: Sensor) -> Described:
    inherited = run.reading_fields
    root = run.root
    if other.get("name", run.name) != run.name:
        inherited = _of_other_files(inherited)
        root = None
    options = {"name": run.name, "root": root, "split": None, "scenes": run.scenes, **other}
    held = _checked_set("data.validation.data", SourceOptions, options)
    return _complete(held, sensor, inherited)


def _checked_set(what: str, kind: type[Source], options: Options) -> Source:
    """One set of scans. Refuses a data set with a standard split of which no part is named."""
    source = construct(what, kind, options)
    name = options.get("name")
    if name in (None, MIXED, PAIRS):
        raise InputError(f"{what} needs the name of a data set, found {name!r}.")
    splits = ", ".join(SOURCES[source.name].splits)
    if splits and "split" not in options:
        raise InputError(
            f"{what}: {source.name} has a standard split: give split, one of {splits}, or null for "
            "all."
        )
    _refuse_ignored(what, source)
    return source


def _refuse_ignored(what: str, options: SourceOptions) -> None:
    for key in _IGNORED.get(options.name, ()):
        if getattr(options, key) is not None:
            raise InputError(f"{what}.{key} does nothing for {options.name} scans: leave it out.")


def lacking_reflectance(sets: Sequence[Described]) -> str | None:
    """Reason why one of some sets of scans counts as scans without reflectance; None if all have
    reflectance.
    """
    for scans in sets:
        reading = scans.options.reading
        if reading and (lacking := scans.kind.lacks_reflectance(scans, reading)):
            return lacking
    return None


def check_intensities(plan: DataPlan) -> None:
    """Look at the first scan of each set of files, before any work.

    Raises:
        InputError: its reflectance goes beyond the scale that training would divide it by.
    """
    for scans in plan.all:
        reading = scans.options.reading
        checked = isinstance(scans.kind, Layout) and scans.options.folder.is_dir()
        if checked and reading and reading.on_bad_scan != "skip":
            for path, points in readable(scans.paths[:1], reading.columns).items():
                if points.reflectance is not None:
                    scaled_reflectance(path, points, reading.reflectance_scale)


def reflectance_levels(sets: Sequence[Described]) -> int | None:
    """The levels of reflectance that all of some sets share; None if they differ or are unknown."""
    levels = {one.kind.levels_of(one) for one in sets}
    return levels.pop() if len(levels) == 1 else None
