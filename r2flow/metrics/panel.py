"""The panel: distances between two sets of scans by twelve simple statistics, without networks.

Every statistic uses several pixels at a time: statistics of single pixels cannot distinguish a real drive from pixels
shuffled across the scans of another drive.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.base import SIDES
from r2flow.metrics.birds_eye import js_distance
from r2flow.metrics.extractors.base import nan_where_empty
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric
from r2flow.metrics.surfaces import bridged, normals

GRADIENTS = np.concatenate([[0], np.geomspace(0.01, 80, 24)])  # metres
STEPS, SECTORS = np.array([-20, -6, -2, -0.6, -0.2, -0.05, -0.02, 0.02, 0.05, 0.2, 0.6, 2, 6, 20]), 8  # metres
RUNS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1025, 2**14 + 1])  # pixels
REFLECTANCES = np.linspace(0, 1.0001, 14)
INCIDENCES = np.cos(np.linspace(np.pi / 2, 0, 11))  # cosines, in steps of 9 degrees
DENSITIES = np.array([0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, 64.5, 128.5, 256.5, np.inf])  # points
NORMALS, COSINES = np.linspace(-1, 1, 21), np.linspace(0, 1, 21)
APART = 128, 512  # pixels of a pair are 1/128 and 1/512 turn apart: range, reflectance
# Ranges in metres, the same for every sensor: sets of sensors with other limits are compared with each other.
DROPS, RANGES = np.geomspace(3, 80, 13), np.geomspace(1.45, 80, 17)
MOST_ROWS = 1024
REFLECTANCE = "reflectance pairs"  # the line that needs reflectance
LACKING = "a set has no reflectance: the panel's mean leaves reflectance pairs out."


@dataclass(frozen=True)
class Scan:
    """Range and reflectance (H, W) of one scan, 0 without a return, and its bird's-eye histogram, (100, 100)."""

    r: np.ndarray
    q: np.ndarray | None
    sensor: Sensor
    birds_eye: np.ndarray

    @cached_property
    def surfaces(self) -> tuple[np.ndarray, np.ndarray]:
        """z-components of the normals and cosines of the angle of incidence, (H, W) each."""
        return normals(self.r, self.sensor)


def histogram(x: np.ndarray, edges: np.ndarray, weighted: bool = False) -> np.ndarray:
    """Counts, or sums, of values in [a, b) per bin, (bins,), without NaN; like numpy's, faster for few bins."""
    place = np.searchsorted(edges[:-1], x, side="right") - 1
    inside = (place >= 0) & (x <= edges[-1])
    return np.bincount(place[inside], x[inside] if weighted else None, len(edges) - 1)


def drop_rate(value: np.ndarray, missing: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Per bin of a value, counts of missing rays and of all rays, and the rays of the image, (3, bins)."""
    return np.stack([histogram(value[missing], edges), histogram(value, edges), np.full(len(edges) - 1, value.size)])


def differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a - b| over pairs of returns."""
    return np.abs(a - b)[(a > 0) & (b > 0)]


def steps_by_sector(scan: Scan) -> np.ndarray:
    """Histograms of signed r(h, w + 1) - r(h, w) per azimuth sector, (8, 13), which distinguish left and right."""
    after = np.roll(scan.r, -1, -1)
    step, both = after - scan.r, (scan.r > 0) & (after > 0)
    parts = np.array_split(np.arange(scan.r.shape[-1]), SECTORS)
    return np.stack([histogram(step[:, part][both[:, part]], STEPS) for part in parts])


def run_lengths(scan: Scan) -> np.ndarray:
    """Lengths of runs of returns along rows, which are periodic."""
    returned = (scan.r > 0).astype(np.int8)
    begin = returned.argmin(1)[:, None]  # at a missing ray, if any
    returned = np.take_along_axis(returned, (begin + np.arange(returned.shape[1])) % returned.shape[1], 1)
    edges = np.diff(np.pad(returned, ((0, 0), (1, 1))), axis=1)
    return np.asarray(np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1])


def changes_row(scan: Scan) -> np.ndarray:
    """Per row, pairs of neighbours with exactly one return, all, and those of the image, (3, 1024); none beyond."""
    returned = scan.r > 0
    changes = (returned != np.roll(returned, -1, -1)).sum(1)[:MOST_ROWS]
    counts = np.zeros((3, MOST_ROWS))
    counts[0, : len(changes)], counts[1, : len(changes)], counts[2] = changes, returned.shape[1], returned.size
    return counts


def drop_range(scan: Scan) -> np.ndarray:
    """`drop_rate` per logarithmic bin of range, (3, 12), from 3 m, beyond the ego vehicle.

    The range of a missing ray is the mean of its neighbours in the row; gaps over 16 columns are not counted.
    """
    return drop_rate(bridged(scan.r, scan.r > 0), scan.r == 0, DROPS)


def drop_incidence(scan: Scan) -> np.ndarray:
    """`drop_rate` per bin of the angle of incidence, (3, 10), estimated as in `drop_range`."""
    _, cosine = scan.surfaces
    return drop_rate(bridged(cosine, np.isfinite(cosine)), scan.r == 0, INCIDENCES)


def reflectance_pairs(scan: Scan) -> np.ndarray:
    """Joint histogram of reflectances of pixels 0.7 degrees or one column apart, 13 x 13 bins; 0 without."""
    if scan.q is None:
        return np.zeros((len(REFLECTANCES) - 1) ** 2)
    return _pairs(scan.q, scan.r > 0, REFLECTANCES, APART[1])


def _pairs(x: np.ndarray, returned: np.ndarray, edges: np.ndarray, parts: int) -> np.ndarray:
    bins, by = len(edges) - 1, -max(x.shape[-1] // parts, 1)
    place = np.searchsorted(edges, x, side="right") - 1
    inside = returned & (place >= 0) & (place < bins)
    both = inside & np.roll(inside, by, -1)
    return np.bincount((place * bins + np.roll(place, by, -1))[both], minlength=bins * bins)


def rate_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean |x - y| of rates over bins of counts (missing, all, of images), 0 if empty; at least `lacking`, else NaN."""
    sets = a.reshape(3, -1), b.reshape(3, -1)
    (x, p), (y, q) = ((lost / np.maximum(rays, 1), rays / pixels) for lost, rays, pixels in sets)
    # Share of a set's rays beyond 100 times the other's in their bin, which have no rate to compare: 1 if it has none.
    lacking = [np.maximum(u - 100 * v, 0).sum() / u.sum() for u, v in ((p, q), (q, p)) if u.any()]
    return float(max([np.abs(x - y).mean(), *lacking])) if lacking else float("nan")


def row_distance(a: np.ndarray, b: np.ndarray) -> float:
    """`rate_distance` over the rows of the images."""
    rows = (a + b).reshape(3, -1)[1] > 0
    return rate_distance(a.reshape(3, -1)[:, rows], b.reshape(3, -1)[:, rows])


def reflectance_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Jensen-Shannon distance; NaN if a set has no reflectance."""
    return js_distance(a, b) if a.any() and b.any() else float("nan")


class Member(NamedTuple):
    """A statistic of the panel: counts of one scan, their number, and the distance between sums of two sets."""

    counts: Callable[[Scan], np.ndarray]
    size: int
    distance: Callable[[np.ndarray, np.ndarray], float] = js_distance


def histogram_of(values: Callable[[Scan], np.ndarray], edges: np.ndarray, weighted: bool = False) -> Member:
    """The histogram of some values of a scan, each counted once, or as often as its value says."""
    return Member(lambda scan: histogram(values(scan).ravel(), edges, weighted), len(edges) - 1)


PANEL: dict[str, Member] = {
    # |r(h, w + 1) - r(h, w)| and |r(h + 1, w) - r(h, w)| over pairs of returns, logarithmic bins in metres
    "gradient, azimuth": histogram_of(lambda scan: differences(np.roll(scan.r, -1, -1), scan.r), GRADIENTS),
    "gradient, elevation": histogram_of(lambda scan: differences(scan.r[1:], scan.r[:-1]), GRADIENTS),
    "steps by sector": Member(steps_by_sector, SECTORS * (len(STEPS) - 1)),
    "run lengths": histogram_of(run_lengths, RUNS, weighted=True),
    "changes per row": Member(changes_row, 3 * MOST_ROWS, row_distance),
    "drop rate by range": Member(drop_range, 3 * (len(DROPS) - 1), rate_distance),
    "drop rate by incidence": Member(drop_incidence, 3 * (len(INCIDENCES) - 1), rate_distance),
    "surface normals": histogram_of(lambda scan: scan.surfaces[0], NORMALS),
    "incidence": histogram_of(lambda scan: scan.surfaces[1], COSINES),
    # joint histogram of ranges of pixels 2.8 degrees or one column apart, 16 x 16 logarithmic bins
    "range pairs": Member(lambda scan: _pairs(scan.r, scan.r > 0, RANGES, APART[0]), (len(RANGES) - 1) ** 2),
    REFLECTANCE: Member(reflectance_pairs, (len(REFLECTANCES) - 1) ** 2, reflectance_distance),
    # over points, the number of points in the same 1.6 m bird's-eye cell
    "bird's-eye density": histogram_of(lambda scan: scan.birds_eye, DENSITIES, weighted=True),
}
ENDS = np.cumsum([member.size for member in PANEL.values()])


def panel_rows(scans: Scans) -> Tensor:
    """Concatenated counts of all members per scan, (B, D) float64."""
    rows = np.zeros((len(scans), ENDS[-1]))
    for row, image, counts in zip(rows, scans.images.cpu().numpy(), scans.birds_eye, strict=True):
        scan = Scan(image[0], image[1] if scans.has_reflectance else None, scans.sensor, counts)
        row[:] = np.concatenate([member.counts(scan).ravel() for member in PANEL.values()])
    return torch.from_numpy(rows)


def panel(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Summed counts (D,) of a set of range images (N, 2 or 1, H, W), for `distances`."""
    batches = torch.from_numpy(np.ascontiguousarray(images)).split(32)
    return np.sum([panel_rows(Scans(batch, sensor)).sum(0).numpy() for batch in batches], axis=0)


def distances(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Distance per member between the counts of two sets, (D,) each; 0 if equal, NaN if neither has any."""
    parts = zip(PANEL.items(), np.split(a, ENDS[:-1]), np.split(b, ENDS[:-1]), strict=True)
    return {name: member.distance(x, y) if (x + y).any() else float("nan") for (name, member), x, y in parts}


def mean_distance(lines: Mapping[str, float]) -> float:
    """Mean over members, without NaN."""
    values = list(lines.values())
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


class Panel(SumMetric):
    """Distance of each member of the panel, and their mean, `panel`."""

    name = "panel"
    representation = "range image"
    settings: ClassVar[Mapping[str, Any]] = {
        "members": list(PANEL), "ranges": [1.45, 80],
        "distance": "Jensen-Shannon distance of histograms, |a - b| of rates or a over 100 b",
    }  # fmt: skip
    width = int(ENDS[-1])
    uses_reflectance = True
    biased = True

    def rows(self, scans: Scans) -> Tensor:
        if self.name not in scans.features:
            scans.features[self.name] = nan_where_empty(panel_rows(scans), scans)
        return scans.features[self.name]

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        if not (real.any() and generated.any()):
            return dict.fromkeys(("panel", *PANEL), float("nan"))
        lines = distances(real, generated)
        return {"panel": mean_distance(lines), **lines}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        if np.isnan(values[REFLECTANCE]) and all(self.count(side) for side in SIDES):
            remarks.append(LACKING)
        return values, remarks
