"""Whether scan files are of the sensor that they are read as."""

import logging
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from r2flow.base.errors import InputError, check, warn_odd
from r2flow.data.reading import Reading
from r2flow.data.sources import spread
from r2flow.lidar.estimation import hangs
from r2flow.lidar.matching import Doubt, differing, in_words, is_unclear, other_sensor
from r2flow.lidar.scan_files import Points, read_points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.turns import SEVERAL, turns
from r2flow.store import MANIFEST

if TYPE_CHECKING:
    from r2flow.data.described import Described

_log = logging.getLogger(__name__)

_File = TypeVar("_File", str, Path)


def a_few(paths: Sequence[_File]) -> list[_File]:
    """At most three of some files, evenly spread, whose beams are looked at."""
    return [paths[number] for number in spread(len(paths), 3)]


def readable(paths: Sequence[_File], columns: Sequence[str] | None) -> dict[_File, Points]:
    """The points of the files that hold points, by path; others are reported when they are read as
    scans.
    """
    points = {}
    for path in paths:
        with suppress(InputError):
            points[path] = read_points(path, columns)
    return points


def mismatch_of(scans: "Described", reading: Reading) -> Doubt | None:
    """The mismatch of a few scan files and a sensor (`other_sensor`); warns instead of one due to
    their frame.

    Files that r2flow wrote store their sensor; other range images have no beams.

    Raises:
        InputError: they are of two sensors.
    """
    for manifest in scans.manifests:
        stored = Reading.stored(manifest)
        if stored and (doubt := _other_than(stored.sensor, reading.sensor)):
            return doubt
    points = {} if scans.manifests else readable(a_few(scans.paths), reading.columns)
    if not points:
        return None
    mismatch = other_sensor([*points.values()], reading.sensor)
    if mismatch and mismatch.hopeless:
        return mismatch
    unclear = warn_of_frame(points)
    return None if unclear and not (mismatch and mismatch.sure) else mismatch


def _other_than(stored: Sensor, sensor: Sensor) -> Doubt | None:
    """The mismatch of the sensor in a manifest and another one."""
    known = stored.name in SENSORS
    if known and stored.name == sensor.name and stored.shape[0] >= sensor.shape[0]:
        return None  # rows of rows are nearly the rows of the sensor
    if stored.resized(*sensor.shape).same_image(sensor):
        return None
    return Doubt(f"{MANIFEST} names {stored}", stored.name if known else None, sure=known)


def warn_of_frame(scans: Mapping[Any, Points], named: bool = False) -> bool:
    """Warn, once per folder, of scans (by path) not in one sensor's own frame; whether they are
    not.

    Warns of files of several turns, too. Scans of two sensors are an InputError, unless the sensor
    is `named`.
    """
    points = [*scans.values()]
    path = Path(next(iter(scans)))
    if any(turns(scan) > SEVERAL for scan in points):
        warn_odd(path, "a file holds several turns of the sensor; a scan is one: split it")
    if hangs(points):
        warn_odd(
            path,
            "the ground lies above the sensor: if it hangs upside down, negate y and z of the "
            "points; models expect z upwards",
        )
    if pair := differing(points):
        seen = " and ".join(f"{[*scans][n]} ({in_words(beams)})" for n, beams in pair)
        check(named, f"{seen} are of two sensors: give the scans of each by themselves.")
        warn_odd(path, f"read as scans of one sensor, but {seen} are of two: read them apart")
        return True
    unclear = is_unclear(points)
    if unclear:
        warn_odd(
            path,
            "its beams are not clear: give scans of one sensor, in its own frame, not a vehicle's",
        )
    return unclear


def warn_of_other_sensor(scans: "Described", reading: Reading) -> None:
    """Warn if scan files do not match a sensor (`mismatch_of`), and name the sensor that matches.

    Raises:
        InputError: they are of two sensors, or for a training have no beams.
    """
    sensor = reading.sensor
    mismatch = mismatch_of(scans, reading)
    if mismatch is None or mismatch.finer:
        return
    place = scans.file or scans.options.folder
    check(not (mismatch.hopeless and reading.within_limits), f"{place}: {mismatch.seen}.")
    name = mismatch.name
    advice = ""
    if name is not None and name != sensor.name:
        advice = (
            f"; they fit '{name}': sensor={name} in training, --sensor {name} in verbs that have it"
        )
    elif not mismatch.hopeless:
        estimate = f"r2flow sensor {shlex.quote(str(place))} --out mine.yaml"
        advice = f"; give the right one, or estimate it: {estimate}"
    _log.warning(
        "%s: read as scans of sensor '%s', which sees %+.1f to %+.1f degrees, but %s%s",
        place, sensor.name, *sensor.row_edges[[0, -1]], mismatch.seen, advice,
    )  # fmt: skip
