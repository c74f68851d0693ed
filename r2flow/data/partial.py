"""Scans of any sensor as what is known of a model's images: for `r2flow complete`.

scans, said = open_partial(["scans"], reading_of_flow(flow))
scans[0].read()         image, state, xyz
"""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from r2flow.data.opening import SAMPLES, SOURCES, open_scans, own_reading, parse, usual_scale
from r2flow.data.options import PREPARED, SIMULATED
from r2flow.data.reading import Reading, nothing_in_view
from r2flow.data.sources import LOOKED_AT, ScanSource, spread
from r2flow.errors import InputError, naming
from r2flow.lidar.beams import full_reflectance, other_sensor
from r2flow.lidar.scan_files import Points, read_numbers, read_points, read_range_image, scan_ending
from r2flow.lidar.sensors import Sensor
from r2flow.lidar.transfer import (
    Fired,
    Partial,
    firing_of,
    image_of_same,
    image_through,
    points_of_same,
    points_through,
    rows_of,
)

FEWER = 0.9  # of the columns: a turn of fewer rays leaves pixels between them
FEW = 4  # simulated scans, where nobody says how many


@dataclass(frozen=True)
class PartialScan:
    """A scan that is read when its turn comes.

    Attributes:
        name: What its answers are called, without an ending: its path below the folder that was named.
        ending: Of its file; `.npy` of an image.
        read: What is known of it.
        path: Its file; None where it has none of its own.
        image: Whether it is a range image, as its answers are then, or points.
        content: What it holds, where it has no file and its name does not tell.
    """

    name: str
    ending: str
    read: Callable[[], Partial]
    path: Path | None = None
    image: bool = True
    content: Callable[[], bytes] | None = None

    def identity(self) -> str:
        """What tells its answers from those to another scan of this name: a hash of what it holds."""
        content = self.path.read_bytes if self.path else self.content
        return hashlib.sha256(content()).hexdigest()[:16] if content else self.name


def open_partial(
    specs: Sequence[str],
    reading: Reading,
    source: Sensor | None = None,
    scale: float | None = None,
    most: int | None = None,
) -> tuple[list[PartialScan], list[str]]:
    """The scans that names stand for (`open_scans`), none of them read yet but for some that tell their sensor.

    A scan of the model's own sensor is measured everywhere. Of another sensor's, the rows are measured that its beams
    look into: those of `source`, else of the sensor that samples and prepared scans name, else the beams that are found
    in the scans.

    Args:
        reading: How the model's training scans became images.
        source: The sensor of the scans, where it is known.
        scale: The value in scan files that means full reflectance; the usual one if left out.
        most: The most scans of each name, evenly spread; all of them, and `FEW` simulated ones, if left out.

    Returns:
        The scans, and a line for each place with scans of another sensor.

    Raises:
        InputError: no scan, one that cannot be read, or a sensor that cannot be told.
    """
    found: list[PartialScan] = []
    said: list[str] = []
    groups: dict[tuple[Path, str], list[Path]] = {}  # files that are named one by one, by their folder
    for spec in specs:
        options, file = parse(str(spec))
        if options.name in (SIMULATED, PREPARED):
            found += _images(str(spec), reading, source, most, said)
        elif file is not None:
            groups.setdefault((file.parent, ""), []).append(file)
        else:
            paths = [Path(path) for drive in SOURCES[options.name].find_drives(options) for path in drive.scans]
            chosen = [paths[number] for number in spread(len(paths), most or len(paths))]
            groups[Path(options.folder).expanduser(), str(spec)] = chosen
    for (folder, spec), paths in groups.items():
        found += _files(folder, paths, spec or str(paths[0]), reading, source, scale, said)
    if not found:
        raise InputError("no scan is named; give scan files, range images, folders of them or simulated:SEED.")
    twice = [name for name, count in Counter(scan.name for scan in found).items() if count > 1]
    if twice:
        raise InputError(f"two of the scans are called {twice[0]}, and so would be their answers: complete them apart.")
    return found, said


def _files(
    folder: Path,
    paths: list[Path],
    spec: str,
    reading: Reading,
    source: Sensor | None,
    scale: float | None,
    said: list[str],
) -> list[PartialScan]:
    """Scan files of one sensor."""
    target = reading.sensor
    noted = own_reading(folder) if (folder / SAMPLES).is_file() else None
    source = source or (noted.sensor if noted else None)
    images = {path for path in paths if _is_image(path)}
    read: Callable[[Path], Partial] = partial(_read_image, source=source, target=target)
    by_points = read
    if points := [path for path in paths if path not in images]:
        some = [read_points(points[number], reading.columns) for number in spread(len(points), LOOKED_AT)]
        doubt = None if source else other_sensor(some, target)
        same = _same_view(source, target) if source else doubt is None
        fired = firing_of(some, source or target) if same else _firing(spec, some, source)
        if same and fired.steps >= FEWER * target.columns:
            full = scale or (1.0 if noted else usual_scale(spec, source or target))
            by_points = partial(_read_same, reading=reading, scale=full)
        else:
            known = 1.0 if noted else source and source.reflectance_scale
            full = scale or known or full_reflectance(some) or 1.0
            by_points = partial(_read_other, reading=reading, fired=fired, scale=full, strict=scale is not None)
            name = source.name if source else (doubt and doubt.name) or "a sensor"
            said.append(_described(spec, fired.elevations, name, target, fired.steps))
    elif source and not _same_image(source, target):
        said.append(_described(spec, np.asarray(source.elevations), source.name, target))
    return [
        PartialScan(_name(path, folder), _ending(path), partial(read, path), path)
        if path in images
        else PartialScan(_name(path, folder), _ending(path), partial(by_points, path), path, image=False)
        for path in paths
    ]


def _images(spec: str, reading: Reading, source: Sensor | None, most: int | None, said: list[str]) -> list[PartialScan]:
    """Simulated and prepared scans, by their numbers in the whole set."""
    target, how = reading.sensor, own_reading(spec)
    simulated = how is None
    how = how or replace(reading, sensor=source or target)
    opened = open_scans(spec, how, num=(most or FEW) if simulated else None)
    scans = opened.source
    if not _same_image(how.sensor, target):
        said.append(_described(spec, np.asarray(how.sensor.elevations), how.sensor.name, target))
    kind = spec.replace(":", "-") if simulated else Path(spec).name
    return [
        PartialScan(
            f"{kind}-{number:06d}",
            ".npy",
            partial(_read_set, scans, number, how.sensor, target),
            content=None if simulated else partial(_content, scans, number),
        )
        for number in spread(len(scans), most or len(scans))
    ]


def _firing(spec: str, some: list[Points], source: Sensor | None) -> Fired:
    try:
        return firing_of(some, source)
    except InputError as error:
        raise InputError(f"{spec}: the sensor of the scans is not known, name it by --from: {error}") from None


def _described(spec: str, elevations: np.ndarray, name: str, target: Sensor, steps: float = math.inf) -> str:
    """In a line: the sensor, how many rows it measures, what is left out.

    Raises:
        InputError: no beam looks into the model's view.
    """
    rows = rows_of(elevations, target)
    beams = f"{name} with {len(elevations)} beams from {elevations[0]:+.1f} to {elevations[-1]:+.1f} degrees"
    if not (rows >= 0).any():
        edges = target.row_edges
        raise InputError(
            f"{spec}: {beams}, none of which looks into the view of the model's sensor {target.name}, {edges[0]:+.1f} "
            f"to {edges[-1]:+.1f} degrees."
        )
    measured = f"{len(set(rows[rows >= 0]))} of the {target.shape[0]} rows of {target.name} are measured"
    beyond = f"{int((rows < 0).sum())} beams look past its view and are left out"
    turn = f", in the columns that its {steps:.0f} rays a turn meet" if steps < FEWER * target.columns else ""
    return f"{spec}: {beams}; {measured}{turn}" + (f", {beyond}" if (rows < 0).any() else "")


def _read_same(path: Path, reading: Reading, scale: float) -> Partial:
    points = read_points(path, reading.columns)
    if reading.projection == "unfolding":
        points = points.with_lost_rays()
    strength = _strength(path, points, scale, strict=True)
    with naming(path):
        seen = points_of_same(points, reading.sensor, reading.projection, reading.convention, strength)
    return _shown(path, points, reading.sensor, seen)


def _read_other(path: Path, reading: Reading, fired: Fired, scale: float, strict: bool) -> Partial:
    points = read_points(path, reading.columns)
    strength = _strength(path, points, scale, strict)
    with naming(path):
        seen = points_through(points, fired, reading.sensor, strength)
    return _shown(path, points, reading.sensor, seen)


def _shown(path: Path, points: Points, target: Sensor, seen: Partial) -> Partial:
    if not seen.image[0].any():
        raise nothing_in_view(path, points, target)
    return seen


def _read_image(path: Path, source: Sensor | None, target: Sensor) -> Partial:
    image = read_range_image(path)
    assert image is not None
    stored = read_numbers(path)
    if not np.isfinite(stored).all():
        raise InputError(
            f"{path} holds NaN or infinite values: give 0 where nothing came back, and say by --mask FILE.npy what "
            "was not measured."
        )
    if stored.min() < 0 or stored[1:].max(initial=0) > 1:
        found = ", ".join(f"{channel.min():g} to {channel.max():g}" for channel in stored)
        raise InputError(
            f"{path} must hold ranges in metres, of 0 or more, and reflectances of [0, 1]; found {found}. Divide the "
            "reflectances by what means full reflectance."
        )
    found = "x".join(map(str, image.shape[1:]))
    if source is not None and image.shape[1] == source.shape[0]:
        return _seen(image, source.resized(columns=image.shape[2]), target)
    if source is not None or image.shape[1:] != target.shape:
        wanted = "x".join(map(str, target.shape))
        advice = f"--from {source.name} has {source.shape[0]} rows" if source else "name its sensor by --from"
        raise InputError(f"{path} is a range image of {found}, those of the model are {wanted}: {advice}.")
    r = image[0]
    if r.any() and not ((r >= target.min_range) & (r <= target.max_range)).any():
        raise InputError(
            f"{path}: none of its ranges lies within {target.min_range:g}-{target.max_range:g} m, found "
            f"{r[r > 0].min():g} to {r.max():g}. Are they metres?"
        )
    return image_of_same(image, target)


def _read_set(scans: ScanSource, number: int, source: Sensor, target: Sensor) -> Partial:
    return _seen(scans[number], source, target)


def _content(scans: ScanSource, number: int) -> bytes:
    return scans[number].tobytes()


def _seen(image: np.ndarray, source: Sensor, target: Sensor) -> Partial:
    return image_of_same(image, target) if _same_image(source, target) else image_through(image, source, target)


def _strength(path: Path, points: Points, scale: float, strict: bool) -> np.ndarray | None:
    """Reflectance of [0, 1]; None where a file has none, or 0 throughout."""
    if points.reflectance is None or not points.reflectance.any():
        return None
    scaled = points.reflectance / np.float32(scale)
    if strict and not (float(scaled.max()) <= 1 + 1e-3 and float(scaled.min()) >= 0):
        raise InputError(
            f"{path}: reflectance must lie in [0, {scale:g}], found up to {points.reflectance.max():g}. Say what means "
            "full reflectance there, often 255: --reflectance-scale 255."
        )
    return scaled.clip(0, 1)


def _same_view(source: Sensor, target: Sensor) -> bool:
    if source.shape[0] < target.shape[0]:
        return False
    try:
        return bool(np.allclose(source.resized(target.shape[0]).elevations, target.elevations, atol=1e-3))
    except InputError:
        return False


def _same_image(source: Sensor, target: Sensor) -> bool:
    return source.shape == target.shape and bool(np.allclose(source.elevations, target.elevations, atol=1e-3))


def _is_image(path: Path) -> bool:
    return path.suffix.lower() == ".npy" and read_range_image(path) is not None


def _ending(path: Path) -> str:
    return scan_ending(path.name) or path.suffix


def _name(path: Path, folder: Path) -> str:
    below = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.name)
    return str(below.with_name(below.name[: len(below.name) - len(_ending(path))]))
