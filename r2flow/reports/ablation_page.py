"""Page of an ablation: distance against the time of a scan, as tables and a figure.

Two combinations differ if their intervals of mean +- 2 standard errors do not overlap.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean, stdev

from matplotlib.figure import Figure

from r2flow.metrics.things import LINES
from r2flow.reports.figures import Plot, lines_figure, plain_ticks
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table

_DISTANCE = "distance of ranges"
COLUMNS = {
    "combination": "combination",
    "model": "model",
    "sampler": "sampler",
    "evaluations": "evaluations",
    "seconds a scan": "s a scan",
    "MiB": "MiB",
    "shown": "distance",
    "jsd": "JSD",
    "mmd": "MMD",
    "kid_handcrafted_range": "KID",
    "frechet_handcrafted_range": "Fréchet",
    **{line: line for line in LINES},
    "copies": "copies",
    "error of x_1, t = 0.5": "error of x_1",
    "parameters, millions": "M parameters",
    "GMAC": "GMAC",
    "images": "images",
}
_RULE = (
    "Distance: the panel's mean without reflectance, which some systems do not draw, ± 2 standard "
    "errors: over the seeds, or of one seed over its samples. KID, Fréchet: of features of ranges. "
    "Copies: median distance to the nearest training scan. Error of x_1: at t = 0.5. Seconds and "
    "peak memory of drawing: batches of 8. Ahead, behind: the intervals do not overlap."
)
_LINES = 8  # of the figure: the nearest combinations, whose colours differ
_AS_FAST = 1.1  # largest ratio of equal seconds a scan

_Systems = Mapping[str, Sequence[Row]]  # rows of each combination


def over_seeds(rows: Iterable[Row]) -> list[Row]:
    """One row for each sampler of each model: means, and the error of the mean over the seeds."""
    groups: dict[tuple, list[Row]] = {}
    for row in rows:
        key = tuple(row.get(k) for k in ("combination", "model", "sampler", "evaluations"))
        groups.setdefault(key, []).append(row)
    means = []
    for group in groups.values():
        numbers = [key for key, value in group[0].items() if isinstance(value, int | float)]
        mean = group[0] | {key: fmean(row[key] for row in group) for key in numbers}
        if len(group) > 1:
            mean["error"] = stdev(row[_DISTANCE] for row in group) / math.sqrt(len(group))
        means.append(mean | {"shown": f"{mean[_DISTANCE]:.3f} ± {2 * mean['error']:.3f}"})
    return means


def frontier(rows: Iterable[Row]) -> list[Row]:
    """The rows nearer than every faster one, by their seconds a scan."""
    kept: list[Row] = []
    for row in sorted(rows, key=lambda row: row["seconds a scan"]):
        if not kept or row[_DISTANCE] < kept[-1][_DISTANCE]:
            kept.append(row)
    return kept


def verdict(ours: Row, other: Row) -> str:
    """Whether one row is ahead of another, level or behind."""
    difference = other[_DISTANCE] - ours[_DISTANCE]
    if abs(difference) <= 2 * (ours["error"] + other["error"]):
        return "level"
    return "ahead" if difference > 0 else "behind"


def _against(ours: Row, other: Row) -> str:
    """A verdict with the other's distance."""
    preposition = {"ahead": " of", "level": " with", "behind": ""}
    word = verdict(ours, other)
    return f"{word}{preposition[word]} {other[_DISTANCE]:.3f}"


def _against_system(ours: Row, rows: Sequence[Row]) -> str:
    """The verdict against another's best row that is as fast, else against its fastest one, with
    its seconds.
    """
    fast = [r for r in rows if r["seconds a scan"] <= _AS_FAST * ours["seconds a scan"]]
    if fast:
        return _against(ours, frontier(fast)[-1])
    fastest = frontier(rows)[0]
    return f"{_against(ours, fastest)} in {fastest['seconds a scan']:.2g} s"


def compared(systems: _Systems, baseline: Row) -> list[Row]:
    """The best row of the first combination in each number of evaluations against the others at
    equal seconds a scan, and against a baseline.
    """
    first, *others = systems
    found = []
    for count in sorted({row["evaluations"] for row in systems[first]}):
        rows = [row for row in systems[first] if row["evaluations"] == count]
        best = min(rows, key=lambda row: row[_DISTANCE])
        row = {
            "in": f"{count:g}",
            "model": best["model"],
            "s": f"{best['seconds a scan']:.2g}",
            first: best["shown"],
            baseline["combination"]: _against(best, baseline),
        }
        found.append(row | {name: _against_system(best, systems[name]) for name in others})
    return found


def ablation_page(
    rows: Sequence[Row], names: Sequence[str], budget: float, about: str, device: str
) -> Page:
    """Build the page of the stored rows of these combinations; the table and the figure are of one
    budget, of which there is at least one row.

    The training scans are the table's first row, the best baseline is its last one.
    """
    references = over_seeds(row for row in rows if not row["budget"])
    last = min(references[1:], key=lambda row: row[_DISTANCE])
    systems: dict[str, list[Row]] = {}
    learned: dict[str, Row] = {}
    for name in names:
        runs = [row for row in rows if row["combination"] == name and row["budget"]]
        if measured := over_seeds(row for row in runs if row["budget"] == budget):
            systems[name] = measured
        learned[name] = {"combination": name}
        for seconds in sorted({row["budget"] for row in runs}):
            distances = [row[_DISTANCE] for row in runs if row["budget"] == seconds]
            learned[name][f"{seconds / 60:.3g} min"] = min(distances)
    lines = [references[0], *(row for each in systems.values() for row in each), last]
    against = compared(systems, last)
    headings = {key: key for row in learned.values() for key in row}
    text: list[Part] = [
        f"{next(iter(systems))} by network evaluations, with its seconds a scan, against what is "
        "as fast; of slower ones their seconds are named:",
        Table(against, {key: key for key in against[0]}),
        f"Smallest distance by training time; {last['combination']}: {last[_DISTANCE]:.3f}.",
        Table(list(learned.values()), headings),
        about,
        Table(lines, COLUMNS),
        _RULE,
    ]
    nearest = sorted(systems, key=lambda name: min(row[_DISTANCE] for row in systems[name]))
    drawn = {name: rows for name, rows in systems.items() if name in nearest[:_LINES]}
    figures = {"ablation": _figure(drawn, [references[0], last])}
    return Page("ablation", "Equal training time", text, lines, figures, {}, device)


def _figure(systems: _Systems, references: Sequence[Row]) -> Figure:
    """Distance against seconds and, of backbones, GMAC a scan: all rows as points with bars, those
    that no faster one beats as a line.
    """
    axes = {"seconds a scan": lambda row: row["seconds a scan"]}
    if all(row.get("GMAC") for rows in systems.values() for row in rows):
        axes["GMAC a scan"] = lambda row: row["GMAC"] * row["evaluations"]
    best = {name: frontier(rows) for name, rows in systems.items()}
    plots = []
    for label, x in axes.items():
        lines = {n: ([*map(x, rows)], [r[_DISTANCE] for r in rows]) for n, rows in best.items()}
        plots.append(Plot(label, "distance", lines, log_x=True))
    figure = lines_figure(plots, 2)
    for panel, x in zip(figure.axes, axes.values(), strict=True):
        panel.set_yscale("log")
        plain_ticks(panel.yaxis)
        for line, rows in zip([*panel.lines], systems.values(), strict=True):
            style: Row = {
                "fmt": line.get_marker(),
                "color": line.get_color(),
                "ms": 3,
                "alpha": 0.5,
            }
            bars = [2 * row["error"] for row in rows]
            panel.errorbar([*map(x, rows)], [row[_DISTANCE] for row in rows], bars, **style)
        for row in references:
            panel.axhline(row[_DISTANCE], color="0.4", lw=0.8, ls=":")
            panel.annotate(
                row["combination"],
                (1, row[_DISTANCE]),
                xycoords=("axes fraction", "data"),
                ha="right",
            )
    return figure
