"""From what rays meet to what a sensor reports: noise, lost pulses, reflectance, the image."""

import numpy as np

from r2flow.lidar.sensors import Sensor
from r2flow.simulator.beams import rows_of
from r2flow.simulator.ego import hidden
from r2flow.simulator.materials import column
from r2flow.simulator.raycast import Hits
from r2flow.simulator.rays import Rays

NOISE = 0.006  # metres, scale of the noise of range near by
NOISE_FAR = 0.0002  # and what each metre of range adds to it
RANGE_STEP = 0.002  # metres: the unit in which ranges are reported
LEVELS = 100  # reflectance is reported in steps of 1 / LEVELS
CALIBRATED = 18.0  # metres up to which the head makes up for distance
FADE = 0.005  # reading lost per metre beyond
FLOOR = 0.13  # readings below a threshold drawn up to this are reported as 0
FAINT = -0.02  # what would read less than this is mostly not seen as a return at all, where it is far
LOST = 0.012, 8.0  # share of faint returns lost for each metre of range beyond so many metres

TEXTURE, GLOSS, SWALLOW, DEPTH = (column(name) for name in ("texture", "gloss", "swallow", "depth"))


def report(
    sensor: Sensor, rays: Rays, hits: Hits, rig: int | None, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The image and labels that a sensor makes of its hits.

    Args:
        sensor: Whose rows the returns are sorted into.
        rays: The rays that were cast.
        hits: What they met, (B, W).
        rig: Silhouettes of the own car, or None without.
        rng: Source of the noise.

    Returns:
        image (2, H, W), float32: range in metres and reflectance; labels (H, W), uint16; 0 where missing.
    """
    slope, rise = rays.slope[:, None], rays.height[:, None] - np.float32(rays.ground)
    noise = rng.standard_normal((2, *rays.shape), dtype=np.float32)
    noise *= 0.6 + 0.2 * noise**2  # heavier tails than a Gaussian, as real scans have
    uniforms = rng.random(rays.shape, dtype=np.float32)
    depth = DEPTH[hits.material] * rng.standard_exponential(rays.shape, dtype=np.float32)
    s = np.where(np.isfinite(hits.distance), hits.distance, 0) + depth
    r = np.sqrt(s**2 + (rise + s * slope) ** 2)
    r += (NOISE + NOISE_FAR * r) * noise[0] + rays.beams.bias.astype(np.float32)[:, None]
    r = np.round(r / RANGE_STEP) * np.float32(RANGE_STEP)
    reading = _reading(hits, r, noise[1], rays)
    seen = (hits.label > 0) & (uniforms > _lost(hits, r, reading))
    seen &= (r >= sensor.min_range) & (r <= sensor.max_range)
    if rig is not None:
        seen &= ~hidden(rays.beams, rays.columns, rig)
    reading[reading < FLOOR * rng.random(rays.shape, dtype=np.float32)] = 0
    reading = np.round(np.clip(reading, 0, 1 - 1 / LEVELS) * LEVELS) / np.float32(LEVELS)
    return _sorted_into_rows(sensor, rays, s, r, reading, hits.label, seen)


def _reading(hits: Hits, r: np.ndarray, normal: np.ndarray, rays: Rays) -> np.ndarray:
    """Reflectance before it is clipped: albedo (1 + g) c / (c + g), fading beyond the calibrated range."""
    g = GLOSS[hits.material]
    falloff = (1 + g) * hits.cosine / (hits.cosine + g + 1e-6)
    faded = FADE * np.maximum(r - CALIBRATED, 0)
    gain = rays.beams.gain.astype(np.float32)[:, None]
    return hits.albedo * falloff - faded + gain + TEXTURE[hits.material] * normal


def _lost(hits: Hits, r: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """Probability that no return is reported: swallowed, or too faint, the more so the farther."""
    faint = 1 / (1 + np.exp(np.clip((reading - FAINT) / np.float32(0.02), -30, 30)))
    swallow = SWALLOW[hits.material]
    return swallow + (1 - swallow) * faint * np.clip(LOST[0] * (r - LOST[1]), 0, 1)


def _sorted_into_rows(
    sensor: Sensor,
    rays: Rays,
    s: np.ndarray,
    r: np.ndarray,
    reading: np.ndarray,
    label: np.ndarray,
    seen: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Each return into the row of its apparent elevation; the nearest of several wins."""
    h, w = sensor.shape
    if rays.beams.straight:
        row = np.broadcast_to(np.arange(h)[:, None], rays.shape)
    else:
        rise = rays.height[:, None] - np.float32(rays.ground)
        row = rows_of(sensor, rays.slope[:, None] + rise / np.maximum(s, np.float32(0.1)))
    kept = np.flatnonzero(seen & (row >= 0))
    pixel = (row * w + np.arange(w)).ravel()[kept]
    r, reading, label = (q.ravel()[kept] for q in (r, reading, label))
    nearest = np.full(h * w, np.inf, np.float32)
    np.minimum.at(nearest, pixel, r)
    first = r == nearest[pixel]
    pixel = pixel[first]
    image, labels = np.zeros((2, h * w), np.float32), np.zeros(h * w, np.uint16)
    image[0, pixel], image[1, pixel], labels[pixel] = r[first], reading[first], label[first]
    return image.reshape(2, h, w), labels.reshape(h, w)
