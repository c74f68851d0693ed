"""A scan of one sensor as what is known of another sensor's image.

A row of the image is measured where a beam of the scan's sensor looks into it. A pixel of such a row is known to be
empty only where a ray was fired into it and did not come back.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from r2flow.errors import InputError
from r2flow.lidar.beams import Beams, find_beams, steps_of_a_turn
from r2flow.lidar.known import Ray
from r2flow.lidar.projection import Convention, Projection, image_of, project_indices
from r2flow.lidar.scan_files import Points
from r2flow.lidar.scan_files.points import NEAREST
from r2flow.lidar.sensors import Sensor
from r2flow.lidar.unfolding import elevations_of

BLIND = 5.0  # degrees: in a wider sector without any return nothing was measured, as in a scan that was cut


@dataclass(frozen=True)
class Partial:
    """What is known of an image.

    Attributes:
        image: Range in metres and, where known, reflectance, (2 or 1, H, W) float32; 0 without a return.
        state: `Ray` of each ray, (H, W) uint8.
        xyz: The measured points of the returns in metres, (3, H, W) float32; None where only ranges are known.
        outside: Share of the scan's returns that the image's field of view does not hold.
    """

    image: np.ndarray
    state: np.ndarray
    xyz: np.ndarray | None = None
    outside: float = 0.0


@dataclass(frozen=True)
class Fired:
    """How a sensor fires.

    Attributes:
        elevations: Of its beams in degrees, the top one first, (N,).
        steps: Rays of each beam in a full turn.
    """

    elevations: np.ndarray
    steps: float


def firing_of(scans: list[Points], sensor: Sensor | None = None) -> Fired:
    """Beams and steps of the sensor of some scans: found in them, or of a sensor that is named, its steps found.

    Raises:
        InputError: no beams can be told apart and no sensor is named.
    """
    if sensor is None:
        beams = find_beams(scans)
        return Fired(beams.elevations, steps_of_a_turn(scans, beams))
    elevations = np.asarray(sensor.elevations)
    of_point = [beams_of(scan.xyz, elevations) for scan in scans]
    try:
        steps = steps_of_a_turn(scans, Beams(elevations, of_point))
    except InputError:  # too few points to tell
        steps = float(sensor.columns)
    return Fired(elevations, steps)


def beams_of(xyz: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """The beam that each point is of, (N,), by its elevation; -1 for none: at the origin, or far from all beams."""
    e, elevation = np.asarray(elevations), elevations_of(xyz)
    inner = (e[:-1] + e[1:]) / 2
    edges = np.concatenate([[2 * e[0] - inner[0]], inner, [2 * e[-1] - inner[-1]]])
    beam = np.searchsorted(-edges, -np.nan_to_num(elevation)) - 1
    beam[~np.isfinite(elevation) | (beam >= len(e))] = -1
    return beam


def rows_of(elevations: np.ndarray, target: Sensor) -> np.ndarray:
    """The row of an image that each elevation in degrees falls into; -1 for none."""
    row = np.searchsorted(-target.row_edges, -np.asarray(elevations), side="right") - 1
    return np.where(row < target.shape[0], row, -1)


def points_through(points: Points, fired: Fired, target: Sensor, reflectance: np.ndarray | None = None) -> Partial:
    """What is known of a target's image by a scan of another sensor.

    All points of a beam go to the row that the beam looks into, by the median of their elevations. Rays that did not
    come back lie evenly between the two returns of their beam next to them, as many as its steps leave room for.

    Args:
        reflectance: Of each point, of [0, 1]; None where the scan has none.

    Raises:
        InputError: no beam looks into the image.
    """
    beam, azimuth = beams_of(points.xyz, fired.elevations), _azimuth(points.xyz)
    elevation = elevations_of(points.xyz)
    by_beam = [np.flatnonzero(beam == b) for b in range(len(fired.elevations))]
    seen = np.array([np.median(elevation[some]) if len(some) else e
                     for some, e in zip(by_beam, fired.elevations, strict=True)])  # fmt: skip
    row = rows_of(seen, target)
    if not (row >= 0).any():
        edges = target.row_edges
        raise InputError(
            f"the scan's beams look from {seen.max():+.1f} to {seen.min():+.1f} degrees, none of them into the view of "
            f"sensor '{target.name}', {edges[0]:+.1f} to {edges[-1]:+.1f} degrees."
        )
    lost = [(r, _without_return(azimuth[some], fired.steps)) for r, some in zip(row, by_beam, strict=True) if r >= 0]
    empty = np.zeros(target.shape, dtype=bool)
    for r, angles in lost:
        empty[r, _columns(angles, target.shape[1])] = True
    many = points.dropped > (len(points.xyz) + points.dropped) / 100  # a damaged row or two are no lost rays
    keeps_empty = many or bool((beam < 0).any() and (~points.xyz.any(axis=1)).any())
    if not keeps_empty:
        empty[:, _blind(azimuth[beam >= 0], target.shape[1], 3 * 360 / fired.steps)] = False
    inside = (beam >= 0) & (row[beam] >= 0)
    chosen = np.flatnonzero(inside)
    pixel = row[beam[chosen]] * target.shape[1] + _columns(azimuth[chosen], target.shape[1])
    return _cast(target, points.xyz[chosen], pixel, empty, None if reflectance is None else reflectance[chosen],
                 1 - len(chosen) / max(int(np.isfinite(elevation).sum()), 1))  # fmt: skip


def image_through(image: np.ndarray, source: Sensor, target: Sensor) -> Partial:
    """What is known of a target's image by the image of another sensor, (2 or 1, H, W), all of whose rays are measured.

    Raises:
        InputError: no beam looks into the target's image.
    """
    e, a = source.rays().double().numpy()
    row = rows_of(np.asarray(source.elevations), target)
    if not (row >= 0).any():
        raise InputError(f"no beam of sensor '{source.name}' looks into the view of sensor '{target.name}'.")
    pixel = row[:, None] * target.shape[1] + _columns(a, target.shape[1])
    returned, inside = image[0] > 0, np.broadcast_to(row[:, None] >= 0, image[0].shape)
    empty = np.zeros(math.prod(target.shape), dtype=bool)
    empty[pixel[~returned & inside]] = True
    xyz = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1) * image[0][..., None]
    some = returned & inside
    outside = 1 - some.sum() / max(int(returned.sum()), 1)
    reflectance = image[1][some] if len(image) > 1 else None
    return _cast(target, xyz[some].astype(np.float32), pixel[some], empty.reshape(target.shape), reflectance, outside)


def points_of_same(
    points: Points,
    target: Sensor,
    projection: Projection = "spherical",
    convention: Convention = "centre",
    reflectance: np.ndarray | None = None,
) -> Partial:
    """What is known of a sensor's image by a scan of this sensor.

    All of it, but for a sector without any return and for what is behind a return nearer than its nearest range.
    """
    hit, chosen, r = project_indices(points.xyz, target, projection, convention, points.ring)
    image = image_of(target, hit, r, None if reflectance is None else reflectance[chosen])
    state = np.where(image[0] > 0, int(Ray.RETURN), int(Ray.EMPTY)).astype(np.uint8)
    # A point at the origin is a ray without a return.
    close = replace(target, min_range=min(NEAREST, target.min_range / 2), max_range=target.min_range)
    near = project_indices(points.xyz, close, projection, convention, points.ring)[0]
    state.ravel()[near[image[0].ravel()[near] == 0]] = Ray.UNKNOWN
    returned = points.xyz[:, :2].any(axis=1)
    blind = _blind(_azimuth(points.xyz[returned]), target.shape[1], 3 * 360 / target.shape[1])
    state[blind & (image[0] == 0)] = Ray.UNKNOWN
    return Partial(image if reflectance is not None else image[:1], state, _spread(target, hit, points.xyz[chosen]))


def image_of_same(image: np.ndarray, target: Sensor) -> Partial:
    """What is known of a sensor's image by such an image, (2 or 1, H, W): a ray without a return came back empty."""
    r = image[0]
    near, far = (r > 0) & (r < target.min_range), r > target.max_range
    returned = (r > 0) & ~near & ~far
    state = np.where(returned, int(Ray.RETURN), int(Ray.EMPTY)).astype(np.uint8)
    state[near] = Ray.UNKNOWN
    kept = np.where(returned, image, np.float32(0))
    kept[1:] = kept[1:].clip(0, 1)
    return Partial(kept, state)


def _cast(
    target: Sensor,
    xyz: np.ndarray,
    pixel: np.ndarray,
    empty: np.ndarray,
    reflectance: np.ndarray | None,
    outside: float,
) -> Partial:
    """The image of returns at their pixels, and of pixels that a ray was fired into without one.

    A return nearer than the target's nearest range is the vehicle itself, and what is behind it was not measured; one
    beyond its farthest does not come back to the target.
    """
    r = np.linalg.norm(xyz, axis=1).astype(np.float32)
    near, far = r < target.min_range, r > target.max_range
    order = np.flatnonzero(~near & ~far)
    order = order[np.argsort(-r[order], kind="stable")]  # the nearest is written last
    owner = np.full(math.prod(target.shape), -1)
    owner[pixel[order]] = order
    hit = np.flatnonzero(owner >= 0)
    chosen = owner[hit]
    image = image_of(target, hit, r[chosen], None if reflectance is None else reflectance[chosen])
    state = np.where(empty, int(Ray.EMPTY), int(Ray.UNKNOWN)).astype(np.uint8).ravel()
    state[pixel[far]] = Ray.EMPTY
    state[pixel[near]] = Ray.UNKNOWN
    state[hit] = Ray.RETURN
    channels = 1 if reflectance is None else 2
    return Partial(image[:channels], state.reshape(target.shape), _spread(target, hit, xyz[chosen]), outside)


def _spread(target: Sensor, hit: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    found = np.zeros((3, math.prod(target.shape)), dtype=np.float32)
    found[:, hit] = xyz.T
    return found.reshape(3, *target.shape)


def _azimuth(xyz: np.ndarray) -> np.ndarray:
    return np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0])


def _columns(azimuth: np.ndarray, columns: int) -> np.ndarray:
    return np.floor((1 - azimuth / math.pi) / 2 * columns).astype(np.int64) % columns


def _without_return(azimuth: np.ndarray, steps: float) -> np.ndarray:
    """Azimuths of the rays of one beam that did not come back, from those of its returns, in radians."""
    step = 2 * math.pi / steps
    if not len(azimuth):
        return np.arange(round(steps)) * step
    ordered = np.sort(azimuth)
    gap = np.diff(ordered, append=ordered[0] + 2 * math.pi)
    missing = np.maximum(np.rint(gap / step).astype(np.int64) - 1, 0)
    begin, gap, count = (np.repeat(values, missing) for values in (ordered, gap, missing))
    place = np.arange(len(begin)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    return begin + gap * place / (count + 1)


def _blind(azimuth: np.ndarray, columns: int, least: float) -> np.ndarray:
    """Columns of sectors without any return that are wider than `BLIND` and `least` degrees, (W,) bool."""
    ordered = np.sort(azimuth)
    blind = np.zeros(columns, dtype=bool)
    gaps = np.diff(ordered, append=ordered[:1] + 2 * math.pi)
    middles = math.pi * (1 - 2 * (np.arange(columns) + 0.5) / columns)
    for begin, gap in zip(ordered, gaps, strict=True):
        if gap > math.radians(max(BLIND, least)):
            blind |= (middles - begin) % (2 * math.pi) < gap
    return blind
