"""Transfer of a scan to a partially measured image of another sensor.

A row of the image is measured if it contains a beam of the scan's sensor. A pixel of such a row is known to be empty
only if a ray was fired into it and did not return.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.estimation import estimate_sensor, steps_of_a_turn
from r2flow.lidar.known import Ray
from r2flow.lidar.projection import TIE, Convention, Projection, nearest, project_indices, scatter
from r2flow.lidar.scan_files import Points
from r2flow.lidar.scan_files.points import NEAREST
from r2flow.lidar.sensors import Sensor
from r2flow.lidar.unfolding import elevations_of

BLIND = 5.0  # degrees: a wider sector without any return counts as not measured, as in a cropped scan
WHOLE = 0.9  # minimum share of the rays of a turn that a file with all lost rays stores


@dataclass(frozen=True)
class Partial:
    image: np.ndarray  # range in metres and, if measured, reflectance, (2 or 1, H, W) float32; 0 without a return
    state: np.ndarray  # `Ray` of each ray, (H, W) uint8
    xyz: np.ndarray | None = None  # the measured points of the returns in metres, (3, H, W) float32, or None
    points: Points | None = None  # all points of the scan's file; the image has the nearest one of each pixel


def sensor_of(scans: list[Points], named: Sensor | None) -> Sensor:
    """The sensor of some scans, named or estimated, with as many columns as rays per turn."""
    if named is None:
        estimate = estimate_sensor(scans)
        return replace(estimate.sensor, columns=round(estimate.steps))
    rows = [rows_of(elevations_of(scan.xyz), named) for scan in scans]
    try:
        return replace(named, columns=round(steps_of_a_turn(scans, rows)))
    except InputError:  # too few points
        return named


def rows_of(elevations: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The row of a sensor's image for each elevation in degrees, TIE of a degree lowered; -1 outside the view."""
    row = np.searchsorted(-sensor.row_edges, TIE - np.asarray(elevations), side="right") - 1
    return np.where(row < sensor.shape[0], row, -1)


def points_through(points: Points, source: Sensor, target: Sensor, reflectance: np.ndarray | None = None) -> Partial:
    """The target's partially measured image, from a scan of another sensor (`sensor_of`) with reflectance in [0, 1].

    All points of a beam are in the row of their median elevation. Rays without return are evenly spaced between the two
    neighbouring returns of their beam, one per missing azimuth step.
    """
    elevation, azimuth = elevations_of(points.xyz), _azimuth(points.xyz)
    beam = rows_of(elevation, source)
    by_beam = [np.flatnonzero(beam == b) for b in range(source.shape[0])]
    seen = np.array([np.median(elevation[members]) if len(members) else e
                     for members, e in zip(by_beam, source.elevations, strict=True)])  # fmt: skip
    row = rows_of(seen, target)
    empty = np.zeros(target.shape, dtype=bool)
    for r, members in zip(row, by_beam, strict=True):
        if r >= 0:
            empty[r, _columns(_without_return(azimuth[members], source.columns), target.columns)] = True
    stored = len(points.xyz) + points.dropped
    lost = points.dropped > stored / 100 or not points.xyz.any(axis=1).all()  # a few damaged rows are not lost rays
    if not lost or stored < WHOLE * math.prod(source.shape):
        empty[:, _blind(azimuth[beam >= 0], target.columns, 3 * 360 / source.columns)] = False
    chosen = np.flatnonzero((beam >= 0) & (row[beam] >= 0))
    pixel = row[beam[chosen]] * target.columns + _columns(azimuth[chosen], target.columns)
    return _cast(target, points.xyz[chosen], pixel, empty, None if reflectance is None else reflectance[chosen])


def image_through(image: np.ndarray, source: Sensor, target: Sensor) -> Partial:
    """The target's partially measured image, from a fully measured image of a sensor, (2 or 1, H, W)."""
    if source.same_image(target):
        return image_of_same(image, target)
    e, a = source.rays().double().numpy()
    row = rows_of(np.asarray(source.elevations), target)
    pixel = row[:, None] * target.columns + _columns(a, target.columns)
    returned, inside = image[0] > 0, np.broadcast_to(row[:, None] >= 0, image[0].shape)
    empty = np.zeros(math.prod(target.shape), dtype=bool)
    empty[pixel[~returned & inside]] = True
    xyz = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1) * image[0][..., None]
    hits = returned & inside
    reflectance = image[1][hits] if len(image) > 1 else None
    return _cast(target, xyz[hits].astype(np.float32), pixel[hits], empty.reshape(target.shape), reflectance)


def points_of_same(
    points: Points,
    target: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    reflectance: np.ndarray | None = None,
) -> Partial:
    """The partially measured image of a scan of the same sensor.

    All rays are measured, except sectors without any return and pixels behind a return nearer than the minimum range.
    """
    hit, chosen, r = project_indices(points.xyz, target, projection, convention, points.ring)
    image = scatter(target, hit, [r] if reflectance is None else [r, reflectance[chosen]])
    state = np.where(image[0] > 0, int(Ray.RETURN), int(Ray.EMPTY)).astype(np.uint8)
    # A point at the origin is a ray without a return.
    close = replace(target, min_range=min(NEAREST, target.min_range / 2), max_range=target.min_range)
    near = project_indices(points.xyz, close, projection, convention, points.ring)[0]
    state.ravel()[near[image[0].ravel()[near] == 0]] = Ray.UNKNOWN
    returned = points.xyz[:, :2].any(axis=1)
    blind = _blind(_azimuth(points.xyz[returned]), target.columns, 3 * 360 / target.columns)
    state[blind & (image[0] == 0)] = Ray.UNKNOWN
    return Partial(image, state, scatter(target, hit, points.xyz[chosen].T))


def image_of_same(image: np.ndarray, target: Sensor) -> Partial:
    """The measured image from an image of the same sensor, (2 or 1, H, W); rays without a return are empty."""
    r = image[0]
    returned = (r >= target.min_range) & (r <= target.max_range)
    state = np.where(returned, int(Ray.RETURN), int(Ray.EMPTY)).astype(np.uint8)
    state[(r > 0) & (r < target.min_range)] = Ray.UNKNOWN
    kept = np.where(returned, image, np.float32(0))
    kept[1:] = kept[1:].clip(0, 1)
    return Partial(kept, state)


def _cast(
    target: Sensor, xyz: np.ndarray, pixel: np.ndarray, empty: np.ndarray, reflectance: np.ndarray | None
) -> Partial:
    """The image of returns at their pixels; one too near is the vehicle and hides its pixel, one too far is empty."""
    r = np.linalg.norm(xyz, axis=1).astype(np.float32)
    near, far = r < target.min_range, r > target.max_range
    pixels = math.prod(target.shape)
    hit, chosen = nearest(np.where(near | far, pixels, pixel), r, pixels)
    state = np.where(empty, int(Ray.EMPTY), int(Ray.UNKNOWN)).astype(np.uint8).ravel()
    state[pixel[far]] = Ray.EMPTY
    state[pixel[near]] = Ray.UNKNOWN
    state[hit] = Ray.RETURN
    values = [r[chosen]] if reflectance is None else [r[chosen], reflectance[chosen]]
    return Partial(scatter(target, hit, values), state.reshape(target.shape), scatter(target, hit, xyz[chosen].T))


def _azimuth(xyz: np.ndarray) -> np.ndarray:
    return np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0])


def _columns(azimuth: np.ndarray, columns: int) -> np.ndarray:
    return np.floor((1 - azimuth / math.pi) / 2 * columns + TIE).astype(np.int64) % columns


def _without_return(azimuth: np.ndarray, steps: float) -> np.ndarray:
    """Azimuths of the rays of a beam without return, from the azimuths of its returns, in radians."""
    step = 2 * math.pi / steps
    if not len(azimuth):
        return np.arange(round(steps)) * step
    ordered = np.sort(azimuth)
    double = np.diff(ordered, append=np.inf) < step / 100
    ordered = ordered[~double] if double.mean() > 0.3 else ordered  # a sensor that stores two returns of each ray
    gap = np.diff(ordered, append=ordered[0] + 2 * math.pi)
    three = gap + np.roll(gap, 1) + np.roll(gap, -1)  # where azimuths jitter, a wide gap lies next to a narrow one
    missing = np.maximum(np.minimum(np.rint(gap / step) - 1, np.rint(three / step) - 3), 0).astype(np.int64)
    begin, gap, count = (np.repeat(values, missing) for values in (ordered, gap, missing))
    place = np.arange(len(begin)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    return begin + gap * place / (count + 1)


def _blind(azimuth: np.ndarray, columns: int, least: float) -> np.ndarray:
    """Columns of sectors without any return that are wider than `BLIND` and `least` degrees, (W,) bool."""
    ordered = np.sort(azimuth)
    gaps = np.diff(ordered, append=ordered[:1] + 2 * math.pi)
    wide = gaps > math.radians(max(BLIND, least))
    middles = math.pi * (1 - 2 * (np.arange(columns) + 0.5) / columns)
    return ((middles - ordered[wide, None]) % (2 * math.pi) < gaps[wide, None]).any(0)
