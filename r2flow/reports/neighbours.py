"""Generated scans beside the training scans that are nearest to them, turned, mirrored or in parts: what is memorised?

A scan is its log-range in model space, averaged over cells, x (h, w). The distance to a training scan y is the least
over the turns u of its w columns, and over y and its mirror image,

    d^2(x, y) = min_u (|x|^2 + |y|^2 - 2 c(u)) / (h w),        c(u) = sum_ij x_ij y_i(j+u),

with c by FFT along the rows. A scan that was put together from several is seen by its parts: each of its sectors has a
nearest place of its own in any training scan, and the distance in parts is the root of the mean of their d^2.

How many generated scans are nearer than held-out ones is tested as data copying is by Meehan et al. (2020).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from r2flow.errors import InputError
from r2flow.evaluation.measuring import Work
from r2flow.evaluation.sets import ScanSet
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.metrics.scans import Scans
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.pictures import BACKGROUND, FOREGROUND, draw_birds_eye, draw_range
from r2flow.reports.tables import Row, shown, table

CELLS, SECTORS = (16, 128), 8  # rows and columns of cells, at most; parts of a turn
PAIRS = {"cpu": 128, "cuda": 16384}  # compared together: on a CPU what is made of them fits into a cache
WAYS = {"whole": "whole scans", "parts": f"{SECTORS} sectors, each by itself"}
SEES = (
    "A small p says that generated scans lie nearer to the training scans than these held-out ones do, by more than "
    "chance. It does not say why: scans from the same streets are nearer than scans from others, without being copies. "
    "Look at the pairs. A large p is no proof that nothing was copied: docs/metrics.md has which copies are seen. "
    "Frames of one drive are not drawn independently; p is too small for them. Of four tests one has p < 0.0125 in 5 % "
    "of cases by chance."
)


def cells(scans: Scans) -> Tensor:
    """Log-range in model space, averaged over cells, (B, h, w); NaN for a scan without a return."""
    encoded = Encoding(scans.sensor, reflectance=False).encode(scans.images[:, :1])
    rows, columns = (min(most, found) for most, found in zip(CELLS, scans.sensor.shape, strict=True))
    columns -= columns % SECTORS if columns >= SECTORS else 0
    mean = adaptive_avg_pool2d(encoded, (rows, columns))[:, 0]
    return torch.where(scans.returned.flatten(1).any(1)[:, None, None], mean, torch.nan)


def described(scans: ScanSet, work: Work, device: str) -> Iterator[Tensor]:
    """`cells` of all scans, batch by batch."""
    with torch.no_grad():
        for images in scans.batches(range(len(scans)), work.batch_size, work.workers):
            yield cells(Scans(images.to(device), scans.sensor))


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
        rows = []
        with work.bar("describing", len(scans)) as advance:
            for batch in described(scans, work, device):
                rows.append(batch)
                advance(len(batch))
        x = torch.cat(rows)
        kept = x.isfinite().flatten(1).all(1)
        if not kept.any():
            raise InputError(
                f"none of the {len(scans)} scans of {scans.label} has a return: there is nothing to compare."
            )
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

    def approach(self, y: Tensor, first: int, leave_out_itself: bool) -> None:
        """Compare with training scans `first`, `first + 1`, ..., (M, h, w); a scan of NaN is never nearest."""
        usable = y.isfinite().flatten(1).all(1)
        both = torch.cat([y, y.flip(-1)]).nan_to_num(0.0)
        m, w = len(y), self.width
        spectra = torch.fft.rfft(both).permute(2, 1, 0).contiguous()  # (K, h, 2 M)
        # Energy of the window of each sector at each turn, (w, S, 2 M): differences of running sums around the ring.
        columns = both.square().sum(1).T
        sums = torch.cat([columns.new_zeros(1, 2 * m), columns.repeat(2, 1).cumsum(0)])
        starts = torch.arange(w, device=y.device)[:, None] + torch.arange(self.sectors, device=y.device) * (
            w // self.sectors
        )
        energy = sums[starts + w // self.sectors] - sums[starts]
        block = max(PAIRS.get(y.device.type, 128) // m, 1)
        for start in range(0, len(self.numbers), block):
            at = slice(start, start + block)
            x = self.spectra[:, at]
            d = torch.fft.irfft(x.flatten(1, 2) @ spectra, n=w, dim=0).view(w, *x.shape[1:3], 2 * m)
            d += energy[:, None]  # d^2 without |x|^2, which decides nothing: (w, n, S, 2 M)
            best = torch.cat([d.sum(2, keepdim=True).amin(0), d.amin(0)], 1)
            best[..., ~usable.repeat(2)] = torch.inf
            if leave_out_itself:
                own = torch.from_numpy(self.numbers[at]).to(y.device)[:, None] - first
                best.masked_fill_((own == torch.arange(m, device=y.device).repeat(2))[:, None], torch.inf)
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

    def order(self, way: str) -> np.ndarray:
        """Places in the arrays, the nearest first."""
        return np.argsort(self.distances(way), kind="stable")

    def match(self, place: int, way: str, training: ScanSet) -> tuple[np.ndarray, str]:
        """What of the training scans is nearest to a scan, as an image, and in words."""
        columns = training.sensor.shape[1]
        neighbours, turns = (one[place].tolist() for one in (self.neighbours, self.turns))
        if way == "whole":
            u = turns[0] if turns[0] >= 0 else -1 - turns[0]
            words = f"training {neighbours[0]}, turned {360 * u / self.width:.0f} degrees"
            return self._turned(training, neighbours[0], turns[0]), words + ", mirrored" * (turns[0] < 0)
        image = np.zeros_like(training.source[neighbours[1]])
        for k, at in enumerate(np.array_split(np.arange(columns), self.sectors)):
            image[..., at] = self._turned(training, neighbours[1 + k], turns[1 + k])[..., at]
        return image, f"parts of training {', '.join(map(str, dict.fromkeys(neighbours[1:])))}"

    def _turned(self, training: ScanSet, number: int, turn: int) -> np.ndarray:
        image = training.source[number]
        if turn < 0:
            image, turn = image[..., ::-1], -1 - turn
        return np.roll(image, -round(turn * image.shape[-1] / self.width), axis=-1)


@dataclass(frozen=True)
class Neighbours:
    """Generated scans and real ones, each with its nearest training scan.

    The real ones were held out, or they are training scans, each compared with the others.
    """

    generated: Nearest
    real: Nearest
    training: ScanSet
    held_out: bool

    @property
    def usual(self) -> str:
        """What the real scans are."""
        return "held-out real scans" if self.held_out else "training scans (each against the others)"


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
    found = mannwhitneyu(others, distances, alternative="greater")
    return Nearer(count, n / (m + 1), p_count, float(found.statistic) / (n * m), float(found.pvalue))


def find_neighbours(
    generated: ScanSet, training: ScanSet, held: ScanSet | None, work: Work, device: str = "cpu"
) -> Neighbours:
    """The nearest training scan of each generated and each held-out scan.

    Training scans are read once and none is kept. Without held-out scans, at most as many training scans as there are
    generated ones are compared to all the others.

    Raises:
        InputError: nothing to compare.
    """
    chosen = range(min(len(training), len(generated)))
    real = held if held is not None else training.part(chosen, "training scans, each without itself")
    if len(training) < (2 if held is None else 1):
        raise InputError(f"{training.label} holds {len(training)} training scans; needs at least two, or --real HELD.")
    judged, usual = (Nearest(s, work, device) for s in (generated, real))
    first = 0
    with work.bar("reading training scans", len(training)) as advance:
        for there in described(training, work, device):
            judged.approach(there, first, leave_out_itself=False)
            usual.approach(there, first, leave_out_itself=held is None)
            first += len(there)
            advance(len(there))
    return Neighbours(judged, usual, training, held is not None)


def neighbours_page(found: Neighbours, pairs: int, command: str, device: str) -> Page:
    """The pairs, the distributions of the distances, and how unusual these are."""
    sets = [
        {
            "by": words, "set": name, "scans": len(d), "empty": len(one.scans) - len(d), "least": float(d.min()),
            "5 %": float(np.quantile(d, 0.05)), "median": float(np.median(d)), "largest": float(d.max()),
        }
        for way, words in WAYS.items()
        for name, one in (("generated", found.generated), (found.usual, found.real))
        for d in [one.distances(way)]
    ]  # fmt: skip
    near = "" if found.held_out else " Neighbouring frames of one drive are near-duplicates of each other: give --real."
    how = (
        f"Distance: RMS difference of log-range in model space, averaged over cells, to the nearest of "
        f"{len(found.training)} training scans, at any turn, mirrored or not.{near}"
    )
    text = [*sentences(found), SEES, how, table(sets, {key: key for key in sets[0]})]
    figures = {"neighbours": _sheet(found, pairs), "neighbours_distances": _distances(found)}
    title = "Generated scans and their nearest training scans"
    return Page("neighbours", title, text, pair_rows(found), figures, command, {}, device)


def sentences(found: Neighbours) -> list[str]:
    """How many generated scans lie nearer to the training scans than the real ones do, and how likely that is."""
    said = []
    for way, words in WAYS.items():
        n = nearer(found.generated.distances(way), found.real.distances(way))
        total, real = len(found.generated.numbers), len(found.real.numbers)
        said.append(
            f"By {words}: **{n.count} of {total}** generated scans lie nearer to a training scan than any of {real} "
            f"{found.usual} does; {shown(n.expected)} are expected if both are drawn alike (p = {shown(n.p_count)}). "
            f"In {n.share:.0%} of all pairs the generated scan is the nearer one (p = {shown(n.p_share)})."
        )
    return said


def pair_rows(found: Neighbours) -> list[Row]:
    """Every pair, the nearest first."""
    training = found.training.source.names
    rows: list[Row] = []
    for name, one in (("generated", found.generated), ("real", found.real)):
        names = one.scans.source.names
        whole, parts = (one.distances(way) for way in WAYS)
        neighbours, turns = one.neighbours.cpu().numpy(), one.turns.cpu().numpy()
        for i in one.order("whole"):
            turn = int(turns[i, 0])
            rows.append({
                "set": name, "scan": names[int(one.numbers[i])], "nearest": training[int(neighbours[i, 0])],
                "distance": float(whole[i]), "degrees": 360 * (turn if turn >= 0 else -1 - turn) / one.width,
                "mirrored": turn < 0, "distance_in_parts": float(parts[i]),
                "nearest_of_parts": " ".join(training[k] for k in dict.fromkeys(neighbours[i, 1:].tolist())),
            })  # fmt: skip
    return rows


def _sheet(found: Neighbours, pairs: int) -> Figure:
    """The nearest pairs, whole and in parts, generated on the left and real on the right."""
    sides = (found.generated, found.real)
    count = min(pairs, *(len(one.numbers) for one in sides))
    lines = 2 * count
    height = 1.62 * lines + 0.2
    figure = blank_figure(17, height)
    figure.set_layout_engine("none")  # the grid is a layout already, and a computed one takes seconds
    figure.set_facecolor(BACKGROUND)
    grid = figure.add_gridspec(
        lines, 9, width_ratios=[2.3, 1, 2.3, 1, 0.12, 2.3, 1, 2.3, 1], wspace=0.03, hspace=0.16,
        left=0.005, right=0.995, top=1 - 0.25 / height, bottom=0.05 / height,
    )  # fmt: skip
    heads = ("generated", "held-out real" if found.held_out else "training")
    rays = found.training.sensor.rays()
    for side, (one, head) in enumerate(zip(sides, heads, strict=True)):
        for row, way in enumerate(WAYS):
            d, order = one.distances(way), one.order(way)
            for k in range(count):
                place = int(order[k])
                image, words = one.match(place, way, found.training)
                number = int(one.numbers[place])
                title = f"nearest {k + 1} by {way}: {head} {number}, {shown(float(d[place]))} away from"
                for half, (said, drawn) in enumerate(((title, one.scans.source[number]), (words, image))):
                    column, line = 5 * side + 2 * half, row * count + k
                    axes = figure.add_subplot(grid[line, column])
                    draw_range(axes, drawn, label=False)
                    axes.set_title(said, color=FOREGROUND, fontsize=8, loc="left", pad=3)
                    xyz, _ = image_to_points(drawn, rays)
                    draw_birds_eye(figure.add_subplot(grid[line, column + 1]), xyz, label=False)
    return figure


def _distances(found: Neighbours) -> Figure:
    """Share of scans whose nearest training scan lies within a distance."""
    figure = blank_figure(9, 4, "Distance to the nearest training scan")
    for place, (way, words) in enumerate(WAYS.items()):
        axes = figure.add_subplot(1, 2, place + 1)
        for style, one, name in zip(STYLES, (found.generated, found.real), ("generated", found.usual), strict=False):
            d = np.sort(one.distances(way))
            look: dict[str, Any] = {key: style[key] for key in ("linestyle", "color")}
            axes.step(d, np.arange(1, len(d) + 1) / len(d), where="post", **look, lw=1.6, label=f"{name} ({len(d)})")
        axes.set(xlabel=f"{words}: RMS of log-range, model space", ylim=(0, 1.02))
        axes.set_ylabel("" if place else "share of the scans")
        axes.set_xlim(left=0)
        axes.grid(True, color="0.88", lw=0.6)
    axes.legend(fontsize=8, frameon=False)
    return figure
