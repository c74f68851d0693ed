"""Scans as pictures in the width of a paper's page: images, bird's-eye view, 3-D perspective."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist, allow_rasterization
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.image import BboxImage
from matplotlib.patches import Patch
from matplotlib.transforms import Bbox, TransformedBbox
from scipy.ndimage import maximum_filter
from torch import Tensor

from r2flow.lidar.labels import CLASSES, STANDING, semantic_ids
from r2flow.lidar.projection import image_to_points

_MOST_CLASSES = 10  # of a legend
_WIDTH = 7.16  # inches: two columns of an IEEE paper
# Camera of the perspective over a street, in units of the view's reach.
_EYE = np.array([-0.32, 0.0, 0.18])
_ROOM = 15.0  # metres of reach up to which the camera stands behind a room, four times as far
# Its axes as columns: right, up, ahead; pitched down by 18 degrees.
_AXES = np.array([[0, 0.3090, 0.9511], [-1, 0, 0], [0, 0.9511, -0.3090]])

# Ids, names and colours of points by the metres within which they are right in 68 %.
TRUST_LIMITS = (0.05, 0.2, 1.0)
TRUST_TITLE = "predicted error (68 %)"
TRUST = {
    65000: ("measured", "#74c0fc"),
    65001: ("added, up to 0.05 m", "#2f9e44"),
    65002: ("up to 0.2 m", "#fcc419"),
    65003: ("up to 1 m", "#f76707"),
    65004: ("more", "#c92a2a"),
}


def trust_ids(image: np.ndarray, error: np.ndarray) -> np.ndarray:
    """The ids of `TRUST` of a scan, (C, H, W), with the 68 % error of each ray in metres, (H, W);
    0 without a return. A measured ray beside added ones has the worst id of these: measured and
    added rows in turn would blend on a screen to colours without a meaning.
    """
    ids = np.where(error > 0, min(TRUST) + 1 + np.searchsorted(TRUST_LIMITS, error), min(TRUST))
    worst = maximum_filter(ids * (image[0] > 0), size=3, mode=("nearest", "wrap"))
    return np.where(error > 0, ids, worst) * (image[0] > 0)


class View(NamedTuple):
    """Metres that colours and views span."""

    ranges: tuple[float, float]  # coloured on a logarithmic scale
    heights: tuple[float, float]  # coloured, sensor frame
    reach: float  # shown to each side of the sensor in the bird's-eye view


STREET = View((2.0, 80.0), (-2.8, 3.0), 50.0)


def view_of(*scans: tuple[np.ndarray, Tensor]) -> View:
    """View of nearly all points of scans, pairs of image and rays; `STREET` if there are none."""
    xyz = np.concatenate([image_to_points(*scan)[0] for scan in scans])
    if not len(xyz):
        return STREET
    near, far = np.percentile(np.linalg.norm(xyz, axis=1), (2, 98)).tolist()
    low, high = np.percentile(xyz[:, 2], (2, 95)).tolist()
    reach = float(np.percentile(np.abs(xyz[:, :2]).max(axis=1), 96))
    # The margins keep colours apart that have hardly different values.
    return View((0.9 * near, 1.1 * far), (low - 0.5, high + 0.5), max(1.1 * reach, 1.0))


def scan_figure(
    image: np.ndarray,
    rays: Tensor,
    title: str = "",
    view: View | None = None,
    labels: np.ndarray | None = None,
) -> Figure:
    """Draw one scan, (2 or 1, H, W): its images above, bird's-eye view and perspective below.

    `view`: default: that of the scan (`view_of`); `STREET` for all scans makes pictures comparable.
    `labels`: semantic ids, (H, W); default: those of a labelled model's image.
    """
    if labels is None:
        labels = _labels_of(image)
    image = image[:2]
    figure = Figure((_WIDTH, 4.6), facecolor="white")
    strips = len(image) + (labels is not None)
    grid = figure.add_gridspec(
        strips + 1,
        2,
        height_ratios=[*[1] * strips, 5.2],
        width_ratios=[1, 1.45],
        hspace=0.28,
        wspace=0.04,
        left=0.01,
        right=0.925,
        top=0.89,
        bottom=0.01,
    )
    view = view or view_of((image, rays))
    _draw_strips([figure.add_subplot(grid[row, :]) for row in range(strips)], image, labels, view)
    _draw_views([figure.add_subplot(grid[-1, i]) for i in (0, 1)], image, rays, view, labels=labels)
    returned = image[0] > 0
    size = " x ".join(map(str, returned.shape))
    about = f"{title}   {size}, {returned.sum():,} returns ({returned.mean():.0%})".strip()
    figure.suptitle(about, fontsize=8, x=0.01, ha="left")
    return figure


def contact_sheet(
    images: Sequence[np.ndarray],
    rays: Tensor,
    titles: Sequence[str] = (),
    unmeasured: np.ndarray | None = None,
    labels: Sequence[np.ndarray | None] | None = None,
    kinds: Sequence[str] = (),
) -> Figure:
    """Draw several scans in their common view, one per row: range, reflectance and labels on the
    left, each as high as the others, bird's-eye view and perspective on the right.

    Rays of the first scan that were not measured, (H, W) bool, are white. `labels`: semantic ids or
    those of `TRUST`, (H, W) each; default: those of a labelled model's images. `kinds`: titles of
    labels that are classes.
    """
    if labels is None:
        labels = [_labels_of(image) for image in images]
    images = [image[:2] for image in images]
    view = view_of(*((image, rays) for image in images))
    strip = max(len(images[0][0]) / 150, 0.42)  # inches: two pixels of a PNG, or more, a row
    pitch = strip + 0.17  # below is a title
    counts = [len(image) + (ids is not None) for image, ids in zip(images, labels, strict=True)]
    heights = [max(count * pitch - 0.17, 1.15) + 0.18 for count in counts]
    below = [0.13 * (ids is not None) for ids in labels]  # a legend
    height = sum(heights) + sum(below) + 0.02
    figure = Figure((_WIDTH, height), facecolor="white")
    top = height
    for row, (image, ids) in enumerate(zip(images, labels, strict=True)):
        top -= 0.18  # a title
        strips = [
            figure.add_axes((0.01, (top - i * pitch - strip) / height, 0.464, strip / height))
            for i in range(counts[row])
        ]
        title = titles[row] if row < len(titles) else ""
        _draw_strips(strips, image, ids, view, title, row == 0, *kinds[row : row + 1])
        views = [
            figure.add_axes((left, (top - 1.15) / height, width, 1.15 / height))
            for left, width in ((0.511, 0.16), (0.708, 0.232))
        ]
        _draw_views(views, image, rays, view, row == 0, ids)
        top -= heights[row] - 0.18 + below[row]
        if row == 0 and unmeasured is not None:
            white = np.repeat(unmeasured[..., None], 4, axis=2).astype(float)
            for axes in strips[: len(image)]:
                axes.imshow(white, aspect="auto", interpolation="nearest")
            names = {"not measured": "white", "measured, no return": "black"}
            _add_legend(strips[0], names, loc="lower right", bbox_to_anchor=(1, 1))
    return figure


def _labels_of(image: np.ndarray) -> np.ndarray | None:
    """Semantic ids of a labelled model's image, if it has any."""
    return semantic_ids(image[2]) if len(image) > 2 and image[2].any() else None


def _draw_strips(
    strips: Sequence[Any],
    image: np.ndarray,
    labels: np.ndarray | None,
    view: View,
    title: str = "",
    first: bool = True,
    kind: str = "class",
) -> None:
    """Draw range on a logarithmic scale, the root of reflectance and labels; dropped rays black.

    `first`: with colour bars and titles.
    """
    dropped = image[0] <= 0
    near, far = view.ranges
    ticks = {r: float(np.log(r)) for r in (near, np.sqrt(near * far), far)}
    title = ": ".join(filter(None, (title, "range, m" if first else "")))
    values = np.ma.masked_where(dropped, np.log(np.maximum(image[0], 1e-3)))
    _draw_values(strips[0], values, "range", ticks, title, first)
    if len(image) > 1:
        values = np.ma.masked_where(dropped, np.sqrt(np.clip(image[1], 0, 1)))
        ticks = {0: 0.0, 0.2: 0.2**0.5, 0.8: 0.8**0.5}
        _draw_values(strips[1], values, "reflectance", ticks, "reflectance", first)
    if labels is not None:
        _draw_labels(strips[-1], labels, kind)


def _draw_values(
    axes: Any, values: np.ndarray, what: str, ticks: Mapping[float, float], title: str, bar: bool
) -> None:
    low, *_, high = ticks.values()
    scale = ScalarMappable(Normalize(low, high), colours(what))
    axes.imshow(scale.to_rgba(values, bytes=True), aspect="auto", interpolation="nearest")
    _frame(axes, title, "black")
    if bar:
        _add_bar(axes, scale, ticks)


def _draw_labels(axes: Any, labels: np.ndarray, kind: str) -> None:
    """Draw semantic ids with a legend of the classes."""
    classes = class_colours(labels[labels > 0], _MOST_CLASSES)
    axes.imshow(_in_class_colours(labels, "black")[..., :3], aspect="auto", interpolation="nearest")
    trusted = classes.keys() & TRUST.keys()
    black = {"no return": "black"} if trusted else {}
    _add_legend(axes, {**dict(classes.values()), **black})
    _frame(axes, TRUST_TITLE if trusted else kind, "black")


def _in_class_colours(labels: np.ndarray, other: str) -> np.ndarray:
    """RGBA of semantic ids, (..., 4) in [0, 1]; `other`: of those that the legend leaves out."""
    colour = np.full((*labels.shape, 4), to_rgba(other))
    for number, (_, value) in class_colours(labels[labels > 0], _MOST_CLASSES).items():
        colour[labels == number] = to_rgba(value)
    return colour


def class_colours(labels: np.ndarray, most: int) -> dict[int, tuple[str, str]]:
    """Name and colour of the `most` most frequent semantic ids in labels, (N,), in order of
    frequency.

    Names are those of a labelled model's classes if all ids stand for one, else SemanticKITTI's if
    it defines all ids, else numbers.
    """
    ids, counts = np.unique(labels, return_counts=True)
    ordered = ids[np.argsort(-counts)][:most].tolist()
    if TRUST.keys() >= set(ordered):
        return {label: TRUST[label] for label in sorted(ordered)}
    for known in (STANDING, CLASSES):
        if known.keys() >= set(ids.tolist()):
            return {label: known[label] for label in ordered}
    hues = colormaps["hsv"]  # the golden ratio separates the hues of neighbouring ids
    return {label: (f"class {label}", to_hex(hues(label * 0.618034 % 1))) for label in ordered}


def _draw_views(
    panels: Sequence[Any],
    image: np.ndarray,
    rays: Tensor,
    view: View,
    first: bool = True,
    labels: np.ndarray | None = None,
) -> None:
    """Draw points from above, driving direction upwards, and by a pinhole camera behind and above
    the sensor, coloured by class if `labels` are semantic ids, else by height.
    """
    above, ahead = panels
    reach = view.reach
    heights = ScalarMappable(Normalize(*view.heights), "turbo")
    points, _ = image_to_points(image, rays)
    colour = heights.to_rgba(points[:, 2], bytes=True)
    title = "perspective, colour: height, m" if first else ""
    by_class = labels is not None and not np.isin(labels, list(TRUST)).any()
    if labels is not None and by_class:
        colour = (255 * _in_class_colours(labels[image[0] > 0], "0.8")).astype(np.uint8)
        title = "perspective, colour: class"
    near = (np.abs(points[:, :2]) < reach).all(axis=1)
    size = np.full(near.sum(), np.clip(6_000 / max(near.sum(), 1), 0.2, 1.0))
    above.add_artist(_Dots(points[near][:, :2] @ [[0, 1], [-1, 0]], colour[near], size))
    above.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", anchor="N")
    above.plot(0, 0, marker="^", color="black", ms=3)
    _frame(above, f"bird's-eye view, {2 * reach:.0f} m wide" if first else "")

    eye = _EYE * (1 if reach > _ROOM else 4)
    seen = (points / reach - eye) @ _AXES
    order = np.argsort(-seen[:, 2])
    order = order[seen[order, 2] > 0.06]
    place, depth = seen[order, :2], seen[order, 2]
    size = np.clip(0.14 / depth, 0.3, 0.8) * np.sqrt(30_000 / max(len(points), 1))
    ahead.add_artist(_Dots(place / depth[:, None], colour[order], size))
    ahead.set(xlim=(-0.95, 0.95), ylim=(-0.62, 0.48), aspect="equal", anchor="N")
    _frame(ahead, title)
    if first and not by_class:
        low, high = view.heights
        _add_bar(ahead, heights, {z: z for z in (low, (low + high) / 2, high)})


class _Dots(Artist):
    """Squares of points in data coordinates, later ones above earlier ones.

    A scatter draws every point as a path, which takes ten times as long.
    """

    def __init__(self, points: np.ndarray, colours: np.ndarray, sizes: np.ndarray) -> None:
        super().__init__()
        self.points = points  # (N, 2)
        self.colours = colours  # (N, 4) uint8
        self.sizes = sizes  # areas in square points, (N,)
        self.set_rasterized(True)

    @allow_rasterization
    def draw(self, renderer: Any) -> None:
        axes: Any = self.axes
        x, y, right, top = np.rint(axes.bbox.extents).astype(int)
        pixels = np.zeros((top - y, right - x, 4), np.uint8)
        sides = np.rint(renderer.points_to_pixels(1) * np.sqrt(self.sizes)).clip(1)[:, None]
        most = int(sides.max(initial=0))
        steps = np.mgrid[:most, :most].reshape(2, 1, -1)
        corners = axes.transData.transform(self.points).T[..., None] - sides / 2
        places = np.rint(corners).astype(int) - [[[x]], [[y]]] + steps  # (2, points, steps)
        limits = [[[right - x]], [[top - y]]]
        seen = ((steps < sides) & (places >= 0) & (places < limits)).all(0)
        column, row = places[:, seen]
        pixels[row, column] = self.colours[seen.nonzero()[0]]
        renderer.draw_image(renderer.new_gc(), x, y, pixels)


@cache
def colours(what: str) -> Any:
    """Colour map of range, height or reflectance, low to high; black for missing values."""
    if what == "reflectance":
        scale = colormaps["cividis"]
    elif what == "height":
        scale = colormaps["turbo"]
    else:  # warm (near) to cold (far), without the dark ends, which would look like dropped rays
        scale = ListedColormap(colormaps["turbo_r"](np.linspace(0.1, 0.93, 256)))
    return scale.with_extremes(bad="black")


def _frame(axes: Any, title: str, background: str = "white") -> None:
    axes.set(xticks=[], yticks=[], facecolor=background)
    axes.spines[:].set(color="0.7", linewidth=0.5)
    axes.set_title(title, fontsize=7, loc="left", pad=2)


def _add_legend(axes: Any, names: Mapping[str, str], **place: Any) -> None:
    """Explain colours, by name, below some axes or at another place."""
    axes.legend(
        handles=[Patch(fc=colour, ec="0.7", lw=0.5, label=name) for name, colour in names.items()],
        **{"loc": "upper left", "bbox_to_anchor": (0, 0), **place},
        borderpad=0,
        ncols=len(names),
        columnspacing=1.2,
        fontsize=5,
        frameon=False,
        handlelength=1,
    )


def _add_bar(axes: Any, scale: Any, ticks: Mapping[float, float]) -> None:
    """Draw a colour bar to the right, without axes of its own, which take as long as the rest."""
    place = TransformedBbox(Bbox.from_bounds(1.012, 0, 0.014, 1), axes.transAxes)
    bar = BboxImage(place, cmap=scale.cmap, norm=scale.norm, clip_on=False)
    low, *_, high = ticks.values()
    bar.set_data(np.linspace(high, low, 256)[:, None])
    axes.add_artist(bar)
    for tick, value in ticks.items():
        text = f"{tick:z.{int(abs(tick) < 10)}f}"
        at = (1.032, (value - low) / (high - low))
        axes.annotate(text, at, xycoords="axes fraction", va="center", fontsize=6)
