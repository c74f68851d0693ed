"""What goes wrong in a measurement: noise, rain, cross-talk, lost returns. And the opposite, a scan without any loss.

A fault takes an image (2 or 1, H, W), range in metres and reflectance, 0 without a return, and gives it back worse.
What is measured so is not to be trusted (`r2flow.lidar.known.Ray.DOUBTFUL`).
"""

from collections.abc import Callable

import numpy as np

from r2flow.lidar.sensors import Sensor
from r2flow.registry import Registry

Fault = Callable[[np.ndarray, Sensor, float, np.random.Generator], np.ndarray]  # image, sensor, strength 0..1, draws


def noisy(image: np.ndarray, sensor: Sensor, strength: float, draws: np.random.Generator) -> np.ndarray:
    """Range noise of a standard deviation of up to half a metre."""
    r = image[0] + 0.5 * strength * draws.standard_normal(image[0].shape, dtype=np.float32)
    kept = np.where(image[0] > 0, r.clip(sensor.min_range, sensor.max_range), 0)
    return np.concatenate([kept[None], image[1:]]).astype(np.float32)


def rain(image: np.ndarray, sensor: Sensor, strength: float, draws: np.random.Generator) -> np.ndarray:
    """Up to a tenth of the rays come back from a drop within 20 m, weakly: drops lie at exponential distances."""
    hit = draws.random(image[0].shape) < 0.1 * strength
    r = sensor.min_range + draws.exponential(5.0, image[0].shape).astype(np.float32).clip(max=20.0)
    nearer = hit & ((image[0] == 0) | (r < image[0]))
    return _replaced(image, nearer, r, 0.1 * draws.random(image[0].shape, dtype=np.float32))


def crosstalk(image: np.ndarray, sensor: Sensor, strength: float, draws: np.random.Generator) -> np.ndarray:
    """Up to a twentieth of the rays see another laser's light: any range, any reflectance."""
    hit = draws.random(image[0].shape) < 0.05 * strength
    r = draws.uniform(sensor.min_range, sensor.max_range, image[0].shape).astype(np.float32)
    return _replaced(image, hit, r, draws.random(image[0].shape, dtype=np.float32))


def lost(image: np.ndarray, sensor: Sensor, strength: float, draws: np.random.Generator) -> np.ndarray:
    """Up to half of the returns are lost, one by one."""
    return image * (draws.random(image[0].shape) >= 0.5 * strength).astype(np.float32)


def clean(image: np.ndarray, sensor: Sensor, strength: float, draws: np.random.Generator) -> np.ndarray:
    """No ray is lost, as in a simple simulator: a lost one has the range of its nearest neighbour in the row."""
    return nearest_filled(image, image[0] > 0)


FAULTS: Registry[Fault] = Registry("fault", noise=noisy, rain=rain, crosstalk=crosstalk, lost=lost, clean=clean)


def nearest_filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An image (C, H, W) whose unknown rays have the value of the nearest known one in their row, the ring closed.

    A row without any stays as it is.

    Args:
        known: (H, W) bool.
    """
    filled, columns = image.copy(), image.shape[-1]
    at = np.arange(columns)
    for row, measured in enumerate(known):
        places = np.flatnonzero(measured)
        if 0 < len(places) < columns:
            around = np.concatenate([places - columns, places, places + columns])
            right = np.searchsorted(around, at)
            nearest = np.where(at - around[right - 1] <= around[right] - at, around[right - 1], around[right])
            filled[:, row] = image[:, row, nearest % columns]
    return filled


def _replaced(image: np.ndarray, where: np.ndarray, r: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
    changed = np.where(where, r, image[0])[None]
    return np.concatenate([changed, *([np.where(where, reflectance, image[1])[None]] if len(image) > 1 else [])])
