"""Points of any sensor as partially measured images of a model's sensor."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from r2flow.base.errors import InputError, naming, warn_odd
from r2flow.data.described import Described
from r2flow.data.options import FOLDER
from r2flow.data.partial_images import FROM
from r2flow.data.reading import Reading, nothing_in_view
from r2flow.data.reflectance import DIVIDED, scaled_reflectance
from r2flow.data.sensor_checks import warn_of_frame
from r2flow.lidar.beams import check_rings
from r2flow.lidar.estimation import FULL_REFLECTANCE, SURE, full_reflectance
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import common_classes, labels_beside, read_labels
from r2flow.lidar.matching import other_sensor
from r2flow.lidar.other_sensors import Partial, points_of_same, points_through, rows_of, sensor_of
from r2flow.lidar.scan_files import Points
from r2flow.lidar.sensors import SENSORS, Sensor

# with less than this share of rays per column, pixels between the rays are not measured
_FEWER = 0.9
_THROUGH = "in Python Checkpoint.through of such a sensor, uses them with densify"

Sight = Callable[[Path, Points], Partial]  # the image of the points of a scan of this name


@dataclass(frozen=True)
class Seeing:
    """How scans of one sensor are seen as images of the model's."""

    see: Sight
    lines: list[str]  # about the sensor
    whole: Sensor | None  # a view that keeps all its beams, if the model's does not
    scale: float | None  # value of full reflectance in the scans; None: of each by itself


@dataclass(frozen=True)
class _Scale:
    """The value of full reflectance in scans."""

    full: float | None  # None: that of each scan by itself
    of_sensor: float | None
    strict: bool  # whether values beyond are refused, not clipped

    def of(self, points: Points) -> float:
        return self.full or _own_scale(points, self.of_sensor)


def sight(
    described: Described,
    scans: Mapping[Path, Points],
    reading: Reading,
    source: Sensor | None,
    scale: float | None = None,
    each: bool = False,
) -> Seeing:
    """How scans of one sensor are seen as images of the model's.

    It is found from a few scans, by path. For `source` and `scale` see `open_partial`. With `each`,
    the scale of reflectance is found for every scan by itself (`_own_scale`).
    """
    path = next(iter(scans))
    points = [*scans.values()]
    target = reading.sensor
    trained = SENSORS[target.name] if target.name in SENSORS else target  # noqa: SIM401
    doubt = other_sensor(points, source or trained)
    named = source is not None
    if not source and not doubt and trained.shape[0] < target.shape[0]:
        source = trained  # fewer beams than rows of the completions
    same = doubt is None
    if source:
        same = source.shape[0] >= target.shape[0] and source.resized(*target.shape).same_image(
            target
        )
    known = source or (target if same else None)
    for file, scan in scans.items():
        with naming(file):
            check_rings(scan)
    odd = bool(described.stored) or warn_of_frame(scans, named)
    try:
        fired = sensor_of(points, known)
    except InputError as error:
        raise InputError(
            f"{described.label}: the sensor of the scans is not known, name it by {FROM}: {error}"
        ) from None
    if not odd and source and doubt and not doubt.finer:
        fits = f"; they fit {doubt.name}" if doubt.name else ""
        warn_odd(path, f"sensor {source.name} does not fit these scans: {doubt.seen}{fits}")
    of_sensor = known.reflectance_scale if known else None
    full = _scale_of(described, scans, of_sensor, scale, each)
    if same and fired.columns >= _FEWER * target.columns:
        see = partial(_seen, reading=reading, fired=None, scale=full)
        return Seeing(see, [], None, full.full)
    see = partial(_seen, reading=reading, fired=fired, scale=full)
    name = source.name if source else (doubt and doubt.name) or "a sensor"
    lines = lines_about(described.label, replace(fired, name=name), target, turns=True)
    return Seeing(see, lines, seeing_all(source or fired, target), full.full)


def _scale_of(
    described: Described,
    scans: Mapping[Path, Points],
    of_sensor: float | None,
    scale: float | None,
    each: bool,
) -> _Scale:
    """The scale of reflectance of scans: as given, as written, else estimated, with a warning where
    another one may be right.
    """
    if scale:
        return _Scale(scale, of_sensor, strict=True)
    points = [*scans.values()]
    default = described.scale(of_sensor) if described.options.name != FOLDER or of_sensor else 0.0
    written = described.written_scale if described.stored else None
    if each:
        full = _own_scale(points[0], of_sensor)
    else:
        full = written or full_reflectance(points, default) or default or 1.0
    if not described.stored and full != default and (of_sensor or full not in SURE):
        warn_odd(next(iter(scans)), DIVIDED % full)
    return _Scale(None if each else full, of_sensor, full in FULL_REFLECTANCE and not each)


def _own_scale(points: Points, default: float | None = None) -> float:
    """The value of full reflectance of a scan, from its own values alone, so that scans of a stream
    have the same scale whatever came before: `full_reflectance`, but bytes are of 255, since a
    later scan of the same sensor may exceed 100.
    """
    full = full_reflectance([points], default) or 1.0
    return 255.0 if full == 100 and full != default else full


def seeing_all(source: Sensor, target: Sensor) -> Sensor | None:
    """A sensor with at least the target's rows and with its columns that sees all beams of the
    source, and as near; None if the target sees all beams.
    """
    if (rows_of(source.elevations, target) >= 0).all():
        return None
    beams = len(source.elevations)
    rows = max(target.shape[0], math.ceil(beams / 16) * 16)  # networks halve them four times
    near = min(source.min_range, target.min_range)
    sensor = source.resized(rows, target.columns)
    return replace(sensor, min_range=near, max_range=target.max_range)


def lines_about(label: str, source: Sensor, target: Sensor, turns: bool = False) -> list[str]:
    """Lines about the sensor of scans, the number of measured rows, and the lost beams."""
    e = source.elevations
    rows = rows_of(e, target)
    beams = f"{source.name} with {len(e)} beams from {e[0]:+.1f} to {e[-1]:+.1f} degrees"
    seen = rows >= 0
    if not seen.any():
        raise InputError(
            f"{label}: {beams}, and the model's sensor {target.name} sees "
            f"{target.row_edges[0]:+.1f} to {target.row_edges[-1]:+.1f} degrees."
        )
    measured = f"{len(set(rows[seen]))} of the {target.shape[0]} rows to complete are measured"
    turn = ""
    if turns and source.columns < _FEWER * target.columns:
        turn = f", in the columns that its {source.columns} rays a turn meet"
    lines = [f"{label}: {beams}; {measured}{turn}"]
    if not seen.all():
        known = source.name in SENSORS
        name = source.name if known else "FILE (r2flow sensor)"
        columns = (SENSORS[source.name] if known else source).columns
        lines.append(
            f"{label}: {(~seen).sum()} of its {len(e)} beams look past the view of {target.name} "
            f"and are not used: --to {name} --size {max(target.shape[0], len(e))}x{columns}, "
            f"{_THROUGH}"
        )
    return lines


def _seen(
    path: Path, points: Points, reading: Reading, fired: Sensor | None, scale: _Scale
) -> Partial:
    """The image of points of the model's sensor or, with `fired`, of another sensor."""
    target = reading.sensor
    if fired is None and reading.projection == "unfolding":
        points = points.with_lost_rays()
    strength = None  # reflectance in [0, 1]; None if the file has none, or only 0
    full = 1.0
    if points.reflectance is not None and points.reflectance.any():
        strength, full = scaled_reflectance(path, points, scale.of(points), scale.strict)
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
    assert seen.row is not None
    assert seen.place is not None
    numbers = np.arange(len(r)) if points.kept is None else points.kept
    kept = Points(
        points.xyz[inside],
        None if strength is None else strength[inside],
        dropped=int(np.count_nonzero(r) - inside.sum()),
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
