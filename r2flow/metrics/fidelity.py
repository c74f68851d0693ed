"""The fidelity panel: distances between two sets of scans by statistics that need no trained network.

Each member of the panel turns a set of range images into a histogram (or a profile over rows) and compares two sets by
Jensen-Shannon distance (or the mean absolute difference). Every member looks at more than one pixel at a time:
statistics of single pixels, `PER_PIXEL`, cannot tell a real drive from pixels shuffled across the scans of another, and
judge nothing. Read the members together, and beside the controls, which are made without knowledge of scenes.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.birds_eye import birds_eye_histogram, js_distance
from r2flow.metrics.controls import CONTROLS, Control
from r2flow.metrics.surfaces import bridged, drop_rate, normals

GRADIENTS = np.concatenate([[0], np.geomspace(0.01, 80, 24)])  # metres
STEPS, SECTORS = np.array([-20, -6, -2, -0.6, -0.2, -0.05, -0.02, 0.02, 0.05, 0.2, 0.6, 2, 6, 20]), 8  # metres
RUNS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1025, 2**14 + 1])  # pixels
REFLECTANCES = np.linspace(0, 1.0001, 26)
INCIDENCES = np.cos(np.linspace(np.pi / 2, 0, 11))  # cosines, in steps of 9 degrees
DENSITIES = np.array([0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, 64.5, 128.5, 256.5, np.inf])  # points
NORMALS, COSINES, HEIGHTS = np.linspace(-1, 1, 21), np.linspace(0, 1, 21), np.linspace(-3.5, 4, 31)
APART = 128, 512  # parts of a turn between the two pixels of a pair: of ranges, of reflectances
AT_ONCE = 32  # scans; the normals of a thousand would fill the memory


@dataclass(frozen=True)
class Member:
    """A statistic of a set of scans, and the distance between two of them.

    Attributes:
        statistic: Of range images, (N, 2 or 1, H, W), and their sensor.
        distance: Between the statistics of two sets; 0 is equal.
        label, log: What its bins are, and whether they are drawn on a logarithmic axis.
        edges: Of its bins, or how a sensor gives them; None where they are rows, or of two dimensions.
        needs_reflectance: Whether it is left out for scans of range alone.
    """

    statistic: Callable[[np.ndarray, Sensor], np.ndarray]
    distance: Callable[[np.ndarray, np.ndarray], float]
    label: str = "bin"
    edges: np.ndarray | Callable[[Sensor], np.ndarray] | None = None
    log: bool = False
    needs_reflectance: bool = False

    def places(self, bins: int, sensor: Sensor) -> np.ndarray:
        """The middles of the bins, in the unit of the label."""
        edges = self.edges(sensor) if callable(self.edges) else self.edges
        if edges is None:
            return np.arange(bins)
        return np.sqrt(edges[1:] * np.maximum(edges[:-1], 0.005)) if self.log else (edges[1:] + edges[:-1]) / 2


def gradient_azimuth(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """|r(h, w + 1) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    r = np.concatenate([images[:, 0], images[:, 0, :, :1]], axis=-1)  # the ring closes
    return _differences(r[..., 1:], r[..., :-1])


def gradient_elevation(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """|r(h + 1, w) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    return _differences(images[:, 0, 1:], images[:, 0, :-1])


def steps_by_sector(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """r(h, w + 1) - r(h, w) with its sign, in 13 bins, in each of 8 sectors of azimuth, (8, 13): left is not right."""
    r = images[:, 0]
    step, both = np.roll(r, -1, axis=-1) - r, (r > 0) & (np.roll(r, -1, axis=-1) > 0)
    parts = np.array_split(np.arange(r.shape[-1]), SECTORS)
    return np.stack([np.histogram(step[..., part][both[..., part]], STEPS)[0] for part in parts])


def _differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.histogram(np.abs(a - b)[(a > 0) & (b > 0)], GRADIENTS)[0]


def run_lengths(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Lengths of uninterrupted returns along the rows, weighted by length; a run may pass the ring's first column."""
    returned = (images[:, 0] > 0).reshape(-1, images.shape[-1]).astype(np.int8)
    begin = returned.argmin(1)[:, None]  # at a lost ray, where there is one
    returned = np.take_along_axis(returned, (begin + np.arange(returned.shape[1])) % returned.shape[1], 1)
    edges = np.diff(np.pad(returned, ((0, 0), (1, 1))), axis=1)
    length = np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1]
    return np.histogram(length, RUNS, weights=length)[0]


def changes_row(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Share of neighbouring pixels of each row of which only one returned, (H,)."""
    returned = images[:, 0] > 0
    return (returned != np.roll(returned, -1, axis=-1)).mean((0, 2))


def drop_range(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Share of rays lost in each of 12 logarithmic bins of range from 3 m on, (12,); 0 where a bin has no rays.

    The range of a lost ray is the mean of its neighbours' in the row; longer gaps than 16 columns are not counted.
    """
    r = images[:, 0]
    return _share(drop_rate(bridged(r, r > 0), r == 0, range_bins(sensor)))


def range_bins(sensor: Sensor) -> np.ndarray:
    """Edges of the bins of `drop_range` in metres, (13,); nearer than 3 m there is mostly the own car."""
    return np.geomspace(3.0, sensor.max_range, 13)


def drop_incidence(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Share of rays lost in each of 10 bins of the angle of incidence, (10,), which is estimated as in `drop_range`."""
    counts = np.zeros((2, len(INCIDENCES) - 1))
    for r in _chunks(images):
        _, cosine = normals(r, sensor)
        counts += drop_rate(bridged(cosine, np.isfinite(cosine)), r == 0, INCIDENCES)
    return _share(counts)


def _share(counts: np.ndarray) -> np.ndarray:
    return counts[0] / np.maximum(counts[1], 1)


def surface_normals(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Upward parts n_z of the surfaces' normals, -1 to 1, in 20 bins."""
    return np.sum([np.histogram(normals(r, sensor)[0], NORMALS)[0] for r in _chunks(images)], axis=0)


def incidence(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Cosines of the angle at which rays meet surfaces, in 20 bins."""
    return np.sum([np.histogram(normals(r, sensor)[1], COSINES)[0] for r in _chunks(images)], axis=0)


def _chunks(images: np.ndarray) -> Iterator[np.ndarray]:
    for start in range(0, len(images), AT_ONCE):
        yield images[start : start + AT_ONCE, 0]


def range_pairs(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Ranges of pixels 2.8 degrees of azimuth apart, in 16 x 16 bins of equal logarithmic width."""
    edges = np.geomspace(sensor.min_range, sensor.max_range, 17)
    return _pairs(images[:, 0], images[:, 0] > 0, edges, APART[0])


def reflectance_pairs(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Reflectances of pixels 0.7 degrees of azimuth apart, in 13 x 13 bins."""
    return _pairs(images[:, 1], images[:, 0] > 0, np.linspace(0, 1.0001, 14), APART[1])


def _pairs(x: np.ndarray, known: np.ndarray, edges: np.ndarray, parts: int) -> np.ndarray:
    by = -max(x.shape[-1] // parts, 1)
    both = known & np.roll(known, by, axis=-1)
    return np.histogram2d(x[both], np.roll(x, by, axis=-1)[both], [edges, edges])[0]


def birds_eye_density(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """How many others of its scan share a point's 1.6 m cell of the bird's-eye view, in 10 bins."""
    counts = _from_above(images, sensor)
    return np.sum([np.histogram(count, DENSITIES, weights=count)[0] for count in counts], axis=0)


def _from_above(images: np.ndarray, sensor: Sensor) -> list[np.ndarray]:
    return [birds_eye_histogram(image_to_points(image, sensor.rays())[0]) for image in images]


def range_histogram(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Ranges in 32 bins of equal logarithmic width."""
    return np.histogram(np.log(images[:, 0][images[:, 0] > 0]), _log_ranges(sensor))[0]


def _log_ranges(sensor: Sensor) -> np.ndarray:
    return np.linspace(np.log(sensor.min_range), np.log(sensor.max_range), 33)


def height_histogram(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Heights z of the points from 3.5 m below the sensor to 4 m above, in 25 cm bins."""
    z = images[:, 0] * np.sin(sensor.rays()[0].numpy())
    return np.histogram(z[images[:, 0] > 0], HEIGHTS)[0]


def mean_difference(a: np.ndarray, b: np.ndarray) -> float:
    """Mean |a - b| over the rows or bins."""
    return float(np.abs(a - b).mean())


PANEL: dict[str, Member] = {
    "gradient, azimuth": Member(gradient_azimuth, js_distance, "metres", GRADIENTS, log=True),
    "gradient, elevation": Member(gradient_elevation, js_distance, "metres", GRADIENTS, log=True),
    "steps by sector": Member(steps_by_sector, js_distance),
    "run lengths": Member(run_lengths, js_distance, "pixels", RUNS, log=True),
    "changes per row": Member(changes_row, mean_difference, "row"),
    "drop rate by range": Member(drop_range, mean_difference, "metres", range_bins, log=True),
    "drop rate by incidence": Member(drop_incidence, mean_difference, "degrees", np.linspace(90, 0, 11)),
    "surface normals": Member(surface_normals, js_distance, "upward part of the normal", NORMALS),
    "incidence": Member(incidence, js_distance, "cosine", COSINES),
    "range pairs": Member(range_pairs, js_distance),
    "reflectance pairs": Member(reflectance_pairs, js_distance, needs_reflectance=True),
    "bird's-eye density": Member(birds_eye_density, js_distance, "bin of points in a cell, 1 to over 256"),
}

# Dropped from the panel: sums over single pixels, which are the same for pixels shuffled across real scans.
PER_PIXEL: dict[str, Member] = {
    "fill per row": Member(lambda images, sensor: (images[:, 0] > 0).mean((0, 2)), mean_difference, "row"),
    "range histogram": Member(
        range_histogram, js_distance, "metres", lambda sensor: np.exp(_log_ranges(sensor)), log=True
    ),
    "reflectance histogram": Member(
        lambda images, sensor: np.histogram(images[:, 1][images[:, 0] > 0], REFLECTANCES)[0],
        js_distance, "reflectance", REFLECTANCES, needs_reflectance=True,
    ),
    "height histogram": Member(height_histogram, js_distance, "metres above the sensor", HEIGHTS),
    "bird's-eye JSD": Member(lambda images, sensor: np.sum(_from_above(images, sensor), axis=0), js_distance),
}  # fmt: skip


def panel(images: np.ndarray, sensor: Sensor, members: Mapping[str, Member] = PANEL) -> dict[str, np.ndarray]:
    """Every statistic of a set of range images, (N, 2 or 1, H, W); reflectance only where there is some."""
    chosen = {name: one for name, one in members.items() if images.shape[1] > 1 or not one.needs_reflectance}
    return {name: one.statistic(images, sensor) for name, one in chosen.items()}


def distances(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Line by line, the distance between two sets' statistics; 0 is equal."""
    known = PANEL | PER_PIXEL
    return {name: known[name].distance(a[name], b[name]) for name in a if name in b}


def controls(training: np.ndarray, sensor: Sensor, num: int, seed: int = 0) -> dict[str, np.ndarray]:
    """The sets of `r2flow.metrics.controls.Control`, (num, 2 or 1, H, W) each."""
    return {name: Control(name, training, sensor, seed).first(num) for name in CONTROLS}


def nearest(images: np.ndarray, training: np.ndarray, sensor: Sensor, leave_self: bool = False) -> np.ndarray:
    """Distance of each image to the nearest training scan, (N,): RMS difference of log-range in model space.

    Args:
        leave_self: The images are the training scans themselves: each is compared to the others.
    """
    encoding = Encoding(sensor, reflectance=False)
    a, b = (encoding.encode(torch.from_numpy(np.ascontiguousarray(x[:, :1]))).flatten(1) for x in (images, training))
    d = torch.cdist(a, b) / a.shape[1] ** 0.5
    if leave_self:
        d.fill_diagonal_(torch.inf)
    return d.min(1).values.numpy()
