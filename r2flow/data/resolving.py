"""Fill in the defaults of a run's `data`."""

import logging
from collections.abc import Mapping
from typing import Any

from r2flow.data.opening import SOURCES, Layout, Prepared, scale_of
from r2flow.data.options import FOLDER, MIXED, PAIRS, SIMULATED, Data, DataOptions, PartOptions, SourceOptions
from r2flow.data.reading import AUTO
from r2flow.data.sources import made_here
from r2flow.errors import InputError, check
from r2flow.lidar.sensors import ENDINGS, build_sensor, options_of_sensor, read_sensor
from r2flow.registry import check_options, construct

log = logging.getLogger(__name__)


def resolve(data: Mapping[str, Any], scale: float | None = None, parent: Mapping[str, Any] | None = None) -> Data:
    """Fill in the defaults of a run's `data`: every `reading` gets all fields of `ReadingOptions`, and parts and
    held-out scans inherit missing keys of the run, except split and drives.

    `scale` is the value of full reflectance in files of the sensor; `parent` the reading of the run that this run
    starts from, or of the flow that draws its pairs.
    """
    run = construct("data", DataOptions, data)
    inherited = parent or () if run.name == PAIRS else ("projection", "convention")
    reading = {**{key: parent[key] for key in inherited if parent and parent.get(key) is not None}, **run.chosen}

    def whole(options: Mapping[str, Any], usual: Mapping[str, Any]) -> Data:
        sensor = options.get("sensor")
        own = scale if sensor is None else build_sensor(**sensor).reflectance_scale
        return {**options, "reading": _whole_reading(PartOptions(**options), usual, own)}

    data = {**data, "reading": _whole_reading(run, reading, scale)}
    if run.name == MIXED:
        data["parts"] = [whole(part, reading) for part in _checked_parts(run)]
    if run.scans is not None:
        _check_set("data.scans", SourceOptions, run.scans, run)
        data["scans"] = whole(run.scans, {key: reading[key] for key in reading.keys() & {"projection", "convention"}})
    other = run.validation_options.data
    if other is not None and run.name != PAIRS:
        held = {"name": run.name, "root": run.root, "split": None, "scenes": run.scenes, **other}
        if held["name"] != run.name:  # other files, with other columns and scale
            reading = {key: value for key, value in reading.items() if key not in ("columns", "reflectance_scale")}
            held["root"] = other.get("root")
        _check_set("data.validation.data", SourceOptions, held, run)
        data["validation"] = {**data["validation"], "data": whole(held, reading)}
    return data


def _whole_reading(options: SourceOptions, usual: Mapping[str, Any], scale: float | None) -> Data:
    """All fields of `ReadingOptions`: of a set of scans, else of `usual`, else the defaults of its kind."""
    reading: Data = {"projection": "spherical", "convention": "centre", "columns": None, "on_bad_scan": "error"}
    reading["reflectance_scale"] = scale_of(options, scale) if options.name in SOURCES else 1.0
    reading |= {**usual, **options.chosen}
    return {**reading, "reflectance_scale": 1.0} if options.name == FOLDER and made_here(options.folder) else reading


def _checked_parts(run: DataOptions) -> list[Data]:
    if not run.parts:
        example = "[{name: kitti_360, root: FOLDER, split: train, weight: 3}, {name: folder, root: FOLDER, weight: 1}]"
        raise InputError(f"data=mixed needs its parts: data.parts='{example}'.")
    parts: list[Data] = [{"scenes": run.scenes, **part} for part in run.parts]
    for number, part in enumerate(parts):
        if isinstance(name := part.get("sensor"), str):
            part["sensor"] = options_of_sensor(read_sensor(name)) if name.lower().endswith(ENDINGS) else {"name": name}
        _check_set(f"data.parts[{number}]", PartOptions, part, run)
        if part.get("sensor") is not None:
            check_options(f"data.parts[{number}].sensor", build_sensor, part["sensor"])
    if len({part.get("weight") is None for part in parts}) > 1:
        raise InputError("data.parts: give every part a weight, or none, for shares by size.")
    return parts


def _check_set(what: str, kind: type[SourceOptions], options: Mapping[str, Any], run: DataOptions) -> None:
    """Refuse options that do not name a single set of scans, lack the split of a standard data set, or are ignored."""
    check_options(what, kind, options)
    name: Any = options.get("name")
    check(name not in (None, MIXED, PAIRS), f"{what} needs the name of a data set, found {name!r}.")
    source, splits = SOURCES[name], ", ".join(SOURCES[name].splits)
    unread: dict[str, Any] = {"scenes": run.scenes} if isinstance(source, Layout | Prepared) else {}  # with its default
    unread = dict.fromkeys(("root", "split", "drives")) if name == SIMULATED else unread
    wrong = ", ".join(f"{what}.{key}" for key, usual in unread.items() if options.get(key) not in (None, usual))
    check(not wrong, f"simulated scans are not files, and files no simulated scenes: leave {wrong} out.")
    if splits and "split" not in options:
        raise InputError(f"{what}: {name} has a standard split: give split, one of {splits}, or null for all.")


def resolve_reflectance(wanted: Any, data: Mapping[str, Any]) -> bool:
    """`encoding.reflectance` for a config's `data`: `auto` is true if all its sets of scans have reflectance."""
    if isinstance(wanted, bool):
        return wanted
    check(wanted == AUTO, f"encoding.reflectance must be true, false or auto, found {wanted!r}.")
    run = DataOptions(**resolve(data))
    for options in filter(None, (*run.sets, run.held_out)):
        if lacking := SOURCES[options.name].lacks_reflectance(options, options.chosen["on_bad_scan"]):
            log.info("range alone is learned (encoding.reflectance=auto): %s", lacking)
            return False
    log.info("the scans have reflectance, which is learned too (encoding.reflectance=auto)")
    return True


def reflectance_levels(data: Mapping[str, Any]) -> int | None:
    """The levels of reflectance that all sets of a config's `data` share; None if they differ or are unknown."""
    levels = {SOURCES[options.name].levels_of(options) for options in DataOptions(**resolve(data)).sets}
    return levels.pop() if len(levels) == 1 else None
