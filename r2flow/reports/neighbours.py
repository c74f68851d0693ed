"""Generated scans beside the training scans that are nearest to them: is anything memorised?"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.errors import InputError
from r2flow.evaluation.measuring import Work
from r2flow.evaluation.sets import ScanSet
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.metrics.extractors import load_extractor
from r2flow.metrics.extractors.base import nan_where_empty
from r2flow.metrics.scans import Scans
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.pictures import BACKGROUND, FOREGROUND, draw_birds_eye, draw_range
from r2flow.reports.tables import Row, shown, table

REPRESENTATIONS = ("embedded", "pixels")
COPY = 0.1  # of the usual distance


@dataclass(frozen=True)
class Representation:
    """What of two scans is compared by Euclidean distance, (B, D); a row of NaN for a scan without a return."""

    words: str
    describe: Callable[[Scans], Tensor]
    device: str = "cpu"

    def batches(self, scans: ScanSet, numbers: Sequence[int], work: Work) -> Iterator[Tensor]:
        """Descriptions of scans, batch by batch, on the CPU."""
        with torch.no_grad():
            for images in scans.batches(numbers, work.batch_size, work.workers):
                yield self.describe(Scans(images.to(self.device), scans.sensor)).float().cpu()


class Nearest:
    """The nearest training scan of each scan of a set, of those that were compared so far.

    Attributes:
        scans: The set.
        numbers: Its scans that have a return, (N,); the others have no neighbour.
        distances, neighbours: From each of these to its nearest training scan, (N,) float64, and its number, (N,).
    """

    def __init__(self, scans: ScanSet, representation: Representation, work: Work) -> None:
        rows = []
        with work.bar("describing", len(scans)) as advance:
            for batch in representation.batches(scans, range(len(scans)), work):
                rows.append(batch)
                advance(len(batch))
        x = torch.cat(rows)
        kept = x.isfinite().all(1)
        if not kept.any():
            raise InputError(
                f"none of the {len(scans)} scans of {scans.label} has a return: there is nothing to compare."
            )
        self.scans, self.numbers, self.x = scans, np.flatnonzero(kept.numpy()), x[kept]
        self.squared = torch.full((len(self.x),), torch.inf)
        self.distances = np.full(len(self.x), np.inf)
        self.neighbours = np.zeros(len(self.x), dtype=np.int64)

    def approach(self, y: Tensor, first: int, leave_out_itself: bool) -> None:
        """Compare with training scans `first`, `first + 1`, ..., described by y (M, D); NaN is never nearest."""
        d = self.x.square().sum(1)[:, None] + y.square().sum(1) - 2 * self.x @ y.T
        d = d.nan_to_num(torch.inf)
        if leave_out_itself:
            d[torch.from_numpy(self.numbers)[:, None] == torch.arange(first, first + len(y))] = torch.inf
        squared, place = d.min(1)
        nearer = squared < self.squared
        self.squared[nearer] = squared[nearer]
        self.neighbours[nearer] = place[nearer] + first
        # One product is exact enough to find the nearest, but its rounding would hide a copy.
        difference = self.x[nearer].double() - y[place[nearer]].double()
        self.distances[nearer] = torch.linalg.vector_norm(difference, dim=1)

    def order(self) -> np.ndarray:
        """Places in the arrays, the nearest first."""
        return np.argsort(self.distances, kind="stable")


@dataclass(frozen=True)
class Neighbours:
    """Generated scans and real ones, each with its nearest training scan.

    The real ones were held out, or they are training scans, each compared with the others.
    """

    generated: Nearest
    real: Nearest
    training: ScanSet
    words: str
    held_out: bool

    @property
    def usual(self) -> str:
        """What the real scans are."""
        return "held-out real scans" if self.held_out else "training scans (each against the others)"


def representation_of(name: str | None, sets: Sequence[ScanSet], device: str) -> Representation:
    """The representation of a name; features of the embedded network if left out.

    Raises:
        InputError: no such name, or no network.
    """
    if name not in (None, *REPRESENTATIONS):
        raise InputError(f"--by must be {' or '.join(REPRESENTATIONS)}, found {name!r}.")
    if name != "pixels":
        kind = "embedded" if all(s.about["reflectance"] for s in sets) else "embedded_range"
        network = load_extractor(kind).to(device)
        return Representation(f"features of '{kind}' ({network.layer})", network.features, device)
    encoding = Encoding(sets[0].sensor, reflectance=False)

    def log_range(scans: Scans) -> Tensor:
        x = encoding.encode(scans.images[:, :1].cpu()).flatten(1)
        return nan_where_empty(x / x.shape[1] ** 0.5, scans)

    return Representation("RMS difference of log-range in model space, pixel by pixel", log_range, device)


def find_neighbours(
    generated: ScanSet, training: ScanSet, held: ScanSet | None, representation: Representation, work: Work
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
    judged, usual = (Nearest(s, representation, work) for s in (generated, real))
    first = 0
    with work.bar("reading training scans", len(training)) as advance:
        for there in representation.batches(training, range(len(training)), work):
            judged.approach(there, first, leave_out_itself=False)
            usual.approach(there, first, leave_out_itself=held is None)
            first += len(there)
            advance(len(there))
    return Neighbours(judged, usual, training, representation.words, held is not None)


def neighbours_page(found: Neighbours, pairs: int, command: str, device: str) -> Page:
    """The pairs, the distributions of the distances, and what these say."""
    sets = [
        {
            "set": name, "scans": len(one.distances), "empty": len(one.scans) - len(one.distances),
            "least": float(one.distances.min()), "5 %": float(np.quantile(one.distances, 0.05)),
            "median": float(np.median(one.distances)), "largest": float(one.distances.max()),
        }
        for name, one in (("generated", found.generated), (found.usual, found.real))
    ]  # fmt: skip
    near = "" if found.held_out else " Neighbouring frames of one drive are near-duplicates of each other: give --real."
    how = f"Distance: {found.words}; to the nearest of {len(found.training)} training scans.{near}"
    text = [*sentences(found), how, table(sets, {key: key for key in sets[0]})]
    figures = {"neighbours": _sheet(found, pairs), "neighbours_distances": _distances(found)}
    title = "Generated scans and their nearest training scans"
    return Page("neighbours", title, text, pair_rows(found), figures, command, {}, device)


def sentences(found: Neighbours) -> list[str]:
    """What the distances say of copies."""
    generated, real = found.generated.distances, found.real.distances
    nearer, expected = int((generated < real.min()).sum()), len(generated) / (len(real) + 1)
    share = float((generated < np.quantile(real, 0.05)).mean())
    copies = int((generated < COPY * np.median(real)).sum())
    return [
        f"{nearer} of {len(generated)} generated scans lie nearer to a training scan than any of {len(real)} "
        f"{found.usual} does; about {shown(expected)} would if both were drawn alike. {share:.0%} lie nearer than the "
        "nearest 5 % of these.",
        f"{copies} lie nearer than a tenth of the usual (median) distance: look at them, they are copies or nearly so."
        if copies
        else "None lies nearer than a tenth of the usual (median) distance: no copy among them.",
    ]


def pair_rows(found: Neighbours) -> list[Row]:
    """Every pair, the nearest first."""
    training = found.training.source.names
    rows: list[Row] = []
    for name, one in (("generated", found.generated), ("real", found.real)):
        names = one.scans.source.names
        rows += [
            {"set": name, "scan": names[int(one.numbers[i])], "nearest": training[int(one.neighbours[i])],
             "distance": float(one.distances[i])}
            for i in one.order()
        ]  # fmt: skip
    return rows


def _sheet(found: Neighbours, pairs: int) -> Figure:
    """The nearest pairs and half as many of the farthest, generated on the left and real on the right."""
    sides = (found.generated, found.real)
    orders = [one.order() for one in sides]
    # Places of what is drawn, from the front of the order and from its end.
    near = [range(min(pairs, len(order))) for order in orders]
    far = [
        range(-1, -1 - min(max(pairs // 2, 1), len(order) - len(front)), -1)
        for order, front in zip(orders, near, strict=True)
    ]
    lines = max(len(a) + len(b) for a, b in zip(near, far, strict=True))
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
        words = [f"nearest {k + 1}" for k in near[side]] + [f"farthest {-k}" for k in far[side]]
        for line, (place, word) in enumerate(zip(orders[side][[*near[side], *far[side]]], words, strict=True)):
            number, neighbour = int(one.numbers[place]), int(one.neighbours[place])
            away = shown(float(one.distances[place]))
            drawn = (
                (f"{word}: {head} {number}, {away} away from", one.scans.source[number]),
                (f"training {neighbour}", found.training.source[neighbour]),
            )
            for half, (title, image) in enumerate(drawn):
                column = 5 * side + 2 * half
                axes = figure.add_subplot(grid[line, column])
                draw_range(axes, image, label=False)
                axes.set_title(title, color=FOREGROUND, fontsize=8, loc="left", pad=3)
                xyz, _ = image_to_points(image, rays)
                draw_birds_eye(figure.add_subplot(grid[line, column + 1]), xyz, label=False)
    return figure


def _distances(found: Neighbours) -> Figure:
    """Share of scans whose nearest training scan lies within a distance."""
    figure = blank_figure(6.4, 4, "Distance to the nearest training scan")
    axes = figure.add_subplot()
    for style, one, name in zip(STYLES, (found.generated, found.real), ("generated", found.usual), strict=False):
        d = np.sort(one.distances)
        look: dict[str, Any] = {key: style[key] for key in ("linestyle", "color")}
        axes.step(d, np.arange(1, len(d) + 1) / len(d), where="post", **look, lw=1.6, label=f"{name} ({len(d)})")
    axes.set(xlabel=found.words, ylabel="share of the scans", ylim=(0, 1.02))
    axes.set_xlim(left=0)
    axes.grid(True, color="0.88", lw=0.6)
    axes.legend(fontsize=8, frameon=False)
    return figure
