"""Scans of any sensor as partially measured images of a model's sensor, for `r2flow complete`."""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from r2flow.base.errors import InputError, naming, warn_odd
from r2flow.data.opening import Described, describe, open_scans
from r2flow.data.options import FOLDER, PREPARED, SIMULATED
from r2flow.data.partial_images import FROM, is_image, read_partial
from r2flow.data.reading import DIVIDED, Reading, nothing_in_view, reflectance_and_scale
from r2flow.data.sources import LOOKED_AT, spread, warn_of_frame
from r2flow.lidar.beams import check_rings
from r2flow.lidar.estimation import FULL_REFLECTANCE, SURE, full_reflectance
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import common_classes, labels_beside, read_labels
from r2flow.lidar.matching import other_sensor
from r2flow.lidar.other_sensors import (
    Partial,
    image_through,
    points_of_same,
    points_through,
    rows_of,
    sensor_of,
)
from r2flow.lidar.scan_files import (
    Points,
    points_beside,
    points_of,
    read_cloud,
    scan_ending,
)
from r2flow.lidar.sensors import SENSORS, Sensor

# with less than this share of rays per column, pixels between the rays are not measured
FEWER = 0.9
FEW = 4  # default number of simulated scans
THROUGH = "in Python Checkpoint.through of such a sensor, uses them with densify"

Sight = Callable[[Path, Points], Partial]  # the image of the points of a scan of this name
Opened = tuple[list["PartialScan"], list[str]]  # scans, and lines about their sensors


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
    specs: Sequence[str],
    reading: Reading,
    source: Sensor | None = None,
    scale: float | None = None,
    most: int | None = None,
) -> Opened:
    """Open the scans of some names (`open_scans`). Scans are read on demand, except a few to
    determine their sensor.

    A scan of the model's sensor is measured everywhere. A scan of another sensor is measured in the
    rows that contain
    its beams: of prepared scans those of the sensor stored with them, of others those of `source`,
    else of the sensor stored with samples, else an estimate from the scans.

    Args:
        reading: How the model's training scans became images.
        scale: The value in scan files that means full reflectance; None: the default.
        most: Maximum number of scans per name, evenly spread; None: all scans, or `FEW` simulated
            scans.
    """
    opened: list[Opened] = []
    files: dict[Path, list[Described]] = {}  # by their folder
    for spec in specs:
        scans = describe(spec)
        if scans.options.name in (SIMULATED, PREPARED):
            opened.append(_images(scans, reading, source, most))
        elif scans.file is not None:
            files.setdefault(scans.file.parent, []).append(scans)
        else:
            count = len(scans.paths)
            paths = [
                points_beside(Path(scans.paths[number])) for number in spread(count, most or count)
            ]
            opened.append(_files(scans, paths, reading, source, scale))
    for together in files.values():
        paths = [one.file for one in together if one.file]
        opened.append(_files(together[0], paths, reading, source, scale))
    partial_scans = [scan for some, _ in opened for scan in some]
    if duplicates := [
        name for name, count in Counter(scan.name for scan in partial_scans).items() if count > 1
    ]:
        raise InputError(
            f"two of the scans would have answers called {duplicates[0]}: complete them apart."
        )
    return partial_scans, [line for _, lines in opened for line in lines]


def _files(
    described: Described,
    paths: list[Path],
    reading: Reading,
    source: Sensor | None,
    scale: float | None,
) -> Opened:
    target = reading.sensor
    lines: list[str] = []
    stored = described.stored
    folder = described.options.folder
    spec = described.label
    named = source
    source = source or (stored.sensor if stored else None)
    whole = None
    full = 1.0
    images = {path for path in paths if path.suffix.lower() == ".npy" and is_image(path)}
    read_image: Callable[[Path], Partial] = partial(
        read_partial,
        source=source,
        target=target,
        ids=reading.label_ids if reading.labels else None,
    )
    by_points = read_image
    if points := [path for path in paths if path not in images]:
        chosen = [points[number] for number in spread(len(points), LOOKED_AT)]
        scans = {path: measured_points(path, reading.columns) for path in chosen}
        again = any(scan.cloud and scan.cloud.place("measured") for scan in scans.values())
        seen = sight(described, scans, reading, named if again else source, scale)
        lines, whole, full = seen.lines, seen.whole, seen.scale or 1.0
        by_points = lambda path: seen.see(path, measured_points(path, reading.columns))  # noqa: E731
    elif source and not source.same_image(target):
        lines += _described(spec, source, target)
        whole = seeing_all(source, target)

    def opened(path: Path) -> PartialScan:
        ending = scan_ending(path.name) or path.suffix
        below = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.name)
        name = str(below)[: len(str(below)) - len(ending)]
        read = partial(read_image if path in images else by_points, path)
        content = path.read_bytes
        return PartialScan(name, ending, read, content, path, path in images, whole, full)

    return [opened(path) for path in paths], lines


def measured_points(path: Path, columns: Sequence[str] | None) -> Points:
    """The points of a file that a sensor measured, with all their fields."""
    cloud = read_cloud(path, columns)
    measured = cloud.measured()
    if len(measured) < len(cloud):
        warn_odd(path, "points that a completion added are left out", len(cloud) - len(measured))
    return points_of(path, measured)


@dataclass(frozen=True)
class Seeing:
    """How scans of one sensor are seen as images of the model's."""

    see: Sight
    lines: list[str]  # about the sensor
    whole: Sensor | None  # a view that keeps all its beams, if the model's does not
    scale: float | None  # value of full reflectance in the scans; None: of each by itself


def sight(
    described: Described,
    read: Mapping[Path, Points],
    reading: Reading,
    source: Sensor | None,
    scale: float | None = None,
    each: bool = False,
) -> Seeing:
    """How scans of one sensor are seen as images of the model's.

    It is found from a few scans, by path. For the others see `open_partial`. With `each`, the scale
    of reflectance is found for every scan by itself (`own_scale`).
    """
    path = next(iter(read))
    scans = [*read.values()]
    target = reading.sensor
    stored = described.stored
    spec = described.label
    own = SENSORS[target.name] if target.name in SENSORS else target  # noqa: SIM401
    doubt = other_sensor(scans, source or own)
    named = source is not None
    if not source and not doubt and own.shape[0] < target.shape[0]:
        source = own  # fewer beams than rows of the completions
    same = doubt is None
    if source:
        same = source.shape[0] >= target.shape[0] and source.resized(*target.shape).same_image(
            target
        )
    known = source or (target if same else None)
    for file, points in read.items():
        with naming(file):
            check_rings(points)
    odd = bool(stored) or warn_of_frame(read, alike=not named)
    try:
        fired = sensor_of(scans, known)
    except InputError as error:
        raise InputError(
            f"{spec}: the sensor of the scans is not known, name it by {FROM}: {error}"
        ) from None
    if not odd and source and doubt and not doubt.finer:
        fits = f"; they fit {doubt.name}" if doubt.name else ""
        warn_odd(path, f"sensor {source.name} does not fit these scans: {doubt.seen}{fits}")
    of_sensor = known.reflectance_scale if known else None
    usual = described.scale(of_sensor) if described.options.name != FOLDER or of_sensor else 0.0
    written = described.written_scale if stored else None
    full = scale or written or full_reflectance(scans, usual) or usual or 1.0
    if each and not scale:
        full = own_scale(scans[0], of_sensor)
    strict = scale is not None or (full in FULL_REFLECTANCE and not each)
    of_scan = partial(own_scale, usual=of_sensor) if each and not scale else lambda _: full
    as_own = same and fired.columns >= FEWER * target.columns
    fired_by = None if as_own else fired
    see = partial(_seen, reading=reading, fired=fired_by, scale=of_scan, strict=strict)
    lines = []
    whole = None
    if not as_own:
        name = source.name if source else (doubt and doubt.name) or "a sensor"
        lines = _described(spec, replace(fired, name=name), target, turns=True)
        whole = seeing_all(source or fired, target)
    if not (scale or stored) and full != usual and (of_sensor or full not in SURE):
        warn_odd(path, DIVIDED % full)
    return Seeing(see, lines, whole, None if each and not scale else full)


def own_scale(points: Points, usual: float | None = None) -> float:
    """The value of full reflectance of a scan, from its own values alone, so that scans of a stream
    have the same scale whatever came before: `full_reflectance`, but bytes are of 255, since a
    later scan of the same sensor may exceed 100.
    """
    full = full_reflectance([points], usual) or 1.0
    return 255.0 if full == 100 and full != usual else full


def _images(
    described: Described, reading: Reading, source: Sensor | None, most: int | None
) -> Opened:
    """Simulated and prepared scans, named by their number in the whole set."""
    spec = described.label
    target = reading.sensor
    stored = described.stored
    simulated = stored is None
    stored = stored or replace(reading, sensor=source or target)
    scans = open_scans(described, stored, num=(most or FEW) if simulated else None).source
    kind = spec.replace(":", "-") if simulated else Path(spec).name

    def opened(number: int) -> PartialScan:
        name = f"{kind}-{number:06d}"
        content = name.encode if simulated else lambda: scans[number].tobytes()
        return PartialScan(
            name, ".npy", lambda: image_through(scans[number], stored.sensor, target), content
        )

    lines = [] if stored.sensor.same_image(target) else _described(spec, stored.sensor, target)
    return [opened(number) for number in spread(len(scans), most or len(scans))], lines


def seeing_all(source: Sensor, target: Sensor) -> Sensor | None:
    """A sensor with at least the target's rows and with its columns that sees all beams of the
    source, and as near; None if the target sees all beams.
    """
    if (rows_of(source.elevations, target) >= 0).all():
        return None
    beams = len(source.elevations)
    rows = max(target.shape[0], math.ceil(beams / 16) * 16)  # networks halve them four times
    sensor = source.resized(rows, target.columns)
    near = min(source.min_range, target.min_range)
    return replace(sensor, min_range=near, max_range=target.max_range)


def _described(spec: str, source: Sensor, target: Sensor, turns: bool = False) -> list[str]:
    """Lines about the sensor, the number of measured rows, and the lost beams."""
    e = source.elevations
    rows = rows_of(np.asarray(e), target)
    beams = f"{source.name} with {len(e)} beams from {e[0]:+.1f} to {e[-1]:+.1f} degrees"
    if not (rows >= 0).any():
        raise InputError(
            f"{spec}: {beams}, and the model's sensor {target.name} sees "
            f"{target.row_edges[0]:+.1f} to "
            f"{target.row_edges[-1]:+.1f} degrees."
        )
    measured = f"{len(set(rows[rows >= 0]))} of the {target.shape[0]} rows to complete are measured"
    few = turns and source.columns < FEWER * target.columns
    turn = f", in the columns that its {source.columns} rays a turn meet" if few else ""
    lines = [f"{spec}: {beams}; {measured}{turn}"]
    if lost := int((rows < 0).sum()):
        lines.append(
            f"{spec}: {lost} of its {len(e)} beams look past the view of {target.name} and are not "
            "used"
        )
        to = (
            SENSORS[source.name]
            if source.name in SENSORS
            else replace(source, name="FILE (r2flow sensor)")
        )
        lines[-1] += (
            f": --to {to.name} --size {max(target.shape[0], len(e))}x{to.columns}, {THROUGH}"
        )
    return lines


def _seen(
    path: Path,
    points: Points,
    reading: Reading,
    fired: Sensor | None,
    scale: Callable[[Points], float],
    strict: bool,
) -> Partial:
    """The image of points of the model's sensor or, with `fired`, of another sensor."""
    target = reading.sensor
    if fired is None and reading.projection == "unfolding":
        points = points.with_lost_rays()
    strength = None  # reflectance in [0, 1]; None if the file has none, or only 0
    full = 1.0
    if points.reflectance is not None and points.reflectance.any():
        strength, full = reflectance_and_scale(path, points, scale(points), strict)
    with naming(path):
        if fired is None:
            seen = points_of_same(points, target, reading.projection, reading.convention, strength)
        else:
            seen = points_through(points, fired, target, strength)
    if not seen.image[0].any():
        raise nothing_in_view(path, points, target)
    file = labels_beside(path) if reading.labels else None
    if file:
        classes = common_classes(read_labels(file, path, points, reading.label_ids))
        seen = replace(seen, image=_with_classes(seen, points.xyz, classes))
    r = np.linalg.norm(points.xyz, axis=1)
    inside = (r >= target.min_range) & (r <= target.max_range)
    outside = int(np.count_nonzero(r) - inside.sum())
    assert seen.row is not None
    assert seen.place is not None
    numbers = np.arange(len(r)) if points.kept is None else points.kept
    kept = Points(
        points.xyz[inside],
        None if strength is None else strength[inside],
        dropped=outside,
        kept=numbers[inside],
        cloud=points.cloud,
    )
    new = np.cumsum(inside) - 1  # number of each point among the kept ones
    place = np.where(seen.place < 0, -1, new[seen.place])
    return replace(seen, points=kept, row=seen.row[inside], place=place, scale=full)


def _with_classes(seen: Partial, xyz: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """The image of a scan with the class of the point of each pixel, (3, H, W)."""
    image = np.zeros((3, *seen.state.shape), np.float32)
    image[: len(seen.image)] = seen.image
    returned = seen.state == Ray.RETURN
    assert seen.xyz is not None
    image[2, returned] = classes[cKDTree(xyz).query(seen.xyz[:, returned].T)[1]]
    return image
