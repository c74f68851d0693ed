"""Scans as pictures in the width of a paper's page: range, reflectance, bird's-eye view, 3-D perspective."""

import logging
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, hsv_to_rgb, to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from torch import Tensor

from r2flow.errors import printable
from r2flow.files import atomic_write
from r2flow.lidar.labels import CLASSES
from r2flow.lidar.projection import image_to_points

WIDTH = 7.16  # inches: two columns of an IEEE paper
VIEW = 50.0  # metres shown to each side in the bird's-eye view
HEIGHTS = (-2.8, 3.0)  # metres over which height is coloured, sensor frame
RANGES = (2.0, 80.0)  # metres over which range is coloured, on a logarithmic scale


def scan_figure(image: np.ndarray, rays: Tensor, title: str = "") -> Figure:
    """Draw one scan, (2 or 1, H, W): its images above, bird's-eye view and perspective below."""
    figure = Figure((WIDTH, 4.6), facecolor="white")
    grid = figure.add_gridspec(
        len(image) + 1, 2, height_ratios=[*[1] * len(image), 5.2], hspace=0.28, wspace=0.04,
        left=0.01, right=0.925, top=0.89, bottom=0.01, width_ratios=[1, 1.45],
    )  # fmt: skip
    draw_range(figure.add_subplot(grid[0, :]), image)
    if len(image) > 1:
        draw_reflectance(figure.add_subplot(grid[1, :]), image)
    xyz, _ = image_to_points(image, rays)
    draw_birds_eye(figure.add_subplot(grid[-1, 0]), xyz)
    draw_perspective(figure.add_subplot(grid[-1, 1]), xyz)
    returned = image[0] > 0
    size = " x ".join(map(str, returned.shape))
    about = f"{title}   {size}, {returned.sum():,} returns ({returned.mean():.0%})".strip()
    figure.suptitle(about, fontsize=8, x=0.01, ha="left")
    return figure


def contact_sheet(images: Sequence[np.ndarray], rays: Tensor, titles: Sequence[str] = ()) -> Figure:
    """Draw several scans, one per row: images on the left, bird's-eye view and perspective on the right."""
    figure, grid = _sheet([1.2] * len(images), space=0.12, top=0.18)
    for row, (image, title) in enumerate(zip_longest(images, titles)):
        first, *_ = _draw_row(figure, grid, row, image, rays)
        if title is not None:
            first.text(
                0.004, 0.94, title, transform=first.transAxes, va="top", fontsize=6,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1},
            )  # fmt: skip
    return figure


def completed_figure(
    rows: Sequence[tuple[str, np.ndarray]],
    unknown: np.ndarray,
    rays: Tensor,
    title: str = "",
    spread: np.ndarray | None = None,
    truth: tuple[np.ndarray, np.ndarray] | None = None,
) -> Figure:
    """Draw the known rays of a scan, its answers with their errors in metres, the truth and the answers' spread.

    Rows are names and images, (2 or 1, H, W), the known rays first. Rays that were not measured, (H, W) bool, are grey,
    also in the truth. The spread is the standard deviation of the range in metres and the share of answers with a
    return, (2, H, W).
    """
    shown: list[tuple[str, np.ndarray, np.ndarray | None]] = [(name, image, None) for name, image in rows]
    grey = {0: unknown}
    if truth is not None:
        answers = [(name, image, _error(image, truth[0], unknown)) for name, image in rows[1:]]
        shown = [shown[0], *answers, ("truth", truth[0], None)]
        grey[len(rows)] = truth[1]
    channels = max(len(image) for _, image, _ in shown)  # answers may have reflectance where the scan has none
    heights = [0.58 * (channels + (error is not None)) for *_, error in shown] + [0.62] * (spread is not None)
    figure, grid = _sheet(heights, space=0.2, top=0.34)
    for row, (name, image, error) in enumerate(shown):
        strips = _draw_row(figure, grid, row, image, rays, channels, error)
        legend = " (grey: not measured, black: no return)" if row == 0 else ""
        strips[0].set_title(f"{name}: range, m{legend}", fontsize=7, loc="left", pad=2)
        if row == 1 and len(strips) > len(rows[0][1]):  # the scan has no reflectance
            draw_reflectance(strips[1], image)
            strips[1].set_title("reflectance, estimated", fontsize=7, loc="left", pad=2)
        for axes in strips if row in grey else ():
            axes.imshow(np.where(grey[row][..., None], (0.6, 0.6, 0.6, 1), 0), aspect="auto", interpolation="nearest")
    if spread is not None:
        names = ("deviation of the range, m", 5), ("share of answers with a return", 1)
        for (name, most), values, place in zip(names, spread, (grid[-1, 0], grid[-1, 1:]), strict=True):
            _show(figure.add_subplot(place), values, name, "YlOrRd", {0: 0, most: most})
    figure.suptitle(title, fontsize=8, x=0.01, ha="left", y=0.995)
    return figure


def _error(image: np.ndarray, truth: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Absolute error of the range of unknown rays that return in both, else masked, (H, W)."""
    return np.ma.masked_where(~unknown | (image[0] <= 0) | (truth[0] <= 0), np.abs(image[0] - truth[0]))


def _sheet(heights: Sequence[float], space: float, top: float) -> tuple[Figure, Any]:
    """Figure with a row per scan, heights in inches, and columns of images, bird's-eye view and perspective."""
    figure = Figure((WIDTH, sum(heights) + top), facecolor="white")
    grid = figure.add_gridspec(
        len(heights), 3, width_ratios=[2.6, 0.9, 1.3], height_ratios=heights, hspace=space, wspace=0.13,
        left=0.01, right=0.94, top=1 - top / (sum(heights) + top), bottom=0.02,
    )  # fmt: skip
    return figure, grid


def _draw_row(
    figure: Figure, grid: Any, row: int, image: np.ndarray, rays: Tensor, strips_of: int = 0, error: Any = None
) -> list[Any]:
    """Draw one scan in a row of a sheet with space for `strips_of` channels; return the axes of its channels."""
    channels = max(strips_of, len(image))
    places = [grid[row, column].subgridspec(channels + (error is not None), 1, hspace=0.25) for column in range(3)]
    cells, *views = places
    strips = [figure.add_subplot(cells[channel]) for channel in range(len(image))]
    for axes, draw in zip(strips, (draw_range, draw_reflectance), strict=False):
        draw(axes, image, label=row == 0)
    if error is not None:
        scale, title = colormaps["YlOrRd"].with_extremes(bad="0.8"), "error of the range, m (grey: not compared)"
        _show(figure.add_subplot(cells[-1]), error, title, scale, {0: 0, 1: 1, 2: 2})
    xyz, _ = image_to_points(image, rays)
    for view, draw_points in zip(views, (draw_birds_eye, draw_perspective), strict=True):
        draw_points(figure.add_subplot(view[:channels, 0]), xyz, label=row == 0)  # of equal size in all rows
    return strips


def draw_range(axes: Any, image: np.ndarray, label: bool = True) -> None:
    """Draw range on a logarithmic colour scale, dropped rays black."""
    shown = np.ma.masked_where(image[0] <= 0, np.log(np.maximum(image[0], 1e-3)))
    ticks = {r: np.log(r) for r in (RANGES[0], 10, RANGES[1])}
    _show(axes, shown, "range, m" if label else "", colours("range"), ticks)


def draw_reflectance(axes: Any, image: np.ndarray, label: bool = True) -> None:
    """Draw the square root of reflectance in [0, 1] from blue to yellow, dropped rays black."""
    shown = np.ma.masked_where(image[0] <= 0, np.sqrt(np.clip(image[1], 0, 1)))
    _show(axes, shown, "reflectance" if label else "", colours("reflectance"), {0: 0.0, 0.2: 0.2**0.5, 0.8: 0.8**0.5})


def _show(axes: Any, values: np.ndarray, title: str, cmap: Any, ticks: Mapping[float, float]) -> None:
    """Draw values as an image, with a colour bar from the first to the last tick if there is a title."""
    first, *_, last = ticks.values()
    drawn = axes.imshow(values, cmap=cmap, vmin=first, vmax=last, aspect="auto", interpolation="nearest")
    _strip(axes, title)
    if title:
        _bar(axes, drawn, ticks)


def class_colours(labels: np.ndarray, most: int) -> dict[int, tuple[str, str]]:
    """Name and colour of the `most` most frequent semantic ids in labels, (N,), in order of frequency.

    Names are SemanticKITTI's if it defines all ids, else numbers.
    """
    ids, counts = np.unique(labels, return_counts=True)
    named = all(int(label) in CLASSES for label in ids)
    ordered = [int(label) for label in ids[np.argsort(-counts)][:most]]
    return {label: CLASSES[label] if named else (f"class {label}", _numbered_colour(label)) for label in ordered}


def _numbered_colour(number: int) -> str:
    """Colour of an unnamed id; the golden ratio separates the hues of neighbouring ids."""
    red, green, blue = hsv_to_rgb((number * 0.618034 % 1, 0.45 + 0.4 * (number % 3 > 0), 1 - 0.25 * (number % 2)))
    return to_hex((red, green, blue))


def draw_birds_eye(axes: Any, xyz: np.ndarray, label: bool = True) -> None:
    """Draw points from above, driving direction upwards, coloured by height."""
    x, y, z = xyz[(np.abs(xyz[:, :2]) < VIEW).all(axis=1)].T
    dot = float(np.clip(6_000 / max(len(x), 1), 0.2, 1.0))
    axes.scatter(-y, x, c=z, s=dot, cmap="turbo", vmin=HEIGHTS[0], vmax=HEIGHTS[1], lw=0, rasterized=True)
    axes.set(xlim=(-VIEW, VIEW), ylim=(-VIEW, VIEW), aspect="equal")
    axes.plot(0, 0, marker="^", color="black", ms=3)
    _strip(axes, f"bird's-eye view, {2 * VIEW:.0f} m" if label else "", "white")


def draw_perspective(axes: Any, xyz: np.ndarray, label: bool = True) -> None:
    """Draw points from behind and above the sensor, coloured by height."""
    # A pinhole camera 16 m behind and 9 m above the sensor, pitched down: x' right, y' up, depth ahead.
    eye, pitch = np.array([-16.0, 0.0, 9.0]), np.deg2rad(18)
    c, s = np.cos(pitch), np.sin(pitch)
    camera = np.array([[0, s, c], [-1, 0, 0], [0, c, -s]])  # columns: x', y' and ahead
    u, v, depth = ((xyz - eye) @ camera).T
    front = np.flatnonzero(depth > 3)
    order = front[np.argsort(-depth[front])]
    u, v, depth, z = u[order] / depth[order], v[order] / depth[order], depth[order], xyz[order, 2]
    size = np.clip(7 / depth, 0.2, 0.8) * np.sqrt(30_000 / max(len(xyz), 1))
    dots = axes.scatter(u, v, c=z, s=size, cmap="turbo", vmin=HEIGHTS[0], vmax=HEIGHTS[1], lw=0, rasterized=True)
    axes.set(xlim=(-0.95, 0.95), ylim=(-0.62, 0.48), aspect="equal")
    _strip(axes, "perspective, colour: height, m" if label else "", "white")
    if label:
        _bar(axes, dots, {z: z for z in (-2, 0, 2)})


def take_names_as_they_are(figure: Figure) -> None:
    """Show characters of file names literally, whatever a matplotlibrc says: only tick labels parse formulas."""
    warnings.filterwarnings("ignore", "Glyph .* missing from font")  # no font has all characters of file names
    for text in (artist for artist in figure.findobj() if isinstance(artist, Text)):
        text.set(text=printable(text.get_text()), usetex=False)
        if "$" in text.get_text() and not text.get_text().startswith(r"$\mathdefault"):
            text.set_parse_math(False)


def save_figure(figure: Figure, path: str | Path, dpi: int = 300, title: str = "", about: str = "") -> Path:
    """Write a PNG or PDF with its title and what it is about, atomically; equal figures have equal files."""
    path = Path(path)
    notes = {"Subject": about, "CreationDate": None} if path.suffix == ".pdf" else {"Description": about}
    take_names_as_they_are(figure)
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # else 100 lines for a PDF where INFO is shown
    with atomic_write(path) as file, rc_context({"pdf.fonttype": 42, "text.usetex": False}):  # publishers refuse Type 3
        figure.savefig(file, format=path.suffix[1:], dpi=dpi, metadata={"Title": title, **notes})
    return path


def figure_pixels(figure: Figure, dpi: int = 160) -> np.ndarray:
    """Render the figure as (height, width, 3) uint8."""
    take_names_as_they_are(figure)
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


@cache
def colours(what: str) -> Any:
    """Colour map of range, height or reflectance from low to high values; black for missing ones."""
    scale = colormaps[{"range": "turbo_r", "height": "turbo", "reflectance": "cividis"}[what]]
    if what == "range":  # warm (near) to cold (far), without the dark ends, which would look like dropped rays
        scale = ListedColormap(scale(np.linspace(0.1, 0.93, 256)))
    return scale.with_extremes(bad="black")


def _strip(axes: Any, title: str, background: str = "black") -> None:
    axes.set(xticks=[], yticks=[], facecolor=background)
    axes.spines[:].set(color="0.7", linewidth=0.5)
    if title:
        axes.set_title(title, fontsize=7, loc="left", pad=2)


def _bar(axes: Any, drawn: Any, ticks: Mapping[float, float]) -> None:
    bar = axes.figure.colorbar(drawn, cax=axes.inset_axes((1.012, 0, 0.014, 1)))
    bar.set_ticks([*ticks.values()], labels=[f"{tick:g}" for tick in ticks])
    bar.outline.set_linewidth(0.5)
    bar.ax.tick_params(labelsize=6, length=2, width=0.5, pad=1)
