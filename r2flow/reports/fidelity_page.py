"""The page of `r2flow report fidelity`: distances against the floor, histograms, scans side by side."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.lidar.sensors import Sensor
from r2flow.metrics.fidelity import mean_difference
from r2flow.reports.fidelity import MEMBERS, WITHIN, Statistics, markdown, per_pixel_table
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.pictures import draw_range, draw_reflectance

SIDE_BY_SIDE = 6  # scans of each set in the picture
LEAST = 1e-4  # a distance of nothing, on a logarithmic axis


def fidelity_page(
    result: Mapping[str, Any],
    statistics: Mapping[str, Statistics],
    real: np.ndarray,
    other: np.ndarray,
    sensor: Sensor,
    name: str,
    command: str,
    seed: int = 0,
) -> Page:
    """Everything on a page.

    Args:
        result: Of `compare_sets`, with its statistics.
        real: The images that were compared, (N, 2 or 1, H, W); a few of them are drawn.
        name: What the judged set is called.
    """
    rows = [
        {"member": line, "judged": judged, "set": name if key == "other" else key, "distance": value}
        for judged, sets in ((True, result["sets"]), (False, result["per_pixel"]))
        for key, lines in sets.items()
        for line, value in lines.items()
    ]
    apart = (
        "Dropped from the panel, shown for comparison with other work: statistics of single pixels. Pixels shuffled "
        "across real scans have them as real scans do."
    )
    figures = {
        "fidelity": distance_figure(result, name),
        "fidelity_histograms": histogram_figure(statistics, sensor, name),
        "fidelity_scans": scans_figure(real, other, name),
    }
    # The rows of the page's JSON are lists or tables.
    more: dict[str, Any] = {k: [value] if isinstance(value, str | None) else value for k, value in result.items()}
    text = [markdown(result, name), apart, per_pixel_table(result, name)]
    return Page("fidelity", f"Fidelity of {name}", text, rows, figures, command, {"controls": seed}, more=more)


def distance_figure(result: Mapping[str, Any], name: str) -> Figure:
    """Every member's distances, in units of the floor where there is one."""
    lines = list(result["sets"]["other"])
    figure = blank_figure(9, 0.42 * len(lines) + 1.6, "Distance to the real scans")
    axes = figure.add_subplot()
    y = np.arange(len(lines))[::-1]
    unit = np.array([max(result["floor"].get(line, 1.0), LEAST) if result["floor"] else 1.0 for line in lines])
    if result["floor"]:
        axes.axvspan(0, WITHIN, color="#e8f0e4", zorder=0, label="within twice the floor")
        axes.axvline(1, color="#3d7d3a", lw=1.5, label=f"floor: {result['floor_is']}")
    for style, (key, found) in zip(STYLES, result["sets"].items(), strict=False):
        if key == result["floor_is"]:
            continue  # the line at 1
        values = np.array([max(found[line], LEAST) for line in lines]) / unit
        big = key == "other"
        look: dict[str, Any] = {"ms": 9, "zorder": 3} if big else {"ms": 6, "zorder": 2, "alpha": 0.85}
        axes.plot(values, y, style["marker"], color=style["color"], label=name if big else key, **look)
    shown = [f"{line} (not judged)" if line in result["blind"] else line for line in lines]
    axes.set(xscale="log", ylim=(-0.7, len(lines) - 0.3), xlabel="distance / floor" if result["floor"] else "distance")
    axes.set_yticks(y, shown)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3, axis="both", which="major")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def histogram_figure(statistics: Mapping[str, Statistics], sensor: Sensor, name: str) -> Figure:
    """The statistics of one dimension: real, judged, and a further real set or the shuffled pixels beside them."""
    drawn = [line for line, value in statistics["real"].items() if value.ndim == 1]
    sets = ["real", "other", *(s for s in ("other real scans", "training scans", "shuffled pixels") if s in statistics)]
    columns = 4
    lines = -(-len(drawn) // columns)
    figure = blank_figure(14, 2.5 * lines)
    for index, line in enumerate(drawn):
        member = MEMBERS[line]
        axes = figure.add_subplot(lines, columns, index + 1)
        for style, key in zip(STYLES, sets, strict=False):
            value = np.asarray(statistics[key][line], dtype=float)
            value = value if member.distance is mean_difference else value / max(value.sum(), 1)
            axes.plot(
                member.places(len(value), sensor), value, color=style["color"], linestyle=style["linestyle"], lw=1.3,
                label=name if key == "other" else key,
            )  # fmt: skip
        axes.set_title(line, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
        axes.set_xlabel(member.label, fontsize=7)
        if member.log:
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter("")
            axes.xaxis.set_major_formatter("{x:g}")
        if line in ("drop rate by range", "range histogram"):
            axes.set_xticks([2, 5, 10, 20, 50, 100])
            axes.set_xlim(sensor.min_range, sensor.max_range)
        if index == 0:
            axes.legend(fontsize=7)
    return figure


def scans_figure(real: np.ndarray, other: np.ndarray, name: str) -> Figure:
    """Up to six scans of each set, the half ahead: real on the left, judged on the right; range over reflectance."""
    chosen = [s[np.linspace(0, len(s) - 1, min(SIDE_BY_SIDE, len(s))).round().astype(int)] for s in (real, other)]
    rows, strips = max(map(len, chosen)), min(s.shape[1] for s in chosen)
    figure = blank_figure(14, 0.62 * rows * strips + 0.5, "")
    figure.set_layout_engine("none")
    top = 1 - 0.3 / (0.62 * rows * strips + 0.5)
    grid = figure.add_gridspec(rows, 2, left=0.005, right=0.995, bottom=0.01, top=top, hspace=0.06, wspace=0.01)
    for column, (title, images) in enumerate(zip(("real", name), chosen, strict=True)):
        quarter = images.shape[-1] // 4
        for row, image in enumerate(images[..., quarter : images.shape[-1] - quarter]):
            parts = grid[row, column].subgridspec(strips, 1, hspace=0.05)
            axes = figure.add_subplot(parts[0])
            draw_range(axes, image, label=False)
            if strips > 1:
                draw_reflectance(figure.add_subplot(parts[1]), image, label=False)
            if row == 0:
                axes.set_title(title, fontsize=10, loc="left", pad=3)
    return figure
