"""Copy detection: distance of generated scans to the nearest training scan, up to symmetries.

A scan is described by its log-range in model space, averaged over cells, x (h, w). The distance to
a training scan y is the minimum over shifts u of the w columns, and over y and its mirror image,

    d^2(x, y) = min_u (|x|^2 + |y|^2 - 2 c(u)) / (h w),        c(u) = sum_ij x_ij y_i(j+u),

with c by FFT along the rows. The test compares the distances of generated and real scans as in
Meehan et al. (2020), "A non-parametric test to detect data-copying in generative models".
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace

import numpy as np
import torch
from numpy import ndarray
from scipy.stats import mannwhitneyu
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from r2flow.base.errors import InputError
from r2flow.data.sets import ScanSet
from r2flow.evaluation.comparing import Comparison, Comparisons
from r2flow.evaluation.measuring import MetricResult, Work, bar
from r2flow.evaluation.sets import HALVES
from r2flow.lidar.encoding import Encoding
from r2flow.metrics.base import Protocol
from r2flow.metrics.scans import Scans

_CELLS = (16, 128)  # maximum rows and columns of cells
_SAME = 5e-3  # largest distance of equal scans, whose files may be rounded; other frames have 0.1
_PAIRS = {"cpu": 1024, "cuda": 131072}  # pairs per block, by device: sized for the CPU's cache


def _described(
    scans: ScanSet, training: ScanSet, work: Work, device: str, doing: str
) -> Iterator[Tensor]:
    """Yield log-range, as of training scans, averaged over cells, (B, h, w).

    NaN for a scan without returns.
    """
    cells = np.minimum(_CELLS, scans.sensor.shape).tolist()
    encoding = Encoding(training.sensor, reflectance=False)  # a model's limits may be others
    with torch.no_grad(), bar(doing, len(scans)) as advance:
        for images in scans.batches(range(len(scans)), work.batch_size, work.workers):
            batch = Scans(images.to(device), scans.sensor)
            mean = adaptive_avg_pool2d(encoding.encode(batch.images[:, :1]), cells)[:, 0]
            yield torch.where(batch.nonempty[:, None, None], mean, torch.nan)
            advance(len(images))


class _Nearest:
    """Distances of the scans of a set, those with returns, to the training scans compared so far.

    Raises:
        InputError: No scan has a return.
    """

    def __init__(self, scans: ScanSet, training: ScanSet, work: Work, device: str) -> None:
        x = torch.cat(list(_described(scans, training, work, device, "describing")))
        usable = x.isfinite().flatten(1).all(1)
        if not usable.any():
            raise InputError(
                f"none of the {len(scans)} scans of {scans.label} has a return to compare."
            )
        self.training = training
        self._x = x[usable]
        self._squared = self._x.new_full((len(self._x),), torch.inf)  # d^2 to the nearest, (N,)
        self._spectra = -2 * torch.fft.rfft(self._x).conj().permute(2, 0, 1).contiguous()

    def approach(self, y: Tensor) -> None:
        """Update with more training scans, (M, h, w); a scan of NaN is never nearest."""
        width = y.shape[2]
        both = torch.cat([y, y.flip(-1)])
        energy = both.square().sum((1, 2)).nan_to_num(torch.inf)
        spectra = torch.fft.rfft(both.nan_to_num(0.0)).permute(2, 1, 0).contiguous()  # (K, h, 2 M)
        columns = torch.arange(width, device=y.device)
        block = max(_PAIRS.get(y.device.type, 1024) // len(y), 1)
        for start in range(0, len(self._x), block):
            at = slice(start, start + block)
            # -2 c(u), (w, n, 2 M)
            d = torch.fft.irfft(self._spectra[:, at] @ spectra, n=width, dim=0)
            curve, turns = d.min(0)
            place = (curve + energy).argmin(1)
            shifted = ((turns.gather(1, place[:, None]) + columns) % width)[:, None]
            turned = both[place].gather(2, shifted.expand(-1, y.shape[1], -1))
            # The curve of a copy has 1e-8, by rounding.
            squared = (self._x[at] - turned).square().mean((1, 2))
            self._squared[at] = self._squared[at].fmin(squared)

    @property
    def distances(self) -> ndarray:
        """Distance of each scan to its nearest training scan, (N,)."""
        return self._squared.double().sqrt().cpu().numpy()


def find_nearest(
    sets: Mapping[str, ScanSet], training: ScanSet, work: Work, device: str = "cpu"
) -> dict[str, _Nearest]:
    """Find the nearest training scan of each scan of several sets.

    Reads training scans once, without storing them.
    """
    nearest = {name: _Nearest(scans, training, work, device) for name, scans in sets.items()}
    for y in _described(training, training, work, device, "reading training scans"):
        for one in nearest.values():
            one.approach(y)
    return nearest


def _copies_result(judged: _Nearest, real: _Nearest) -> MetricResult:
    """Median distance to the nearest training scan, and P(a scan's distance < a real scan's).

    The latter is 0.5 by chance. Real scans that are training scans are left out. A small p of the
    one-sided Mann-Whitney U does not prove copying: scans that resemble training streets are nearer
    without being copies, and frames of one drive are not independent.
    """
    others = real.distances[real.distances >= _SAME]
    same = len(real.distances) - len(others)
    d = others if judged is real and len(others) else judged.distances
    figures = {"copies": float(np.median(d))}
    remarks = []
    if judged is not real and same:
        scans = f"{same} of {len(real.distances)} real scans"
        remarks.append(f"copies: {scans} are training scans, and left out.")
    if judged is not real and len(others):
        test = mannwhitneyu(others, d, alternative="greater")
        nearer = float(test.statistic) / (len(d) * len(others))
        figures["copies_nearer"] = nearer
        remarks.append(
            f"copies: {(d < others.min()).sum()} of {len(d)} scans lie nearer to a training scan "
            f"than any of {len(others)} real ones, {len(d) / (len(others) + 1):.2g} expected; "
            f"nearer in {nearer:.0%} of all pairs (p = {test.pvalue:.2g})."
        )
    settings = {
        "cells": list(_CELLS),
        "turned": True,
        "mirrored": True,
        "training scans": len(real.training),
    }
    sizes = {"real": len(real.distances), "real_chosen": "all", "generated": len(d)}
    protocol = asdict(Protocol("copies", "log-range of cells", settings=settings))
    return MetricResult("copies", figures, {**protocol, "sizes": sizes}, None, remarks)


def with_copies(
    comparisons: Comparisons, nearest: Mapping[str, _Nearest], real: _Nearest
) -> list[Comparison]:
    """Add a result to each judged set in `nearest`, and that of the real scans to halves."""
    of = {("judged", name): neighbours for name, neighbours in nearest.items()}
    of["reference", HALVES] = real
    extended = []
    for row in comparisons:
        judged = of.get((row.kind, row.name))
        more = [] if judged is None else [_copies_result(judged, real)]
        extended.append(replace(row, measured=[*row.measured, *more]))
    return extended
