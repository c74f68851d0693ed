"""Distance of generated scans to the nearest training scan, turned or mirrored: what is memorised?

A scan is its log-range in model space, averaged over cells, x (h, w). The distance to a training scan y is the least
over the turns u of its w columns, and over y and its mirror image,

    d^2(x, y) = min_u (|x|^2 + |y|^2 - 2 c(u)) / (h w),        c(u) = sum_ij x_ij y_i(j+u),

with c by FFT along the rows. How many generated scans are nearer than real ones is tested as data copying is by Meehan
et al. (2020), "A non-parametric test to detect data-copying in generative models".
"""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError
from r2flow.evaluation.measuring import MetricResult, Work, bar
from r2flow.lidar.encoding import Encoding
from r2flow.metrics.base import Protocol
from r2flow.metrics.scans import Scans

CELLS = (16, 128)  # rows and columns of cells, at most
PAIRS = {"cpu": 1024, "cuda": 131072}  # compared together: on a CPU what is made of them fits into a cache


def described(scans: ScanSet, work: Work, device: str, doing: str) -> Iterator[Tensor]:
    """Log-range averaged over cells, (B, h, w), batch by batch; NaN for a scan without a return."""
    rows, columns = scans.sensor.shape
    encoding = Encoding(scans.sensor, reflectance=False)
    with torch.no_grad(), bar(doing, len(scans)) as advance:
        for images in scans.batches(range(len(scans)), work.batch_size, work.workers):
            seen = Scans(images.to(device), scans.sensor)
            mean = adaptive_avg_pool2d(
                encoding.encode(seen.images[:, :1]), (min(CELLS[0], rows), min(CELLS[1], columns))
            )[:, 0]
            yield torch.where(seen.returned.flatten(1).any(1)[:, None, None], mean, torch.nan)
            advance(len(images))


class Nearest:
    """The nearest training scan of each scan of a set, of those that were compared so far.

    `numbers` are the scans that have a return, (N,), `squared` d^2 to the nearest training scan, `neighbours` these
    training scans, and `turns` by how many cells they are turned: negative, -1 - u, where they are mirrored first.
    """

    def __init__(self, scans: ScanSet, work: Work, device: str) -> None:
        x = torch.cat(list(described(scans, work, device, "describing")))
        kept = x.isfinite().flatten(1).all(1)
        if not kept.any():
            raise InputError(f"none of the {len(scans)} scans of {scans.label} has a return to compare.")
        self.scans, self.numbers, x = scans, np.flatnonzero(kept.cpu().numpy()), x[kept]
        self.width, self.elements = x.shape[2], x[0].numel()
        self.size = x.square().sum((1, 2))
        self.spectra = -2 * torch.fft.rfft(x).conj().permute(2, 0, 1).contiguous()  # (K, N, h)
        self.squared = torch.full_like(self.size, torch.inf)
        self.neighbours, self.turns = (torch.zeros_like(self.size, dtype=torch.long) for _ in range(2))

    def approach(self, y: Tensor, first: int) -> None:
        """Compare with training scans `first`, `first + 1`, ..., (M, h, w); a scan of NaN is never nearest."""
        both, m = torch.cat([y, y.flip(-1)]), len(y)
        energy = both.square().sum((1, 2)).nan_to_num(torch.inf)
        spectra = torch.fft.rfft(both.nan_to_num(0.0)).permute(2, 1, 0).contiguous()  # (K, h, 2 M)
        block = max(PAIRS.get(y.device.type, 1024) // m, 1)
        for start in range(0, len(self.numbers), block):
            at = slice(start, start + block)
            d = torch.fft.irfft(self.spectra[:, at] @ spectra, n=self.width, dim=0)  # -2 c(u), (w, n, 2 M)
            curve, turn = d.min(0)
            least, place = (curve + energy).min(1)
            squared = ((least + self.size[at]) / self.elements).clamp(min=0)
            turn = turn.gather(1, place[:, None])[:, 0]
            nearer = squared < self.squared[at]
            for held, new in (
                (self.squared, squared), (self.neighbours, first + place % m),
                (self.turns, torch.where(place < m, turn, -1 - turn)),
            ):  # fmt: skip
                held[at] = torch.where(nearer, new, held[at])

    @property
    def distances(self) -> np.ndarray:
        """Of every scan to its nearest, (N,)."""
        found: np.ndarray = self.squared.double().sqrt().cpu().numpy()
        return found

    def match(self, place: int, training: ScanSet) -> np.ndarray:
        """The training scan that is nearest to a scan, turned as it is, as an image."""
        image, turn = training.source[int(self.neighbours[place])], int(self.turns[place])
        if turn < 0:
            image, turn = image[..., ::-1], -1 - turn
        return np.roll(image, -round(turn * image.shape[-1] / self.width), axis=-1)


def find_nearest(sets: Mapping[str, ScanSet], training: ScanSet, work: Work, device: str = "cpu") -> dict[str, Nearest]:
    """The nearest training scan of each scan of several sets; training scans are read once and none is kept."""
    if not len(training):
        raise InputError(f"{training.label} holds no training scan.")
    nearest = {name: Nearest(scans, work, device) for name, scans in sets.items()}
    first = 0
    for y in described(training, work, device, "reading training scans"):
        for one in nearest.values():
            one.approach(y, first)
        first += len(y)
    return nearest


def copies_result(judged: Nearest, real: Nearest, training: int) -> MetricResult:
    """Median distance to the nearest training scan, and how often a scan is nearer than a real one (0.5 by chance).

    The test is Mann and Whitney's U, one-sided. A small p does not say why: scans of the streets that were learned are
    nearer than others without being copies. Frames of one drive are not drawn independently.
    """
    from scipy.stats import mannwhitneyu

    d, others = judged.distances, real.distances
    figures, remarks = {"copies": float(np.median(d))}, []
    if judged is not real:
        test = mannwhitneyu(others, d, alternative="greater")
        figures["copies_nearer"] = float(test.statistic) / (len(d) * len(others))
        remarks.append(
            f"copies: {(d < others.min()).sum()} of {len(d)} scans lie nearer to a training scan than any of "
            f"{len(others)} real ones, {len(d) / (len(others) + 1):.2g} expected; nearer in "
            f"{figures['copies_nearer']:.0%} of all pairs (p = {test.pvalue:.2g})."
        )
    settings = {"cells": list(CELLS), "turned": True, "mirrored": True, "training scans": training}
    sizes = {"real": len(real.numbers), "real_chosen": "all", "generated": len(judged.numbers)}
    protocol = {**Protocol("copies", "log-range of cells", settings=settings).asdict(), "sizes": sizes}
    return MetricResult("copies", figures, protocol, remarks)
