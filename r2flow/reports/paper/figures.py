"""The paper's figures 5 and 6; figures 3, 7 and 8 are drawn by the reports on single runs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.metrics.birds_eye import EXTENT, js_distance
from r2flow.reports.pages import STYLES, blank_figure, few_log_ticks
from r2flow.reports.tables import Row


def marginals(birds_eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many points lie at each x, (100,), and at each y, of a bird's-eye histogram (100, 100)."""
    return birds_eye.sum(1), birds_eye.sum(0)


def marginals_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Mean Jensen-Shannon distance of two histograms' marginals."""
    return float(np.mean([js_distance(x, y) for x, y in zip(marginals(a), marginals(b), strict=True)]))


def birds_eye_figure(real: np.ndarray, made: Mapping[str, np.ndarray]) -> Figure:
    """Figure 5: where points lie from above, (100, 100) each, with their marginals over the data's."""
    names = [*made, "real scans"]
    figure = blank_figure(2.75 * len(names) + 0.5, 3.6)
    figure.set_layout_engine("none")
    outer = figure.add_gridspec(1, len(names), left=0.5 / figure.get_figwidth(), right=0.99, bottom=0.13, top=0.86)
    for place, name in enumerate(names):
        counts = made.get(name, real)
        grid = outer[place].subgridspec(2, 2, height_ratios=(1, 3.2), width_ratios=(3.2, 1), hspace=0.03, wspace=0.03)
        axes = figure.add_subplot(grid[1, 0])
        share = counts / max(counts.sum(), 1)
        # Ahead is up and left is left, as in every other picture from above.
        picture = np.log10(share[::-1, ::-1] + 1e-7)
        extent = (EXTENT, -EXTENT, -EXTENT, EXTENT)
        axes.imshow(picture, extent=extent, cmap="magma", vmin=-6, vmax=-2, aspect="auto")
        axes.set(xlabel="y, m", ylabel="x, m" if place == 0 else "", xticks=(60, 0, -60), yticks=(-60, 0, 60))
        axes.tick_params(labelsize=7, labelleft=place == 0)
        above, beside = figure.add_subplot(grid[0, 0], sharex=axes), figure.add_subplot(grid[1, 1], sharey=axes)
        _draw_marginals(above, beside, counts, real)
        distance = f"\nmarginals apart {marginals_apart(counts, real):.3f}" if name in made else "\n"
        above.set_title(f"{name}{distance}", fontsize=8)
    return figure


def _draw_marginals(above: Any, beside: Any, counts: np.ndarray, real: np.ndarray) -> None:
    """Shares along y above and along x beside, the data's dotted."""
    centres = (np.arange(100) + 0.5) / 100 * 2 * EXTENT - EXTENT
    for histogram, style in ((counts, {"color": "#1f6fb4", "lw": 1.0}), (real, {"color": "0.2", "lw": 0.8, "ls": ":"})):
        along_x, along_y = (m / max(m.sum(), 1) for m in marginals(histogram))
        above.plot(centres, along_y, **style)
        beside.plot(along_x, centres, **style)
    for panel in (above, beside):
        panel.tick_params(labelbottom=False, labelleft=False, bottom=False, left=False)
        for spine in panel.spines.values():
            spine.set_visible(False)


def trade_off_figure(rows: Sequence[Row], metrics: Mapping[str, str]) -> Figure:
    """Figure 6: distance against evaluations and against seconds, a band over seeds.

    A line for each role, of each kind of network where there are several.

    Args:
        rows: As `claims` takes them, with `seconds` a scan.
        metrics: Name -> heading.
    """
    figure = blank_figure(10, 3.1 * len(metrics) + 0.3)
    lines = list(dict.fromkeys((row["role"], row.get("kind", "")) for row in rows))
    several = len({kind for _, kind in lines if kind}) > 1
    for place, (metric, heading) in enumerate(metrics.items()):
        for side, (work, label) in enumerate((("steps", "network evaluations"), ("seconds", "seconds a scan"))):
            axes = figure.add_subplot(len(metrics), 2, 2 * place + side + 1)
            for number, (role, kind) in enumerate(lines):
                own = [row for row in rows if (row["role"], row.get("kind", "")) == (role, kind)]
                _draw_line(axes, own, work, metric, f"{role}, {kind}" if several and kind else role, number)
            axes.set_xscale("log", base=2 if work == "steps" else 10)
            axes.set_yscale("log")
            axes.set(xlabel=label, ylabel=heading if side == 0 else "")
            if work == "seconds":
                few_log_ticks(axes.xaxis)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            few_log_ticks(axes.yaxis)
            axes.grid(True, which="both", color="0.9", lw=0.6)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), fontsize=8, frameon=False)
    return figure


def _draw_line(axes: Any, rows: Sequence[Row], work: str, metric: str, role: str, number: int) -> None:
    measured = [row for row in rows if row.get(metric) is not None and row[metric] > 0]
    steps = sorted({row["steps"] for row in measured})
    if not steps:
        return
    at = [[row for row in measured if row["steps"] == n] for n in steps]
    x = [np.median([row[work] for row in same]) for same in at]
    y = np.array([[f([row[metric] for row in same]) for f in (np.mean, np.min, np.max)] for same in at])
    style = STYLES[number % len(STYLES)]
    axes.plot(x, y[:, 0], **style, ms=6, lw=1.4, label=role)
    if max(map(len, at)) > 1:
        axes.fill_between(x, y[:, 1], y[:, 2], color=style["color"], alpha=0.12, lw=0)
