"""The returns that a sensor reports: noise, lost pulses, reflectance, the image."""

import math
from functools import cache
from pathlib import Path

import numpy as np
from numpy import ndarray
from numpy.random import Generator

from r2flow.lidar.projection import nearest, scatter
from r2flow.lidar.sensors import Sensor
from r2flow.simulator.draws import exponentials, logistic, normals
from r2flow.simulator.lasers import Rays, hidden, rows_of
from r2flow.simulator.materials import DEPTH, GLOSS, SWALLOW, TEXTURE
from r2flow.simulator.raycast import Hits

_NOISE = 0.006  # metres, scale of the range noise at range 0
_NOISE_FAR = 0.0002  # added per metre of range
_RANGE_STEP = 0.002  # metres: resolution of reported ranges
_LEVELS = 100  # reflectance is reported in steps of 1 / _LEVELS
_CALIBRATED = 16.0  # metres up to which the sensor compensates for distance
_FADE = 0.0068  # loss of reflectance per metre beyond
_DARK = 0.13  # reflectance below a random threshold of at most this is reported as 0
# share of returns lost one by one: gaps of one column and lengths of runs in three drives
_ALONE = 0.0014
_PATCH = 3  # columns lost together: dark and slanted surfaces are wider than a bin
_FAINT = -0.10  # far returns with a reflectance below this are mostly lost
_SOFT = 0.02  # width of the transition, in units of reflectance
# share of faint returns lost per metre of range beyond a distance in metres
_LOST = 0.012
_LOST_FROM = 8.0


def report(
    sensor: Sensor, rays: Rays, hits: Hits, rig: int | None, rng: Generator
) -> tuple[ndarray, ndarray]:
    """Range in metres and reflectance, (2, H, W), float32, and labels (H, W), uint16, that a sensor
    reports for hits.

    All are 0 for missing returns; a pixel keeps the nearest. `rig` is the index in `RIGS` of the
    ego vehicle, or None.
    """
    lasers = rays.lasers
    b, w = rays.shape
    columns = np.arange(w)
    slope = rays.slope[:, None]
    rise = rays.height[:, None] - rays.ground
    noise = normals(rng, (2, b, w))
    noise *= 0.6 + 0.2 * noise**2  # heavier tails than a Gaussian, as real scans have
    patches = rng.random((b, w // _PATCH + 2), dtype=np.float32)
    patches = np.take_along_axis(
        patches, (columns + rng.integers(0, _PATCH, (b, 1))) // _PATCH, axis=1
    )
    depth = DEPTH[hits.material] * exponentials(rng, rays.shape)
    s = np.where(hits.label > 0, hits.distance, 0) + depth
    r = np.sqrt(s**2 + (rise + s * slope) ** 2)
    r += (_NOISE + _NOISE_FAR * r) * noise[0] + lasers.bias
    r = np.round(r / _RANGE_STEP) * _RANGE_STEP
    # Reflectance: albedo (1 + g) c / (c + g), decreasing beyond the calibrated range.
    g = GLOSS[hits.material]
    reading = hits.albedo * ((1 + g) * hits.cosine / (hits.cosine + g + 1e-6))
    reading = (
        reading
        - _FADE * np.maximum(r - _CALIBRATED, 0)
        + lasers.gain
        + TEXTURE[hits.material] * noise[1]
    )
    # Returns are lost where they are absorbed, or too faint, which increases with the distance.
    swallow = SWALLOW[hits.material]
    faint = logistic((_FAINT - reading) / _SOFT)
    lost = swallow + (1 - swallow) * faint * np.clip(_LOST * (r - _LOST_FROM), 0, 1)
    single = rng.random(rays.shape, dtype=np.float32)
    seen = (hits.label > 0) & (patches > lost) & (single > _ALONE)
    seen &= (r >= sensor.min_range) & (r <= sensor.max_range)
    if rig is not None:
        seen &= ~hidden(lasers, w, rig)
    reading[reading < _DARK * single] = 0
    reading = _levels()[np.rint(np.clip(reading, 0, 1) * 2000).astype(np.int32)]
    row = np.arange(b)[:, None]
    if not lasers.straight:  # rows of the apparent elevations
        row = rows_of(sensor, slope + rise / np.maximum(s, 0.1))
    kept = np.flatnonzero(seen & (row >= 0))[::-1]  # of equal ranges, the last
    values = np.stack([r, reading, hits.label]).reshape(3, -1)[:, kept]  # ids are exact in float32
    pixel, near = nearest((row * w + columns).ravel()[kept], values[0], math.prod(sensor.shape))
    *image, labels = scatter(sensor, pixel, [*values[:, near]])
    return np.stack(image), labels.astype(np.uint16)


@cache
def _levels() -> ndarray:
    """The reported reflectance for readings of 0, 1/2000, 2/2000, ... 1, (2001,), float32."""
    widths = np.loadtxt(Path(__file__).with_name("reflectance_levels.csv"))
    first = 2
    last = 1 + len(widths)
    upper = (first - 0.5 + np.cumsum(widths) * (len(widths) / widths.sum())) / _LEVELS
    reading = np.arange(2001) / 2000
    level = np.where(
        reading < (first - 0.5) / _LEVELS, 0, first + np.searchsorted(upper, reading, side="right")
    )
    level = np.where(reading > (last + 0.5) / _LEVELS, np.rint(reading * _LEVELS), level)
    return (np.minimum(level, _LEVELS - 1) / _LEVELS).astype(np.float32)
