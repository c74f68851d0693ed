"""How far one set of scans lies from another, line by line: statistics that need no trained network.

Each member of the panel turns a set of range images into a histogram (or a profile over rows) and compares
two sets by Jensen-Shannon distance (or the mean absolute difference). One member alone can be fooled: pixels
shuffled across scans have nearly the right bird's-eye view, and no gradients at all. Read them together, and
next to the controls, which know nothing of scenes.
"""

from collections.abc import Callable

import numpy as np

from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.noise import generator, standard_normal

Statistic = Callable[[np.ndarray, Sensor], np.ndarray]

GRADIENTS = np.concatenate([[0], np.geomspace(0.01, 80, 24)])  # metres
RUNS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1025, 4097])  # pixels


def fill_row(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Share of each row's rays that returned, (H,)."""
    return (images[:, 0] > 0).mean((0, 2))


def range_histogram(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Ranges in 32 bins of equal logarithmic width."""
    r = images[:, 0][images[:, 0] > 0]
    edges = np.linspace(np.log(sensor.min_range), np.log(sensor.max_range), 33)
    return np.histogram(np.log(r), edges)[0]


def reflectance_histogram(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Reflectance in 25 bins."""
    return np.histogram(images[:, 1][images[:, 0] > 0], np.linspace(0, 1.0001, 26))[0]


def gradient_azimuth(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """|r(h, w + 1) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    r = np.concatenate([images[:, 0], images[:, 0, :, :1]], axis=-1)  # the ring closes
    return _differences(r[..., 1:], r[..., :-1])


def gradient_elevation(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """|r(h + 1, w) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    return _differences(images[:, 0, 1:], images[:, 0, :-1])


def _differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.histogram(np.abs(a - b)[(a > 0) & (b > 0)], GRADIENTS)[0]


def run_lengths(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Lengths of uninterrupted returns along the rows, weighted by length."""
    returned = (images[:, 0] > 0).reshape(-1, images.shape[-1]).astype(np.int8)
    edges = np.diff(np.pad(returned, ((0, 0), (1, 1))), axis=1)
    length = np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1]
    return np.histogram(length, RUNS, weights=length)[0]


def height_histogram(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Heights z of the points from 3.5 m below the sensor to 4 m above, in 25 cm bins."""
    z = images[:, 0] * np.sin(sensor.rays()[0].numpy())
    return np.histogram(z[images[:, 0] > 0], np.linspace(-3.5, 4, 31))[0]


def birds_eye(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The bird's-eye histograms of all scans, added: what the field's JSD compares."""
    rays = sensor.rays()
    return np.sum([birds_eye_histogram(image_to_points(image, rays)[0]) for image in images], axis=0)


def mean_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean |a - b| over the rows."""
    return float(np.abs(a - b).mean())


PANEL: dict[str, tuple[Statistic, Callable[[np.ndarray, np.ndarray], float]]] = {
    "fill per row": (fill_row, mean_difference),
    "range histogram": (range_histogram, js_distance),
    "reflectance histogram": (reflectance_histogram, js_distance),
    "gradient, azimuth": (gradient_azimuth, js_distance),
    "gradient, elevation": (gradient_elevation, js_distance),
    "run lengths": (run_lengths, js_distance),
    "height histogram": (height_histogram, js_distance),
    "bird's-eye JSD": (birds_eye, js_distance),
}


def panel(images: np.ndarray, sensor: Sensor) -> dict[str, np.ndarray]:
    """Every statistic of a set of range images, (N, 2 or 1, H, W); reflectance only where there is some."""
    chosen = {n: s for n, (s, _) in PANEL.items() if images.shape[1] > 1 or s is not reflectance_histogram}
    return {name: statistic(images, sensor) for name, statistic in chosen.items()}


def distances(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, float]:
    """Line by line, the distance between two sets' panels; 0 is equal."""
    return {name: PANEL[name][1](a[name], b[name]) for name in a if name in b}


def controls(training: np.ndarray, sensor: Sensor, num: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Sets that know nothing of scenes, (num, 2 or 1, H, W) each.

    `noise` is x_0 ~ N(0, I) decoded as if it were a scan; `flat ground` measures r = -height / sin e;
    `mean scan` is the mean of the training scans where over half of them returned; `shuffled pixels` takes
    every pixel from a training scan chosen for it alone.
    """
    channels = training.shape[1]
    encoding = Encoding(sensor, reflectance=channels > 1)
    noise = [encoding.decode(standard_normal(training.shape[1:], seed, "evaluation", k)).numpy() for k in range(num)]

    e = sensor.rays()[0].numpy().astype(np.float64)
    r = np.where(e < 0, -sensor.height / np.sin(np.minimum(e, -1e-6)), 0)
    r = np.where((r >= sensor.min_range) & (r <= sensor.max_range), r, 0)
    flat = np.stack([r, 0.3 * (r > 0)])[:channels]

    returned = training[:, 0] > 0
    mean = training.sum(0) / np.maximum(returned.sum(0), 1)
    mean = np.where(returned.mean(0) > 0.5, mean, 0)

    rows, columns = np.indices(sensor.shape)
    shuffled = []
    for k in range(num):
        scan = generator(seed, "shuffle", k).integers(len(training), size=sensor.shape)
        shuffled.append(np.moveaxis(training[scan, :, rows, columns], -1, 0))
    return {
        "noise": np.stack(noise),
        "flat ground": np.repeat(flat[None], num, 0).astype(np.float32),
        "mean scan": np.repeat(mean[None], num, 0).astype(np.float32),
        "shuffled pixels": np.stack(shuffled),
    }


def nearest(images: np.ndarray, training: np.ndarray, sensor: Sensor, leave_self: bool = False) -> np.ndarray:
    """Distance of each image to the nearest training scan, (N,): RMS difference of log-range in model space.

    Args:
        leave_self: The images are the training scans themselves: each is compared to the others.
    """
    import torch

    encoding = Encoding(sensor, reflectance=False)
    a, b = (encoding.encode(torch.from_numpy(np.ascontiguousarray(x[:, :1]))).flatten(1) for x in (images, training))
    d = torch.cdist(a, b) / a.shape[1] ** 0.5
    if leave_self:
        d.fill_diagonal_(torch.inf)
    return d.min(1).values.numpy()
