"""Distance of generated scans to the nearest training scan, turned, mirrored or in parts: what is memorised?

A scan is its log-range in model space, averaged over cells, x (h, w). The distance to a training scan y is the least
over the turns u of its w columns, and over y and its mirror image,

    d^2(x, y) = min_u (|x|^2 + |y|^2 - 2 c(u)) / (h w),        c(u) = sum_ij x_ij y_i(j+u),

with c by FFT along the rows. A scan that was put together from several is seen by its parts: each of its sectors has a
nearest place of its own in any training scan, and the distance in parts is the root of the mean of their d^2.

How many generated scans are nearer than real ones is tested as data copying is by Meehan et al. (2020).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from r2flow.errors import InputError
from r2flow.evaluation.measuring import MetricResult, Work
from r2flow.evaluation.sets import ScanSet
from r2flow.lidar.encoding import Encoding
from r2flow.metrics.base import Protocol
from r2flow.metrics.scans import Scans

CELLS, SECTORS = (16, 128), 8  # rows and columns of cells, at most; parts of a turn
PAIRS = {"cpu": 128, "cuda": 16384}  # compared together: on a CPU what is made of them fits into a cache
WAYS = {"whole": "whole scans", "parts": f"{SECTORS} sectors, each by itself"}


def cells(scans: Scans) -> Tensor:
    """Log-range in model space, averaged over cells, (B, h, w); NaN for a scan without a return."""
    encoded = Encoding(scans.sensor, reflectance=False).encode(scans.images[:, :1])
    rows, columns = (min(most, size) for most, size in zip(CELLS, scans.sensor.shape, strict=True))
    columns -= columns % SECTORS if columns >= SECTORS else 0
    mean = adaptive_avg_pool2d(encoded, (rows, columns))[:, 0]
    return torch.where(scans.returned.flatten(1).any(1)[:, None, None], mean, torch.nan)


def described(scans: ScanSet, work: Work, device: str, doing: str) -> Iterator[Tensor]:
    """`cells` of all scans, batch by batch."""
    with torch.no_grad(), work.bar(doing, len(scans)) as advance:
        for images in scans.batches(range(len(scans)), work.batch_size, work.workers):
            yield cells(Scans(images.to(device), scans.sensor))
            advance(len(images))


class Nearest:
    """The nearest training scan of each scan of a set, of those that were compared so far.

    Attributes:
        scans: The set.
        numbers: Its scans that have a return, (N,); the others have no neighbour.
        squared: d^2 of each to its nearest training scan: whole, then of each sector, (N, 1 + S).
        neighbours: These training scans, likewise.
        turns: By how many cells they are turned; negative, -1 - u, where they are mirrored first.
    """

    def __init__(self, scans: ScanSet, work: Work, device: str) -> None:
        x = torch.cat(list(described(scans, work, device, "describing")))
        kept = x.isfinite().flatten(1).all(1)
        if not kept.any():
            raise InputError(f"none of the {len(scans)} scans of {scans.label} has a return to compare.")
        self.scans, self.numbers, x = scans, np.flatnonzero(kept.cpu().numpy()), x[kept]
        n, h, w = x.shape
        self.width, self.sectors = w, SECTORS if w % SECTORS == 0 else 1
        parts = x.new_zeros(n, self.sectors, h, w)
        for k, at in enumerate(torch.arange(w).chunk(self.sectors)):
            parts[:, k, :, at] = x[:, :, at]
        size = parts.square().sum((2, 3))
        self.size = torch.cat([size.sum(1, keepdim=True), size], 1)
        self.elements = torch.full((1 + self.sectors,), h * w / self.sectors, device=x.device)
        self.elements[0] = h * w
        self.spectra = -2 * torch.fft.rfft(parts).conj().permute(3, 0, 1, 2).contiguous()  # (K, N, S, h)
        shape = (n, 1 + self.sectors)
        self.squared = torch.full(shape, torch.inf, device=x.device)
        self.neighbours, self.turns = (torch.zeros(shape, dtype=torch.long, device=x.device) for _ in range(2))

    def approach(self, y: Tensor, first: int) -> None:
        """Compare with training scans `first`, `first + 1`, ..., (M, h, w); a scan of NaN is never nearest."""
        usable = y.isfinite().flatten(1).all(1)
        both = torch.cat([y, y.flip(-1)]).nan_to_num(0.0)
        m, w = len(y), self.width
        spectra = torch.fft.rfft(both).permute(2, 1, 0).contiguous()  # (K, h, 2 M)
        # Energy of the window of each sector at each turn, (w, S, 2 M): differences of running sums around the ring.
        columns, sector = both.square().sum(1).T, w // self.sectors
        sums = torch.cat([columns.new_zeros(1, 2 * m), columns.repeat(2, 1).cumsum(0)])
        starts = torch.arange(w, device=y.device)[:, None] + torch.arange(self.sectors, device=y.device) * sector
        energy = sums[starts + sector] - sums[starts]
        block = max(PAIRS.get(y.device.type, 128) // m, 1)
        for start in range(0, len(self.numbers), block):
            at = slice(start, start + block)
            x = self.spectra[:, at]
            d = torch.fft.irfft(x.flatten(1, 2) @ spectra, n=w, dim=0).view(w, *x.shape[1:3], 2 * m)
            d += energy[:, None]  # d^2 without |x|^2, which decides nothing: (w, n, S, 2 M)
            best = torch.cat([d.sum(2, keepdim=True).amin(0), d.amin(0)], 1)
            best[..., ~usable.repeat(2)] = torch.inf
            least, place = best.min(2)
            squared = ((least + self.size[at]) / self.elements).clamp(min=0)
            i, k = torch.nonzero(squared < self.squared[at], as_tuple=True)
            p = place[i, k]
            curves = torch.where(k == 0, d[:, i, :, p].sum(2).T, d[:, i, (k - 1).clamp(min=0), p])
            turn = curves.argmin(0)
            self.squared[start + i, k] = squared[i, k]
            self.neighbours[start + i, k] = first + p % m
            self.turns[start + i, k] = torch.where(p < m, turn, -1 - turn)

    def distances(self, way: str) -> np.ndarray:
        """Of every scan to its nearest, whole or in parts, (N,)."""
        squared = self.squared[:, 0] if way == "whole" else self.squared[:, 1:].mean(1)
        return squared.double().sqrt().cpu().numpy()

    def match(self, place: int, way: str, training: ScanSet) -> np.ndarray:
        """The training scan or parts of training scans that are nearest to a scan, turned as it is, as an image."""
        neighbours, turns = (one[place].tolist() for one in (self.neighbours, self.turns))
        if way == "whole":
            return self._turned(training, neighbours[0], turns[0])
        image = np.zeros_like(training.source[neighbours[1]])
        for k, at in enumerate(np.array_split(np.arange(training.sensor.shape[1]), self.sectors)):
            image[..., at] = self._turned(training, neighbours[1 + k], turns[1 + k])[..., at]
        return image

    def _turned(self, training: ScanSet, number: int, turn: int) -> np.ndarray:
        image = training.source[number]
        if turn < 0:
            image, turn = image[..., ::-1], -1 - turn
        return np.roll(image, -round(turn * image.shape[-1] / self.width), axis=-1)


@dataclass(frozen=True)
class Nearer:
    """Whether scans are nearer than others, by two one-sided tests.

    Attributes:
        count, expected: Of the first that are nearer than every one of the others, and how many chance puts there.
        p_count: P(at least so many | both drawn alike) = prod_i (n - i) / (n + m - i), i < count.
        share: Of all pairs in which the first one is nearer: U / (n m), 0.5 by chance.
        p_share: Of Mann and Whitney's U.
    """

    count: int
    expected: float
    p_count: float
    share: float
    p_share: float


def nearer(distances: np.ndarray, others: np.ndarray) -> Nearer:
    """Test distances (n,) against others' (m,)."""
    from scipy.stats import mannwhitneyu

    n, m = len(distances), len(others)
    count = int((distances < others.min()).sum())
    i = np.arange(count)
    p_count = float(np.prod((n - i) / (n + m - i)))
    test = mannwhitneyu(others, distances, alternative="greater")
    return Nearer(count, n / (m + 1), p_count, float(test.statistic) / (n * m), float(test.pvalue))


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

    A small p does not say why: scans of the streets that were learned are nearer than others without being copies. A
    large p does not prove that nothing was copied. Frames of one drive are not drawn independently.
    """
    figures, remarks = {}, []
    for way, words in WAYS.items():
        d, others = judged.distances(way), real.distances(way)
        figures[f"copies_{way}"] = float(np.median(d))
        if judged is real:
            continue
        test = nearer(d, others)
        figures[f"copies_{way}_nearer"] = test.share
        remarks.append(
            f"copies by {words}: {test.count} of {len(d)} scans lie nearer to a training scan than any of "
            f"{len(others)} real ones, {test.expected:.2g} expected (p = {test.p_count:.2g}); nearer in "
            f"{test.share:.0%} of all pairs (p = {test.p_share:.2g})."
        )
    settings = {"cells": list(CELLS), "sectors": SECTORS, "turned": True, "mirrored": True, "training scans": training}
    sizes = {"real": len(real.numbers), "real_chosen": "all", "generated": len(judged.numbers)}
    protocol = {**Protocol("copies", "log-range of cells", settings=settings).asdict(), "sizes": sizes}
    return MetricResult("copies", figures, protocol, remarks)
