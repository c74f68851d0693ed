"""The panel: distances between two sets of scans by twelve simple statistics, without networks.

Every statistic uses several pixels at a time: statistics of single pixels cannot distinguish a real
drive from pixels shuffled across the scans of another drive.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.base import Figures, SumMetric
from r2flow.metrics.jsd_mmd import js_distance
from r2flow.metrics.scans import Scans
from r2flow.metrics.surfaces import bridged, normals

# Edges of bins. Those of ranges in metres are the same for every sensor: sets of sensors with other
# limits are compared with each other.
GRADIENTS = np.concatenate([[0], np.geomspace(0.01, 80, 24)])  # metres
_STEPS = np.array([-20, -6, -2, -0.6, -0.2, -0.05, -0.02, 0.02, 0.05, 0.2, 0.6, 2, 6, 20])  # metres
RUNS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1025, 2**14 + 1])
REFLECTANCES = np.linspace(0, 1.0001, 14)
_INCIDENCES = np.cos(np.linspace(np.pi / 2, 0, 11))  # cosines, in steps of 9 degrees
_DENSITIES = np.array([0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, 64.5, 128.5, 256.5, np.inf])  # points
NORMALS = np.linspace(-1, 1, 21)
COSINES = np.linspace(0, 1, 21)
_DROPS = np.geomspace(3, 80, 13)  # metres
_RANGES = np.geomspace(1.45, 80, 17)  # metres

_SECTORS = 8
_RANGES_APART = 128  # pixels of a pair of ranges are 1/128 turn apart
_REFLECTANCES_APART = 512
_MOST_ROWS = 1024
REFLECTANCE = "reflectance pairs"  # the line that needs reflectance
LACKING = "a set has no reflectance: the panel's mean leaves reflectance pairs out."


@dataclass(frozen=True)
class Scan:
    """Range and reflectance (H, W) of one scan, 0 without a return, and its bird's-eye view."""

    r: ndarray
    q: ndarray | None
    sensor: Sensor
    birds_eye: ndarray  #: (100, 100)

    @cached_property
    def surfaces(self) -> tuple[ndarray, ndarray]:
        """z-components of the normals and cosines of the angle of incidence, (H, W) each."""
        return normals(self.r, self.sensor)


def _drop_rate(value: ndarray, missing: ndarray, edges: ndarray) -> ndarray:
    """Per bin of a value, counts of missing rays and of all, and the image's rays, (3, bins)."""
    lost, _ = np.histogram(value[missing], edges)
    rays, _ = np.histogram(value, edges)
    return np.stack([lost, rays, np.full_like(rays, value.size)])


def _differences(a: ndarray, b: ndarray) -> ndarray:
    """|a - b| over pairs of returns."""
    return np.abs(a - b)[(a > 0) & (b > 0)]


def _steps_by_sector(scan: Scan) -> ndarray:
    """Histograms of signed r(h, w + 1) - r(h, w) per azimuth sector, (8, 13).

    They distinguish left and right.
    """
    after = np.roll(scan.r, -1, -1)
    step = np.where((scan.r > 0) & (after > 0), after - scan.r, np.nan)
    return np.stack([np.histogram(part, _STEPS)[0] for part in np.array_split(step, _SECTORS, -1)])


def _run_lengths(scan: Scan) -> ndarray:
    """Lengths of runs of returns along rows, which are periodic."""
    returned = (scan.r > 0).astype(np.int8)
    columns = returned.shape[1]
    begin = returned.argmin(1)[:, None]  # at a missing ray, if any
    turned = np.take_along_axis(returned, (begin + np.arange(columns)) % columns, 1)
    edges = np.diff(np.pad(turned, ((0, 0), (1, 1))), axis=1)
    return np.asarray(np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1])


def _changes_row(scan: Scan) -> ndarray:
    """Per row, pairs of neighbours with exactly one return, all, and the image's, (3, 1024)."""
    returned = scan.r > 0
    changes = (returned != np.roll(returned, -1, -1)).sum(1)[:_MOST_ROWS]
    counts = np.zeros((3, _MOST_ROWS))
    counts[0, : len(changes)] = changes
    counts[1, : len(changes)] = returned.shape[1]
    counts[2] = returned.size
    return counts


def _drop_range(scan: Scan) -> ndarray:
    """`_drop_rate` per logarithmic bin of range, (3, 12), from 3 m, beyond the ego vehicle.

    The range of a missing ray is the mean of its neighbours in the row; gaps over 16 columns are
    not counted.
    """
    return _drop_rate(bridged(scan.r, scan.r > 0), scan.r == 0, _DROPS)


def _drop_incidence(scan: Scan) -> ndarray:
    """`_drop_rate` per bin of the angle of incidence, (3, 10), estimated as in `_drop_range`."""
    _, cosine = scan.surfaces
    return _drop_rate(bridged(cosine, np.isfinite(cosine)), scan.r == 0, _INCIDENCES)


def _pairs(x: ndarray, returned: ndarray, edges: ndarray, parts: int) -> ndarray:
    """Joint histogram of two pixels of a row, 1 / parts of a turn or one column apart."""
    by = -max(x.shape[-1] // parts, 1)
    both = returned & np.roll(returned, by, -1)
    return np.histogram2d(x[both], np.roll(x, by, -1)[both], [edges, edges])[0]


def _range_pairs(scan: Scan) -> ndarray:
    """Joint histogram of ranges of pixels 2.8 degrees or one column apart, 16 x 16 bins."""
    return _pairs(scan.r, scan.r > 0, _RANGES, _RANGES_APART)


def _reflectance_pairs(scan: Scan) -> ndarray:
    """Joint histogram of reflectances 0.7 degrees or one column apart, 13 x 13 bins; 0 without."""
    if scan.q is None:
        return np.zeros((len(REFLECTANCES) - 1) ** 2)
    return _pairs(scan.q, scan.r > 0, REFLECTANCES, _REFLECTANCES_APART)


def _rate_distance(a: ndarray, b: ndarray) -> float:
    """Distance between two sets by their shares of missing rays in bins; each set is (3, ...): the
    missing rays of a bin, all rays of it, and all pixels of the images.

    The mean over bins of |x - y| for shares x and y, 0 in an empty bin. A bin with 100 times as
    many rays of one set has no shares to compare: the distance is at least the part of that set's
    rays that are beyond this. NaN without rays.
    """
    missing_a, rays_a, pixels_a = a.reshape(3, -1)
    missing_b, rays_b, pixels_b = b.reshape(3, -1)
    difference = missing_a / np.maximum(rays_a, 1) - missing_b / np.maximum(rays_b, 1)
    distances = [np.abs(difference).mean()]
    density_a = rays_a / pixels_a
    density_b = rays_b / pixels_b
    for one, other in ((density_a, density_b), (density_b, density_a)):
        if one.any():
            distances.append(np.maximum(one - 100 * other, 0).sum() / one.sum())
    return float(max(distances)) if len(distances) > 1 else float("nan")


def _row_distance(a: ndarray, b: ndarray) -> float:
    """`_rate_distance` over the rows of the images."""
    rows = (a + b).reshape(3, -1)[1] > 0
    return _rate_distance(a.reshape(3, -1)[:, rows], b.reshape(3, -1)[:, rows])


def _reflectance_distance(a: ndarray, b: ndarray) -> float:
    """Jensen-Shannon distance; NaN if a set has no reflectance."""
    return js_distance(a, b) if a.any() and b.any() else float("nan")


class _Member(NamedTuple):
    """A statistic of the panel: counts of a scan, their number, distance of two sets' sums."""

    counts: Callable[[Scan], ndarray]
    size: int
    distance: Callable[[ndarray, ndarray], float] = js_distance


def _histogram_of(
    values: Callable[[Scan], ndarray], edges: ndarray, weighted: bool = False
) -> _Member:
    """The histogram of some values of a scan, each counted once, or as often as its value says."""

    def counts(scan):
        x = values(scan)
        return np.histogram(x, edges, weights=x if weighted else None)[0]

    return _Member(counts, len(edges) - 1)


PANEL: dict[str, _Member] = {
    # |r(h, w + 1) - r(h, w)| and |r(h + 1, w) - r(h, w)| over pairs of returns
    "gradient, azimuth": _histogram_of(
        lambda scan: _differences(np.roll(scan.r, -1, -1), scan.r), GRADIENTS
    ),
    "gradient, elevation": _histogram_of(
        lambda scan: _differences(scan.r[1:], scan.r[:-1]), GRADIENTS
    ),
    "steps by sector": _Member(_steps_by_sector, _SECTORS * (len(_STEPS) - 1)),
    "run lengths": _histogram_of(_run_lengths, RUNS, weighted=True),
    "changes per row": _Member(_changes_row, 3 * _MOST_ROWS, _row_distance),
    "drop rate by range": _Member(_drop_range, 3 * (len(_DROPS) - 1), _rate_distance),
    "drop rate by incidence": _Member(_drop_incidence, 3 * (len(_INCIDENCES) - 1), _rate_distance),
    "surface normals": _histogram_of(lambda scan: scan.surfaces[0], NORMALS),
    "incidence": _histogram_of(lambda scan: scan.surfaces[1], COSINES),
    "range pairs": _Member(_range_pairs, (len(_RANGES) - 1) ** 2),
    REFLECTANCE: _Member(_reflectance_pairs, (len(REFLECTANCES) - 1) ** 2, _reflectance_distance),
    # over points, the number of points in the same 1.6 m bird's-eye cell
    "bird's-eye density": _histogram_of(lambda scan: scan.birds_eye, _DENSITIES, weighted=True),
}
_ENDS = np.cumsum([member.size for member in PANEL.values()])


def _panel_rows(scans: Scans) -> Tensor:
    """Concatenated counts of all members per scan, (B, D) float64."""
    rows = np.zeros((len(scans), _ENDS[-1]))
    images = scans.images.cpu().numpy()
    for row, image, birds_eye in zip(rows, images, scans.birds_eye, strict=True):
        q = image[1] if scans.has_reflectance else None
        scan = Scan(image[0], q, scans.sensor, birds_eye)
        row[:] = np.concatenate([member.counts(scan).ravel() for member in PANEL.values()])
    return torch.from_numpy(rows)


def panel(images: ndarray, sensor: Sensor) -> ndarray:
    """Summed counts (D,) of a set of range images (N, 2 or 1, H, W), for `distances`."""
    batches = torch.from_numpy(np.ascontiguousarray(images)).split(32)
    return np.sum([_panel_rows(Scans(batch, sensor)).sum(0).numpy() for batch in batches], axis=0)


def distances(a: ndarray, b: ndarray) -> Figures:
    """Distance per member between the counts of two sets, (D,) each.

    0 if equal, NaN if neither has any.
    """
    found = {}
    counts = zip(np.split(a, _ENDS[:-1]), np.split(b, _ENDS[:-1]), strict=True)
    for (name, member), (x, y) in zip(PANEL.items(), counts, strict=True):
        found[name] = member.distance(x, y) if (x + y).any() else float("nan")
    return found


def mean_distance(lines: Figures) -> float:
    """Mean over members, without NaN."""
    values = list(lines.values())
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


class Panel(SumMetric):
    """Distance of each member of the panel, and their mean, `panel`."""

    name = "panel"
    representation = "range image"
    settings: ClassVar = {
        "members": list(PANEL),
        "ranges": [1.45, 80],
        "distance": "Jensen-Shannon distance of histograms, |a - b| of rates or a over 100 b",
    }
    width = int(_ENDS[-1])
    uses_reflectance = True
    biased = True

    def rows(self, scans: Scans) -> Tensor:
        return scans.nan_where_empty(_panel_rows(scans))

    def figures_of(self, real: ndarray, generated: ndarray) -> Figures:
        if not (real.any() and generated.any()):
            return dict.fromkeys(("panel", *PANEL), float("nan"))
        lines = distances(real, generated)
        if np.isnan(lines[REFLECTANCE]):
            self.remarks.append(LACKING)
        return {"panel": mean_distance(lines), **lines}
