"""Scans as pictures: range, reflectance, bird's-eye view, 3-D perspective."""

from collections.abc import Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, hsv_to_rgb, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from torch import Tensor

from r2flow.errors import printable
from r2flow.files import atomic_write
from r2flow.lidar.labels import CLASSES
from r2flow.lidar.projection import image_to_points

BACKGROUND, FOREGROUND = "#101418", "#d8dee4"
VIEW = 50.0  # metres shown to each side in the bird's-eye view
HEIGHTS = (-2.8, 3.0)  # metres over which height is coloured, sensor frame
RANGES = (2.0, 80.0)  # metres over which range is coloured, on a logarithmic scale


def scan_figure(image: np.ndarray, rays: Tensor, title: str = "", labels: np.ndarray | None = None) -> Figure:
    """Draw one scan, with an extra row for semantic ids of pixels, (H, W)."""
    figure = dark_figure(13, 8.6 if labels is None else 9.6)
    strips = len(image) + (labels is not None)
    grid = figure.add_gridspec(
        strips + 1, 2, height_ratios=[1] * strips + [5.2], hspace=0.16, wspace=0.06,
        left=0.03, right=0.97, top=0.93, bottom=0.03, width_ratios=[1, 1.45],
    )  # fmt: skip
    draw_range(figure.add_subplot(grid[0, :]), image)
    if len(image) > 1:
        draw_reflectance(figure.add_subplot(grid[1, :]), image)
    if labels is not None:
        draw_labels(figure.add_subplot(grid[strips - 1, :]), image, labels)
    xyz, _ = image_to_points(image, rays)
    draw_birds_eye(figure.add_subplot(grid[strips, 0]), xyz)
    draw_perspective(figure.add_subplot(grid[strips, 1]), xyz)
    returned = image[0] > 0
    size = " x ".join(map(str, returned.shape))
    about = f"{title}   {size}, {returned.sum():,} returns ({returned.mean():.0%})".strip()
    figure.suptitle(about, color=FOREGROUND, fontsize=11, x=0.03, ha="left")
    return figure


def contact_sheet(images: Sequence[np.ndarray], rays: Tensor, titles: Sequence[str] = ()) -> Figure:
    """Draw several scans, one per row: images on the left, bird's-eye view and perspective on the right."""
    figure, grid = _sheet([2.5] * len(images), space=0.12, top=0.3)
    for row, (image, title) in enumerate(zip_longest(images, titles)):
        first, *_ = _draw_row(figure, grid, row, image, rays)
        if title is not None:
            first.text(
                0.004, 0.94, title, transform=first.transAxes, va="top", fontsize=8, color="white",
                bbox={"facecolor": BACKGROUND, "edgecolor": "none", "alpha": 0.7, "pad": 1.5},
            )  # fmt: skip
    return figure


def completed_figure(
    rows: Sequence[tuple[str, np.ndarray]],
    unknown: np.ndarray,
    rays: Tensor,
    title: str = "",
    spread: np.ndarray | None = None,
) -> Figure:
    """Draw the known rays of a scan, its answers and their spread.

    Args:
        rows: Name and image, (2 or 1, H, W), of each; the known rays first.
        unknown: Rays that were not measured, (H, W) bool; drawn in grey.
        spread: Standard deviation of the range in metres and share of answers with a return, (2, H, W).
    """
    figure, grid = _sheet([2.4] * len(rows) + [1.3] * (spread is not None), space=0.16, top=0.5)
    grey = np.where(unknown[..., None], np.array([0.45, 0.45, 0.45, 1.0]), 0.0)
    channels = max(len(image) for _, image in rows)  # answers may have reflectance where the scan has none
    for row, (name, image) in enumerate(rows):
        strips = _draw_row(figure, grid, row, image, rays, channels)
        legend = " (grey: not measured, black: measured without a return)" if row == 0 else ""
        strips[0].set_title(f"{name}: range{legend}", color=FOREGROUND, fontsize=8, loc="left", pad=3)
        for axes in strips if row == 0 else ():
            axes.imshow(grey, aspect="auto", interpolation="nearest")
    if spread is not None:
        shown = ("deviation of the range, 0 to 5 m", 5.0), ("share of answers with a return, 0 to 1", 1.0)
        for (name, most), values, place in zip(shown, spread, (grid[-1, 0], grid[-1, 1:]), strict=True):
            axes = figure.add_subplot(place)
            axes.imshow(values, cmap="magma", vmin=0, vmax=most, aspect="auto", interpolation="nearest")
            _strip(axes, name)
    figure.suptitle(title, color=FOREGROUND, fontsize=11, x=0.01, ha="left", y=0.995)
    return figure


def _sheet(heights: Sequence[float], space: float, top: float) -> tuple[Figure, Any]:
    """Dark figure with a row per scan, heights in inches, and columns of images, bird's-eye view and perspective."""
    figure = dark_figure(15, sum(heights))
    grid = figure.add_gridspec(
        len(heights), 3, width_ratios=[2.6, 0.9, 1.3], height_ratios=heights, hspace=space, wspace=0.03,
        left=0.01, right=0.99, top=1 - top / sum(heights), bottom=0.01,
    )  # fmt: skip
    return figure, grid


def _draw_row(figure: Figure, grid: Any, row: int, image: np.ndarray, rays: Tensor, strips_of: int = 0) -> list[Any]:
    """Draw one scan in a row of a sheet with space for `strips_of` channels; return the axes of its channels."""
    cells = grid[row, 0].subgridspec(max(strips_of, len(image)), 1, hspace=0.18)
    strips = [figure.add_subplot(cells[channel]) for channel in range(len(image))]
    for axes, draw in zip(strips, (draw_range, draw_reflectance), strict=False):
        draw(axes, image, label=row == 0)
    xyz, _ = image_to_points(image, rays)
    draw_birds_eye(figure.add_subplot(grid[row, 1]), xyz, label=row == 0)
    draw_perspective(figure.add_subplot(grid[row, 2]), xyz, label=row == 0)
    return strips


def draw_range(axes: Any, image: np.ndarray, label: bool = True) -> None:
    """Draw range on a logarithmic colour scale, dropped rays black."""
    _draw_channel(axes, image, "range", np.log(np.maximum(image[0], 1e-3)), np.log(RANGES), label)


def draw_reflectance(axes: Any, image: np.ndarray, label: bool = True) -> None:
    """Draw the square root of reflectance in [0, 1] from blue to yellow, dropped rays black."""
    _draw_channel(axes, image, "reflectance", np.sqrt(np.clip(image[1], 0, 1)), (0, 0.9), label)


def _draw_channel(axes: Any, image: np.ndarray, what: str, shown: np.ndarray, limits: Any, label: bool) -> None:
    shown = np.ma.masked_where(image[0] <= 0, shown)
    axes.imshow(shown, cmap=colours(what), vmin=limits[0], vmax=limits[1], aspect="auto", interpolation="nearest")
    _strip(axes, what if label else "")


def draw_labels(axes: Any, image: np.ndarray, labels: np.ndarray) -> None:
    """Draw semantic ids, (H, W), named as in `class_colours`; dropped rays black."""
    returned = image[0] > 0
    shown = np.zeros((*labels.shape, 3))
    entries: dict[str, Any] = {}
    for label, (name, colour) in class_colours(labels[returned]).items():
        shown[returned & (labels == label)] = to_rgb(colour)
        entries.setdefault(name, colour)
    axes.imshow(shown, aspect="auto", interpolation="nearest")
    _strip(axes, "labels")
    x = 0.05
    for name, colour in list(entries.items())[:14]:  # as many as fit, most frequent first
        axes.text(x, 1.03, name, transform=axes.transAxes, color=colour, fontsize=8, va="bottom")
        x += 0.012 + 0.0052 * len(name)


def class_colours(labels: np.ndarray, most: int | None = None) -> dict[int, tuple[str, str]]:
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
    dot = float(np.clip(20_000 / max(len(x), 1), 0.25, 3.0))
    axes.scatter(-y, x, c=z, s=dot, cmap="turbo", vmin=HEIGHTS[0], vmax=HEIGHTS[1], lw=0, rasterized=True)
    axes.set(xlim=(-VIEW, VIEW), ylim=(-VIEW, VIEW), aspect="equal")
    axes.plot(0, 0, marker="^", color="white", ms=4)
    _strip(axes, f"bird's-eye view, {2 * VIEW:.0f} m" if label else "")


def draw_perspective(axes: Any, xyz: np.ndarray, label: bool = True) -> None:
    """Draw points from behind and above the sensor, coloured by height."""
    # A pinhole camera 16 m behind and 9 m above the sensor, pitched down: x' right, y' up, depth ahead.
    eye, pitch = np.array([-16.0, 0.0, 9.0]), np.deg2rad(18)
    ahead = np.array([np.cos(pitch), 0, -np.sin(pitch)])
    up = np.array([np.sin(pitch), 0, np.cos(pitch)])
    relative = xyz - eye
    depth = relative @ ahead
    front = depth > 3
    relative, depth, z = relative[front], depth[front], xyz[front, 2]
    order = np.argsort(-depth)
    u, v = (-relative[:, 1] / depth)[order], (relative @ up / depth)[order]
    size = np.clip(18 / depth[order], 0.25, 2.6) * np.sqrt(30_000 / max(len(xyz), 1))
    axes.scatter(u, v, c=z[order], s=size, cmap="turbo", vmin=HEIGHTS[0], vmax=HEIGHTS[1], lw=0, rasterized=True)
    axes.set(xlim=(-0.95, 0.95), ylim=(-0.52, 0.42))
    _strip(axes, "perspective" if label else "")


def take_names_as_they_are(figure: Figure) -> None:
    """Show dollar signs in file names literally: only tick labels parse formulas."""
    for text in figure.findobj(Text):
        if isinstance(text, Text) and not text.get_text().isascii():
            text.set_text(printable(text.get_text()))
        if isinstance(text, Text) and "$" in text.get_text() and not text.get_text().startswith(r"$\mathdefault"):
            text.set_parse_math(False)


def save_figure(figure: Figure, path: str | Path, dpi: int = 110, **notes: str) -> Path:
    """Write a PNG with notes, atomically."""
    path = Path(path)
    take_names_as_they_are(figure)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=dpi, facecolor=figure.get_facecolor(), metadata=notes)
    return path


def figure_pixels(figure: Figure, dpi: int = 80) -> np.ndarray:
    """Render the figure as (height, width, 3) uint8."""
    take_names_as_they_are(figure)
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def dark_figure(width: float, height: float) -> Figure:
    """Create an empty figure for scans, sized in inches."""
    return Figure(figsize=(width, height), facecolor=BACKGROUND)


@cache
def colours(what: str) -> Any:
    """Colour map of range, height or reflectance from low to high values; black for missing ones."""
    scale = colormaps[{"range": "turbo_r", "height": "turbo", "reflectance": "cividis"}[what]]
    if what == "range":  # warm (near) to cold (far), without the dark ends, which would look like dropped rays
        scale = ListedColormap(scale(np.linspace(0.1, 0.93, 256)))
    return scale.with_extremes(bad="black")


def _strip(axes: Any, title: str) -> None:
    axes.set(xticks=[], yticks=[], facecolor="black")
    axes.spines[:].set_visible(False)
    if title:
        axes.set_title(title, color=FOREGROUND, fontsize=8, loc="left", pad=3)
