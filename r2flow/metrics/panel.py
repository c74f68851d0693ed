"""The panel: distances between two sets of scans by twelve plain statistics, which need no network.

Every statistic looks at more than one pixel at a time: those of single pixels cannot tell a real drive from pixels
shuffled across the scans of another.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.base import SIDES
from r2flow.metrics.birds_eye import js_distance
from r2flow.metrics.scans import Scans
from r2flow.metrics.sums import SumMetric
from r2flow.metrics.surfaces import bridged, drop_rate, normals

GRADIENTS = np.concatenate([[0], np.geomspace(0.01, 80, 24)])  # metres
STEPS, SECTORS = np.array([-20, -6, -2, -0.6, -0.2, -0.05, -0.02, 0.02, 0.05, 0.2, 0.6, 2, 6, 20]), 8  # metres
RUNS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 256, 512, 1025, 2**14 + 1])  # pixels
REFLECTANCES = np.linspace(0, 1.0001, 14)
INCIDENCES = np.cos(np.linspace(np.pi / 2, 0, 11))  # cosines, in steps of 9 degrees
DENSITIES = np.array([0.5, 1.5, 2.5, 4.5, 8.5, 16.5, 32.5, 64.5, 128.5, 256.5, np.inf])  # points
NORMALS, COSINES = np.linspace(-1, 1, 21), np.linspace(0, 1, 21)
APART = 128, 512  # parts of a turn between the two pixels of a pair: of ranges, of reflectances
DROPS, PAIRS = 12, 16  # bins of range
MOST_ROWS = 256


@dataclass(frozen=True)
class Scan:
    """One scan: range and reflectance (H, W) of a sensor, 0 without a return, and its bird's-eye counts, (100, 100)."""

    r: np.ndarray
    q: np.ndarray | None
    sensor: Sensor
    birds_eye: np.ndarray

    @cached_property
    def surfaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Upward parts of the normals, and cosines of the angle of incidence, (1, H, W) each."""
        return normals(self.r[None], self.sensor)


def histogram(x: np.ndarray, edges: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Counts of values in [a, b) for each bin, (bins,); as numpy's, but faster for few bins."""
    place = np.searchsorted(edges[:-1], x, side="right") - 1
    held = (place >= 0) & (x <= edges[-1])
    return np.bincount(place[held], None if weights is None else weights[held], len(edges) - 1)


def gradient_azimuth(scan: Scan) -> np.ndarray:
    """|r(h, w + 1) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    return _differences(np.roll(scan.r, -1, -1), scan.r)


def gradient_elevation(scan: Scan) -> np.ndarray:
    """|r(h + 1, w) - r(h, w)| between neighbours that both returned, in logarithmic bins of metres."""
    return _differences(scan.r[1:], scan.r[:-1])


def _differences(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return histogram(np.abs(a - b)[(a > 0) & (b > 0)], GRADIENTS)


def steps_by_sector(scan: Scan) -> np.ndarray:
    """r(h, w + 1) - r(h, w) with its sign, in 13 bins, in each of 8 sectors of azimuth, (8, 13): left is not right."""
    after = np.roll(scan.r, -1, -1)
    step, both = after - scan.r, (scan.r > 0) & (after > 0)
    parts = np.array_split(np.arange(scan.r.shape[-1]), SECTORS)
    return np.stack([histogram(step[:, part][both[:, part]], STEPS) for part in parts])


def run_lengths(scan: Scan) -> np.ndarray:
    """Lengths of uninterrupted returns along the rows, weighted by length; a run may pass the ring's first column."""
    returned = (scan.r > 0).astype(np.int8)
    begin = returned.argmin(1)[:, None]  # at a lost ray, where there is one
    returned = np.take_along_axis(returned, (begin + np.arange(returned.shape[1])) % returned.shape[1], 1)
    edges = np.diff(np.pad(returned, ((0, 0), (1, 1))), axis=1)
    length = np.nonzero(edges < 0)[1] - np.nonzero(edges > 0)[1]
    return histogram(length, RUNS, length)


def changes_row(scan: Scan) -> np.ndarray:
    """Neighbouring pixels of each row of which only one returned, and all, (2, H)."""
    returned = scan.r > 0
    changed = (returned != np.roll(returned, -1, -1)).sum(1)
    return np.stack([changed, np.full_like(changed, returned.shape[1])])


def drop_range(scan: Scan) -> np.ndarray:
    """Rays lost, and all, in each of 12 logarithmic bins of range from 3 m on, (2, 12): nearer is mostly the own car.

    The range of a lost ray is the mean of its neighbours' in the row; longer gaps than 16 columns are not counted.
    """
    edges = np.geomspace(3.0, scan.sensor.max_range, DROPS + 1)
    return drop_rate(bridged(scan.r, scan.r > 0), scan.r == 0, edges)


def drop_incidence(scan: Scan) -> np.ndarray:
    """Rays lost, and all, in each of 10 bins of the angle of incidence, (2, 10), estimated as in `drop_range`."""
    cosine = scan.surfaces[1][0]
    return drop_rate(bridged(cosine, np.isfinite(cosine)), scan.r == 0, INCIDENCES)


def surface_normals(scan: Scan) -> np.ndarray:
    """Upward parts n_z of the surfaces' normals, -1 to 1, in 20 bins."""
    return histogram(scan.surfaces[0].ravel(), NORMALS)


def incidence(scan: Scan) -> np.ndarray:
    """Cosines of the angle at which rays meet surfaces, in 20 bins."""
    return histogram(scan.surfaces[1].ravel(), COSINES)


def range_pairs(scan: Scan) -> np.ndarray:
    """Ranges of pixels 2.8 degrees of azimuth apart, in 16 x 16 bins of equal logarithmic width."""
    return _pairs(scan.r, scan.r > 0, np.geomspace(scan.sensor.min_range, scan.sensor.max_range, PAIRS + 1), APART[0])


def reflectance_pairs(scan: Scan) -> np.ndarray:
    """Reflectances of pixels 0.7 degrees of azimuth apart, in 13 x 13 bins; 0 without reflectance."""
    if scan.q is None:
        return np.zeros((len(REFLECTANCES) - 1) ** 2)
    return _pairs(scan.q, scan.r > 0, REFLECTANCES, APART[1])


def _pairs(x: np.ndarray, returned: np.ndarray, edges: np.ndarray, parts: int) -> np.ndarray:
    bins, by = len(edges) - 1, -max(x.shape[-1] // parts, 1)
    place = np.searchsorted(edges, x, side="right") - 1
    inside = returned & (place >= 0) & (place < bins)
    both = inside & np.roll(inside, by, -1)
    return np.bincount((place * bins + np.roll(place, by, -1))[both], minlength=bins * bins)


def birds_eye_density(scan: Scan) -> np.ndarray:
    """How many others of its scan share a point's 1.6 m cell of the bird's-eye view, in 10 bins."""
    return histogram(scan.birds_eye.ravel(), DENSITIES, scan.birds_eye.ravel())


@dataclass(frozen=True)
class Member:
    """A statistic of the panel.

    Attributes:
        counts: Of one scan; added up over a set.
        size: Of the counts; None for two counts for each row of the image.
        is_rate: The counts are (lost, all) in each bin: their ratios are compared by mean |a - b|. Otherwise they are
            a histogram, compared by Jensen-Shannon distance.
        needs_reflectance: Without it in a set there is no distance.
    """

    counts: Callable[[Scan], np.ndarray]
    size: int | None
    is_rate: bool = False
    needs_reflectance: bool = False

    def distance(self, a: np.ndarray, b: np.ndarray) -> float:
        """Between the counts of two sets; NaN where one has no reflectance."""
        if self.needs_reflectance and not (a.any() and b.any()):
            return float("nan")
        if not self.is_rate:
            return js_distance(a, b)
        x, y = (lost / np.maximum(rays, 1) for lost, rays in (a.reshape(2, -1), b.reshape(2, -1)))
        return float(np.abs(x - y).mean())


PANEL: dict[str, Member] = {
    "gradient, azimuth": Member(gradient_azimuth, len(GRADIENTS) - 1),
    "gradient, elevation": Member(gradient_elevation, len(GRADIENTS) - 1),
    "steps by sector": Member(steps_by_sector, SECTORS * (len(STEPS) - 1)),
    "run lengths": Member(run_lengths, len(RUNS) - 1),
    "changes per row": Member(changes_row, None, is_rate=True),
    "drop rate by range": Member(drop_range, 2 * DROPS, is_rate=True),
    "drop rate by incidence": Member(drop_incidence, 2 * (len(INCIDENCES) - 1), is_rate=True),
    "surface normals": Member(surface_normals, len(NORMALS) - 1),
    "incidence": Member(incidence, len(COSINES) - 1),
    "range pairs": Member(range_pairs, PAIRS**2),
    "reflectance pairs": Member(reflectance_pairs, (len(REFLECTANCES) - 1) ** 2, needs_reflectance=True),
    "bird's-eye density": Member(birds_eye_density, len(DENSITIES) - 1),
}
FIXED = sum(member.size or 0 for member in PANEL.values())


def row_of(scan: Scan) -> np.ndarray:
    """The counts of all members one after the other, (D,); D depends on the number of rows."""
    return np.concatenate([member.counts(scan).ravel() for member in PANEL.values()]).astype(np.float64)


def panel_rows(scans: Scans) -> Tensor:
    """`row_of` each scan, (B, D) float64."""
    images, above = scans.images.cpu().numpy(), scans.birds_eye
    rows = [
        row_of(Scan(image[0], image[1] if scans.has_reflectance else None, scans.sensor, counts))
        for image, counts in zip(images, above, strict=True)
    ]
    return torch.from_numpy(np.stack(rows)) if rows else torch.zeros(0, FIXED + 2 * scans.sensor.shape[0])


def panel(images: np.ndarray, sensor: Sensor) -> np.ndarray:
    """The counts of a set of range images (N, 2 or 1, H, W), (D,), for `distances`."""
    batches = torch.from_numpy(np.ascontiguousarray(images)).split(32)
    return np.sum([panel_rows(Scans(batch, sensor)).sum(0).numpy() for batch in batches], axis=0)


def distances(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """The distance of each member between the counts of two sets, (D,) each; 0 is equal."""
    rows = len(a) - FIXED  # two counts a row
    ends = np.cumsum([rows if member.size is None else member.size for member in PANEL.values()])[:-1]
    parts = zip(PANEL.items(), np.split(a, ends), np.split(b, ends), strict=True)
    return {name: member.distance(x, y) for (name, member), x, y in parts}


def mean_distance(lines: Mapping[str, float] | Sequence[float]) -> float:
    """The panel's mean over the members that both sets have."""
    values = list(lines.values()) if isinstance(lines, Mapping) else list(lines)
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


class Panel(SumMetric):
    """The distance of each member of the panel, and their mean as `panel`."""

    name = "panel"
    representation = "range image"
    settings: ClassVar[Mapping[str, Any]] = {
        "members": list(PANEL), "distance": "Jensen-Shannon distance of histograms, mean |a - b| of rates"
    }  # fmt: skip
    width = FIXED + 2 * MOST_ROWS
    uses_reflectance = True
    resamples = False  # |a - b| of rates has a kink where the sets are nearly equal

    def rows(self, scans: Scans) -> Tensor:
        returned = scans.returned.flatten(1).any(1).cpu()
        return torch.where(returned[:, None], panel_rows(scans), torch.nan)

    def figures_of(self, real: np.ndarray, generated: np.ndarray) -> dict[str, float]:
        if not (real.any() and generated.any()):
            return dict.fromkeys(("panel", *PANEL), float("nan"))
        lines = distances(real, generated)
        return {"panel": mean_distance(lines), **lines}

    def figures(self) -> tuple[dict[str, float], list[str]]:
        values, remarks = super().figures()
        if np.isnan(values["reflectance pairs"]) and all(self.count(side) for side in SIDES):
            remarks.append("reflectance pairs: no figure: a set has no reflectance; the panel's mean leaves them out.")
        return values, remarks
