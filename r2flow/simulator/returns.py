"""The returns that a sensor reports: noise, lost pulses, reflectance, the image."""

import math
from functools import cache

import numpy as np

from r2flow.lidar.projection import nearest, scatter
from r2flow.lidar.sensors import Sensor
from r2flow.simulator.draws import exponentials, logistic, normals
from r2flow.simulator.lasers import Rays, hidden, rows_of
from r2flow.simulator.materials import column
from r2flow.simulator.raycast import Hits

NOISE = 0.006  # metres, scale of the range noise at range 0
NOISE_FAR = 0.0002  # added per metre of range
RANGE_STEP = 0.002  # metres: resolution of reported ranges
LEVELS = 100  # reflectance is reported in steps of 1 / LEVELS
# Width of each level from 0.02 to 0.69, in steps: the sensor has internal steps, several of which may share a hundredth
# while other hundredths have none. Frequencies of the levels in three drives over the frequencies of their neighbours.
_WIDTHS = (
    0.16, 0.58, 1.98, 1.58, 0.30, 0.71, 0.80, 1.14, 0.98, 1.25, 1.00, 0.48, 0.76, 0.59, 1.29, 0.93, 1.66, 1.02, 1.12,
    0.91, 0.58, 0.99, 0.64, 1.03, 0.73, 1.15, 0.93, 1.55, 1.38, 0.89, 1.24, 0.76, 1.14, 0.80, 1.21, 0.76, 1.17, 1.06,
    0.71, 1.08, 0.67, 1.10, 0.63, 1.15, 1.00, 0.75, 1.16, 0.71, 1.12, 0.72, 1.30, 0.84, 1.11, 1.20, 0.67, 1.05, 0.83,
    1.12, 0.68, 1.05, 1.10, 0.69, 1.06, 0.65, 1.09, 0.75, 1.10, 0.76,
)  # fmt: skip
CALIBRATED = 16.0  # metres up to which the sensor compensates for distance
FADE = 0.0068  # loss of reflectance per metre beyond
DARK = 0.13  # reflectance below a random threshold of at most this is reported as 0
ALONE = 0.0014  # share of returns lost one by one: gaps of one column and lengths of runs in three drives
PATCH = 3  # columns lost together: dark and slanted surfaces are wider than a bin
FAINT = -0.10  # far returns with a reflectance below this are mostly lost
SOFT = 0.02  # width of the transition, in units of reflectance
LOST = 0.012, 8.0  # share of faint returns lost per metre of range beyond a distance, and that distance in metres

TEXTURE, GLOSS, SWALLOW, DEPTH = (column(name) for name in ("texture", "gloss", "swallow", "depth"))


def report(
    sensor: Sensor, rays: Rays, hits: Hits, rig: int | None, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Range in metres and reflectance, (2, H, W), float32, and labels (H, W), uint16, that a sensor reports for hits.

    All are 0 for missing returns; `rig` is the index in `RIGS` of the ego vehicle, or None.
    """
    slope, rise = rays.slope[:, None], rays.height[:, None] - np.float32(rays.ground)
    noise = normals(rng, (2, *rays.shape))
    noise *= 0.6 + 0.2 * noise**2  # heavier tails than a Gaussian, as real scans have
    uniforms = _in_patches(rays, rng)
    depth = DEPTH[hits.material] * exponentials(rng, rays.shape)
    s = np.where(np.isfinite(hits.distance), hits.distance, 0) + depth
    r = np.sqrt(s**2 + (rise + s * slope) ** 2)
    r += (NOISE + NOISE_FAR * r) * noise[0] + rays.lasers.bias.astype(np.float32)[:, None]
    r = np.round(r / RANGE_STEP) * np.float32(RANGE_STEP)
    reading = _reading(hits, r, noise[1], rays)
    single = rng.random(rays.shape, dtype=np.float32)
    seen = (hits.label > 0) & (uniforms > _lost(hits, r, reading)) & (single > ALONE)
    seen &= (r >= sensor.min_range) & (r <= sensor.max_range)
    if rig is not None:
        seen &= ~hidden(rays.lasers, rays.columns, rig)
    reading[reading < DARK * single] = 0
    reading = _levels()[np.rint(np.clip(reading, 0, 1) * 2000).astype(np.int32)]
    along = np.broadcast_to(np.arange(len(slope))[:, None], rays.shape)
    row = along if rays.lasers.straight else rows_of(sensor, slope + rise / np.maximum(s, np.float32(0.1)))
    return _nearest(sensor, row, seen, r, reading, hits.label)


@cache
def _levels() -> np.ndarray:
    """The reported reflectance for readings of 0, 1/2000, 2/2000, ... 1, (2001,), float32."""
    first, last = 2, 1 + len(_WIDTHS)
    edges = (first - 0.5 + np.cumsum(_WIDTHS) * (len(_WIDTHS) / sum(_WIDTHS))) / LEVELS  # upper edges
    reading = np.arange(2001) / 2000
    level = np.where(reading < (first - 0.5) / LEVELS, 0, first + np.searchsorted(edges, reading, side="right"))
    level = np.where(reading > (last + 0.5) / LEVELS, np.rint(reading * LEVELS), level)
    return (np.minimum(level, LEVELS - 1) / LEVELS).astype(np.float32)


def _reading(hits: Hits, r: np.ndarray, normal: np.ndarray, rays: Rays) -> np.ndarray:
    """Reflectance before clipping: albedo (1 + g) c / (c + g), decreasing beyond the calibrated range."""
    g = GLOSS[hits.material]
    falloff = (1 + g) * hits.cosine / (hits.cosine + g + 1e-6)
    faded = FADE * np.maximum(r - CALIBRATED, 0)
    gain = rays.lasers.gain.astype(np.float32)[:, None]
    return hits.albedo * falloff - faded + gain + TEXTURE[hits.material] * normal


def _lost(hits: Hits, r: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Probability of a lost return: absorbed, or too faint, which increases with the distance."""
    faint = logistic((FAINT - reading) / np.float32(SOFT))
    swallow = SWALLOW[hits.material]
    return swallow + (1 - swallow) * faint * np.clip(LOST[0] * (r - LOST[1]), 0, 1)


def _in_patches(rays: Rays, rng: np.random.Generator) -> np.ndarray:
    """Uniform draws that PATCH neighbouring columns of a laser share, (B, W)."""
    b, w = rays.shape
    patches = rng.random((b, w // PATCH + 2), dtype=np.float32)
    return np.take_along_axis(patches, (np.arange(w) + rng.integers(0, PATCH, (b, 1))) // PATCH, axis=1)


def _nearest(
    sensor: Sensor, row: np.ndarray, seen: np.ndarray, r: np.ndarray, reading: np.ndarray, label: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The image of the returns seen, in the rows of their apparent elevations; a pixel keeps the nearest."""
    kept = np.flatnonzero(seen & (row >= 0))[::-1]  # of equal ranges, the last
    pixel = (row * sensor.columns + np.arange(sensor.columns)).ravel()[kept]
    r, reading, label = (q.ravel()[kept] for q in (r, reading, label))
    hit, chosen = nearest(pixel, r, math.prod(sensor.shape))
    image = scatter(sensor, hit, [q[chosen] for q in (r, reading, label)])  # ids are exact in float32
    return image[:2], image[2].astype(np.uint16)
