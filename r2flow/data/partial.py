"""Scans to complete, read on demand, for `r2flow complete`."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

from r2flow.base.errors import InputError, naming, warn_odd
from r2flow.data.described import Described, Spec, describe
from r2flow.data.opening import open_scans
from r2flow.data.options import PREPARED, SIMULATED
from r2flow.data.partial_images import is_image, read_partial
from r2flow.data.reading import Reading
from r2flow.data.seeing import Sight, lines_about, seeing_all, sight
from r2flow.data.sensor_checks import a_few
from r2flow.data.sources import spread
from r2flow.lidar.other_sensors import Partial, image_through
from r2flow.lidar.scan_files import Points, points_beside, points_of, read_cloud, scan_ending
from r2flow.lidar.scan_files.tables import KEPT
from r2flow.lidar.sensors import Sensor

_FEW = 4  # default number of simulated scans

_Opened = tuple[list["PartialScan"], list[str]]  # scans, and lines about their sensors


@dataclass(frozen=True)
class PartialScan:
    """A scan that is read on demand."""

    name: str  # file name of its completions, without ending: its path below the given folder
    ending: str  # ending of its file; `.npy` for an image
    read: Callable[[], Partial]
    content: Callable[[], bytes]
    path: Path | None = None  # its file; None if it has no file
    image: bool = True  # whether it is a range image or points; completions have the same form
    whole: Sensor | None = None  # one that sees all its beams; None: the model's does
    scale: float = 1.0  # value of full reflectance in its file

    def identity(self) -> str:
        """Hash of the content, which distinguishes scans of the same name."""
        return hashlib.sha256(self.content()).hexdigest()[:16]


def open_partial(
    specs: Sequence[Spec],
    reading: Reading,
    source: Sensor | None = None,
    scale: float | None = None,
    most: int | None = None,
) -> _Opened:
    """Open the scans of some names (`describe`). Scans are read on demand, except a few to
    determine their sensor.

    A scan of the model's sensor is measured everywhere. A scan of another sensor is measured in the
    rows that contain its beams: of prepared scans those of the sensor stored with them, of others
    those of `source`, else of the sensor stored with samples, else an estimate from the scans.

    Args:
        reading: How the model's training scans became images.
        scale: The value in scan files that means full reflectance; None: the default.
        most: Maximum number of scans per name, evenly spread; None: all scans, or `_FEW` simulated
            scans.
    """
    opened: list[_Opened] = []
    files: dict[Path, list[Described]] = {}  # by their folder
    for scans in map(describe, specs):
        if scans.options.name in (SIMULATED, PREPARED):
            opened.append(_images(scans, reading, source, most))
        elif scans.file is not None:
            files.setdefault(scans.file.parent, []).append(scans)
        else:
            paths = [points_beside(Path(path)) for path in scans.some(most or len(scans.paths))]
            opened.append(_files(scans, paths, reading, source, scale))
    for together in files.values():
        paths = [one.file for one in together if one.file]
        opened.append(_files(together[0], paths, reading, source, scale))
    partial_scans = [scan for some, _ in opened for scan in some]
    name, count = Counter(scan.name for scan in partial_scans).most_common(1)[0]
    if count > 1:
        raise InputError(f"two of the scans would have answers called {name}: complete them apart.")
    return partial_scans, [line for _, lines in opened for line in lines]


def _files(
    described: Described,
    paths: list[Path],
    reading: Reading,
    source: Sensor | None,
    scale: float | None,
) -> _Opened:
    target = reading.sensor
    stored = described.stored
    folder = described.options.folder
    sensor = source or (stored.sensor if stored else None)
    ids = reading.label_ids if reading.labels else None
    lines: list[str] = []
    whole = None
    full = 1.0
    see: Sight | None = None
    images = {path for path in paths if path.suffix.lower() == ".npy" and is_image(path)}
    if points := [path for path in paths if path not in images]:
        scans = {path: _measured_points(path, reading.columns) for path in a_few(points)}
        again = any(scan.cloud and scan.cloud.place("measured") for scan in scans.values())
        seen = sight(described, scans, reading, source if again else sensor, scale)
        see = seen.see
        lines = seen.lines
        whole = seen.whole
        full = seen.scale or 1.0
    elif sensor and not sensor.same_image(target):
        lines = lines_about(described.label, sensor, target)
        whole = seeing_all(sensor, target)

    def read(path: Path) -> Partial:
        if see is None or path in images:
            return read_partial(path, sensor, target, ids)
        return see(path, _measured_points(path, reading.columns))

    def opened(path: Path) -> PartialScan:
        ending = scan_ending(path.name) or path.suffix
        below = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.name)
        name = str(below)[: len(str(below)) - len(ending)]
        how = partial(read, path)
        return PartialScan(name, ending, how, path.read_bytes, path, path in images, whole, full)

    return [opened(path) for path in paths], lines


def _measured_points(path: Path, columns: Sequence[str] | None) -> Points:
    """The points of a file that a sensor measured, with all their fields."""
    cloud = read_cloud(path, columns)
    with naming(path):
        cloud.check_names()
    measured = cloud.measured()
    if len(measured) < len(cloud):
        warn_odd(path, "points that a completion added are left out", len(cloud) - len(measured))
    return _points(path, measured)


_points = lru_cache(KEPT)(points_of)  # of a cloud that is seen again in its own view


def _images(
    described: Described, reading: Reading, source: Sensor | None, most: int | None
) -> _Opened:
    """Simulated and prepared scans, named by their number in the whole set."""
    target = reading.sensor
    label = described.label
    simulated = described.stored is None
    stored = described.stored or replace(reading, sensor=source or target)
    scans = open_scans(described, stored, num=(most or _FEW) if simulated else None).source
    kind = label.replace(":", "-") if simulated else Path(label).name

    def opened(number: int) -> PartialScan:
        name = f"{kind}-{number:06d}"

        def read() -> Partial:
            return image_through(scans[number], stored.sensor, target)

        content = name.encode if simulated else lambda: scans[number].tobytes()
        return PartialScan(name, ".npy", read, content)

    lines = [] if stored.sensor.same_image(target) else lines_about(label, stored.sensor, target)
    return [opened(number) for number in spread(len(scans), most or len(scans))], lines
