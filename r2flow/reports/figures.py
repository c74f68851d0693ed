"""Figures: lines in panels, and their files."""

import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, StrMethodFormatter

from r2flow.base.errors import printable
from r2flow.base.files import atomic_write

# Markers and dashes distinguish lines without colour.
STYLES: tuple[dict[str, Any], ...] = tuple(
    {"marker": marker, "linestyle": dash, "color": f"C{number}"}
    for number, (marker, dash) in enumerate(
        zip("os^DvPX*<>", ("-", "--", "-.", ":", "-") * 2, strict=True)
    )
)


def blank_figure(width: float, height: float) -> Figure:
    """Create an empty figure, sized in inches."""
    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


class Plot(NamedTuple):
    """Lines in one panel of a figure."""

    x: str  # labels of the axes
    y: str
    lines: Mapping[str, tuple[Any, Any]]  # x and y by label
    title: str = ""
    log_x: bool = False


def lines_figure(plots: Sequence[Plot], columns: int) -> Figure:
    """Draw plots in rows of `columns`; equal labels share a style.

    The y axis is logarithmic if its values are positive and differ by more than three times. The
    legend is left out if there are more labels than styles.
    """
    labels = list(dict.fromkeys(label for plot in plots for label in plot.lines))
    columns = min(columns, len(plots))
    rows = math.ceil(len(plots) / columns)
    legend = len(labels) <= len(STYLES)
    figure = blank_figure(4.2 * columns + 0.4, 3.3 * rows + (0.18 * len(labels) if legend else 0))
    for place, plot in enumerate(plots, 1):
        axes = figure.add_subplot(rows, columns, place)
        for label, (x, y) in plot.lines.items():
            style = STYLES[labels.index(label) % len(STYLES)]
            interval = max(len(x) // 8, 1)
            axes.plot(x, y, **style, ms=4, lw=1.1, markevery=interval, label=label)
        axes.set(xlabel=plot.x, ylabel=plot.y, xscale="log" if plot.log_x else "linear")
        axes.set_title(plot.title, fontsize=9)
        values = [v for _, y in plot.lines.values() for v in np.ravel(y) if math.isfinite(v)]
        if values and 0 < 3 * min(values) < max(values):  # else its labels would be 1.11 x 10^0
            axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log":
                plain_ticks(axis)
        axes.grid(color="0.88", lw=0.6)
        axes.tick_params(which="both", labelsize=8)
    if legend:
        handles = {line.get_label(): line for axes in figure.axes for line in axes.lines}
        figure.legend(handles=handles.values(), fontsize=8, loc="outside lower left", frameon=False)
    return figure


def plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis by 0.1, 0.3, 1, ..., which stay apart."""
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_locator(LogLocator(subs=(3,)))
    axis.set_minor_formatter(StrMethodFormatter("{x:g}"))


def save_figure(
    figure: Figure, path: Path, dpi: int = 300, title: str = "", about: str = ""
) -> Path:
    """Write a PNG or PDF with its title and what it is about, atomically; equal figures have equal
    files.
    """
    notes: dict[str, Any] = {"Title": title, "Description": about}
    how: dict[str, Any] = {"pil_kwargs": {"compress_level": 1}}  # a third faster, a fifth larger
    if path.suffix == ".pdf":
        notes = {"Title": title, "Subject": about, "CreationDate": None}
        how = {}
    _show_names_literally(figure)
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # it logs 100 lines for a PDF
    settings: Any = {"pdf.fonttype": 42, "text.usetex": False}  # publishers refuse Type 3 fonts
    with atomic_write(path) as file, rc_context(settings):
        figure.savefig(file, format=path.suffix[1:], dpi=dpi, metadata=notes, **how)
    return path


def figure_pixels(figure: Figure, dpi: int = 160) -> np.ndarray:
    """Render the figure as (height, width, 3) uint8."""
    _show_names_literally(figure)
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _show_names_literally(figure: Figure) -> None:
    """Show characters of file names as they are: only tick labels parse formulas."""
    warnings.filterwarnings("ignore", "Glyph .* missing from font")  # no font has all of them
    for text in figure.findobj(Text):
        content = printable(text.get_text())
        text.set(text=content, usetex=False)
        if "$" in content and not content.startswith(r"$\mathdefault"):
            text.set_parse_math(False)
