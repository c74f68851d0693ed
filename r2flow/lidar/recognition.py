"""Whether scans are of the sensor that they are asked to be of, by the beams that they show."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.beams import NoBeamsError, find_beams
from r2flow.lidar.scan_files import Points
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.unfolding import elevations_of

FEWEST_RETURNS = 1000  # fewer tell nothing of a sensor
IN_VIEW = 0.9  # share of the returns that a sensor's own view holds; of the scans at hand 0.967 or more
STRIPED = 0.3  # share of rows without returns, between rows with some, that fewer beams than rows leave
OFF = 1.5  # degrees by `_distance`; a unit's own calibration and rings that nothing returned to leave less
BEATEN = 0.5  # degrees from which on a sensor does not fit if another one is twice as near
FAINT = 0.05  # share of the usual number of returns below which a row counts as empty


class Doubt(NamedTuple):
    """What speaks against a sensor, in words; the built-in sensor that the scans fit; whether they fit none at all."""

    seen: str
    name: str | None
    hopeless: bool = False


def other_sensor(scans: Sequence[Points], sensor: Sensor) -> Doubt | None:
    """What in some scans speaks against a sensor.

    A sensor's beams are compared with those that `find_beams` finds. Where it finds none, or where a sensor of the
    user's own has another number of rows (which may be a choice), the share of the returns in view and rows without
    returns between others must tell. Scans that are cut to a part of the view fit: only what is there counts.

    Returns:
        None where the scans may well be of that sensor, or are too few to tell.
    """
    xyz = np.concatenate([scan.xyz for scan in scans])
    elevation, r = elevations_of(xyz), np.linalg.norm(xyz, axis=1)
    elevation = elevation[np.isfinite(elevation) & (r >= sensor.min_range) & (r <= sensor.max_range)]
    if len(elevation) < FEWEST_RETURNS:
        return None
    try:
        beams = find_beams(scans).elevations
    except NoBeamsError as error:
        return Doubt(str(error), None, hopeless=True)
    except InputError:
        beams = None
    share = _share_in_view(elevation, sensor)
    seen = f"{share:.0%} of the returns lie in its view"
    if beams is not None:
        seen = f"they have {len(beams)} beams from {beams[0]:+.1f} to {beams[-1]:+.1f} degrees, {seen}"
    striped = _share_of_empty_rows(elevation, sensor)
    nearest, near = (None, np.inf) if beams is None else _nearest(beams, elevation)
    if beams is not None and (sensor.name in SENSORS or len(beams) == len(sensor.elevations)):
        distance = min(_distance(beams, table) for table in _beam_tables(sensor, len(beams)))
        fits = distance < OFF and not (distance > BEATEN and near < distance / 2)
    else:
        fits = striped <= STRIPED
    if fits and share >= IN_VIEW:
        return None
    seen += f", {striped:.0%} of the rows between others stay empty" if striped > STRIPED else ""
    return Doubt(seen, nearest)


def _beam_tables(sensor: Sensor, beams: int) -> list[np.ndarray]:
    """Elevations that its scans may have: its rows, and the beams of the built-in sensor that it is at another size."""
    found = [sensor.elevations]
    if sensor.name not in SENSORS:
        return [np.asarray(found[0])]
    rows, known = len(sensor.elevations), SENSORS[sensor.name]
    if np.allclose(known.resized(rows).elevations, sensor.elevations):
        found += [known.elevations]
        if sensor.name == "hdl64e":  # whose rows are even bins: rings, and clouds of images with as many rows or more
            found += [SENSORS["hdl64e_rings"].elevations, *([known.resized(beams).elevations] if beams >= rows else ())]
    return [np.asarray(elevations) for elevations in found]


def _share_in_view(elevation: np.ndarray, sensor: Sensor) -> float:
    edges = sensor.row_edges
    return float(((elevation <= edges[0]) & (elevation >= edges[-1])).mean())


def _share_of_empty_rows(elevation: np.ndarray, sensor: Sensor) -> float:
    """Share of rows without returns among those from the first to the last with some."""
    counts = np.histogram(-elevation, -sensor.row_edges)[0]
    if not counts.any():
        return 0.0
    filled = np.flatnonzero(counts > FAINT * np.median(counts[counts > 0]))
    return 1 - len(filled) / (filled[-1] - filled[0] + 1)


def _distance(beams: np.ndarray, table: np.ndarray) -> float:
    """How far beams lie from those of a table, in degrees: the 80th percentile over the beams, paired in their order.

    The first beam is paired with that of the table which gives the smallest result, since rings above the horizon may
    see only sky and a scan may be cut. Where beams are missing in between, later pairs are wrong; there the median
    distance from the nearest beam decides, for tables whose beams are far apart.
    """
    longer, shorter = (table, beams) if len(table) >= len(beams) else (beams, table)
    if len(longer) > 1.05 * len(table) + 1:
        return np.inf
    shifts = range(len(longer) - len(shorter) + 1)
    paired = min(float(np.quantile(np.abs(longer[s : s + len(shorter)] - shorter), 0.8)) for s in shifts)
    gap = float(np.median(-np.diff(table)))
    spanned = np.count_nonzero((table <= beams[0] + gap / 2) & (table >= beams[-1] - gap / 2))
    nearest = float(np.median(np.abs(beams[:, None] - table).min(axis=1)))
    is_near = nearest <= gap / 10 and len(beams) >= 0.75 * spanned
    return min(paired, nearest) if is_near else paired


def _nearest(beams: np.ndarray, elevation: np.ndarray) -> tuple[str | None, float]:
    """The built-in sensor whose beams are nearest, where one fits, and their distance."""
    found = [
        (_distance(beams, np.asarray(sensor.elevations)), name)
        for name, sensor in SENSORS.items()
        if _share_in_view(elevation, sensor) >= IN_VIEW
    ]
    distance, name = min(found, default=(np.inf, ""))
    return (name.removesuffix("_rings") if distance < OFF else None), distance
