"""Error against work: figures, tables and which solver for which budget (the page)."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import shown, table
from r2flow.reports.work_precision import METHODS, TRUST, Reference, best_within, reached, recommended

Row = Mapping[str, Any]
Axis = tuple[str, str]  # key of a row, label

EVALUATIONS: Axis = ("evaluations", "network evaluations a scan")
SECONDS: Axis = ("seconds", "seconds a scan")
ERROR: Axis = ("error", "RMS error, model space")
PANELS: tuple[tuple[Axis, Axis], ...] = (  # of a checkpoint
    (EVALUATIONS, ERROR),
    (SECONDS, ERROR),
    (EVALUATIONS, ("range_rms_m", "RMS range error, m")),
    (EVALUATIONS, ("drop_differs", "share of rays that differ in ray-drop")),
)
COLUMNS = {
    "label": "configuration", "grid": "grid", "evaluations": "evaluations", "seconds": "seconds",
    "seconds_quarter": "quartile", "seconds_three_quarters": "quartile", "error": "error, median",
    "error_p95": "95th percentile", "error_worst": "worst scan", "range_rms_m": "range, RMS m",
    "range_median_m": "range, median m", "drop_differs": "ray-drop differs", "front": "Pareto",
}  # fmt: skip
NOTE = (
    "All configurations. Errors are RMS over the elements of a scan in model space; in metres, over the rays that both "
    "solutions return, the median over scans. Seconds are for a scan, the median and quartiles over all its solutions, "
    "which took turns with those of the other configurations."
)


def work_precision_page(
    rows: Sequence[Row],
    name: str | None,
    found: Reference | None,
    budgets: Sequence[int],
    seeds: Mapping[str, int],
    command: str,
    device: str = "cpu",
) -> Page:
    """The report, of a checkpoint, of exact problems or of both; the table of all configurations comes last.

    Args:
        name: The checkpoint's, as in its rows; None where there is none.
        found: What its errors are measured against.
        budgets: Evaluations that were asked for.
    """
    of_checkpoint = [row for row in rows if row["problem"] == name]
    of_problems = [row for row in rows if row["problem"] != name]
    text, figures = [], {}
    if name is not None and found is not None:
        text += checkpoint_text(of_checkpoint, name, found, budgets)
        figures["work_precision"] = checkpoint_figure(of_checkpoint, name)
    if of_problems:
        text += problems_text(of_problems, budgets)
        figures["exact_problems"] = problems_figure(of_problems, EVALUATIONS)
        figures["exact_problems_time"] = problems_figure(of_problems, SECONDS)
    if name is not None:
        works = ("evaluations", "seconds")
        fronts = [" and ".join(work for work in works if row[f"pareto_{work}"]) for row in of_checkpoint]
        lines = [{**row, "front": front} for row, front in zip(of_checkpoint, fronts, strict=True)]
        text += [NOTE, table(lines, COLUMNS), recommendation(of_checkpoint)]
    return Page("work_precision", "Error against work", text, rows, figures, command, seeds, device)


def checkpoint_text(rows: Sequence[Row], name: str, found: Reference, budgets: Sequence[int]) -> list[str]:
    """Which solver for which budget on a checkpoint, and the least error that can be measured."""
    below = sum(not row["judged"] for row in rows)
    median, worst = shown(float(np.median(found.disagreement))), shown(float(found.disagreement.max()))
    text = [
        f"**{name}**, {rows[0]['scenes']} scans, against its own tight solution: rk4 in {found.steps} steps, both with "
        f"a float64 state, {found.evaluations:.0f} evaluations a scan. dopri5 at {found.tolerance:.0e} differs from it "
        f"by {median} (median RMS; worst scan {worst}). Errors above {shown(found.floor)}, {TRUST:g} times that, can "
        f"be measured; {below} of {len(rows)} configurations are below: for these take more --reference-steps.",
        "The most accurate solver by evaluations a scan:",
        best_table(rows, {f"{budget:g}": budget for budget in sorted(budgets)}, "evaluations"),
    ]
    # The upper quartile: as many evaluations of another solver fit into it, whatever the clock's noise.
    euler = {row["steps"]: row["seconds_three_quarters"] for row in rows if row["method"] == "euler"}
    if euler:
        times = {f"{steps} Euler steps' time ({shown(euler[steps])} s)": euler[steps] for steps in sorted(euler)}
        text += ["By time a scan:", best_table(rows, times, "seconds")]
    return text


def recommendation(rows: Sequence[Row]) -> str:
    """Which solver to take for a flow, in one line."""
    row = recommended(rows)
    if row is None:
        return "For this flow: no configuration solves it."
    how = row["label"] if row["steps"] is None else f"{row['method']} on the grid {row['grid']}"
    metres = "" if row["range_rms_m"] is None else f", {shown(row['range_rms_m'])} m"
    return f"For this flow: {how}, {row['evaluations']:.0f} evaluations, error {shown(reached(row))}{metres}."


def best_table(rows: Sequence[Row], budgets: Mapping[str, float], work: str) -> str:
    """The most accurate configuration within each budget of work; "none" where no solver gets nearer than x_0."""
    lines = []
    for name, budget in budgets.items():
        best = best_within(rows, budget, work)
        error = None if best is None else shown(reached(best)) + ("" if best["judged"] else " or less")
        lines.append((name, "none" if best is None else best["label"], error))
    return table(lines, ("within", "configuration", "error"))


def problems_text(rows: Sequence[Row], budgets: Sequence[int]) -> list[str]:
    """The most accurate solver of every exact problem within every budget, and the one nearest to these throughout."""
    problems = _by(rows, "problem")
    budgets, scans = sorted(set(budgets)), rows[0]["scenes"]
    lines = [[name, *(_winner(own, budget) for budget in budgets)] for name, own in problems.items()]
    lines.append(["**nearest to the best**", *(steadiest(rows, budget) or "none" for budget in budgets)])
    unsolved = Counter(row["problem"] for row in rows if row["converged"] < row["scenes"])
    trouble = ", ".join(f"{problem} ({count})" for problem, count in unsolved.items()) or "none"
    return [
        f"{len(problems)} exact problems, {scans} scans each, in float64: the most accurate solver within a number of "
        "evaluations and its median error; none where x_0 is as near. Last line: the solver that is nearest to the "
        "best one of every problem, by the geometric mean of the ratio of their errors.",
        table(lines, ["problem", *(f"within {budget}" for budget in budgets)]),
        f"Configurations that left a scan unsolved, by problem: {trouble}. Seconds are those of {scans} scans solved "
        "together, over their number; torchdiffeq takes one at a time.",
    ]


def _winner(rows: Sequence[Row], budget: float) -> str:
    best = best_within(rows, budget)
    if best is None:
        return "none"
    equals = {row["method"] for row in rows if row["evaluations"] <= budget and reached(row) == reached(best)}
    if len(equals) > 1:
        return f"{len(equals)} solvers, {shown(reached(best))} or less"
    return f"{best['method']} {shown(reached(best))}"


def steadiest(rows: Sequence[Row], budget: float) -> str | None:
    """The method whose error is nearest to that of each problem's best, within a budget of evaluations.

    By the geometric mean over problems of (its error / the best error), where its error is at most that of x_0. None
    where no method solves any problem within the budget.
    """
    problems = _by(rows, "problem")
    regret: dict[str, float] = {}
    for method in _by(rows, "method"):
        ratios, arrives = [], False
        for own in problems.values():
            best, mine = best_within(own, budget), best_within(_by(own, "method").get(method, []), budget)
            if best is not None:
                arrives |= mine is not None
                ratios.append(math.log((best["length"] if mine is None else reached(mine)) / reached(best)))
        if arrives:
            regret[method] = sum(ratios) / len(ratios)
    return min(regret, key=lambda method: regret[method], default=None)


def checkpoint_figure(rows: Sequence[Row], name: str) -> Figure:
    """Error of a checkpoint's solutions against evaluations and time, and what it is in metres and ray-drop."""
    figure = blank_figure(10.5, 8.2)
    floor = rows[0]["floor"]
    for place, (work, error) in enumerate(PANELS):
        axes = figure.add_subplot(2, 2, place + 1)
        _draw(axes, rows, work, error)
        if error is ERROR and math.isfinite(floor):
            low = min(axes.get_ylim()[0], floor / 2)
            axes.axhspan(low, floor, facecolor="0.93", hatch="///", edgecolor="0.75", lw=0)
            axes.text(0.02, 0.02, "closer than can be measured", fontsize=8, transform=axes.transAxes, color="0.25")
            axes.set_ylim(bottom=low)
    _legend(figure, rows, f"{name}: error against work, median of {rows[0]['scenes']} scans")
    return figure


def problems_figure(rows: Sequence[Row], work: Axis) -> Figure:
    """Error on every exact problem against evaluations or time."""
    solved = _by([row for row in rows if math.isfinite(reached(row))], "problem")
    problems, missing = list(solved), [problem for problem in _by(rows, "problem") if problem not in solved]
    columns = max(min(4, len(problems)), 1)
    lines = math.ceil(len(problems) / columns)
    figure = blank_figure(3.2 * columns + 0.4, 2.7 * lines + 0.9)
    for place, problem in enumerate(problems):
        axes = figure.add_subplot(lines, columns, place + 1)
        _draw(axes, solved[problem], work, ERROR, lowest=1e-10)
        axes.set_title(problem.replace("_", " "), fontsize=9)
        axes.set_ylabel("RMS error" if place % columns == 0 else "")
        axes.set_xlabel(work[1].replace("network ", "") if place >= len(problems) - columns else "")
    unsolved = f"; unsolved: {', '.join(missing)}" if missing else ""
    _legend(figure, rows, f"Exact problems, median of {rows[0]['scenes']} scans{unsolved}")
    return figure


def _draw(axes: Any, rows: Sequence[Row], work: Axis, error: Axis, lowest: float = 0.0) -> None:
    """One line a method; ringed where no other configuration is both cheaper and more accurate."""
    (x, x_label), (y, y_label) = work, error
    solved = [row for row in rows if math.isfinite(reached(row)) and row[y] is not None and math.isfinite(row[y])]
    for method in _by(rows, "method"):
        own = [row for row in solved if row["method"] == method]
        values = np.array([max(row[y], lowest) or math.nan for row in own])
        works = np.array([row[x] for row in own])
        axes.plot(works, values, **_style(method), ms=4.5, lw=1.1, label=method)
        if x == "seconds":
            ends = [[row["seconds_quarter"] for row in own], [row["seconds_three_quarters"] for row in own]]
            axes.hlines(values, *ends, color=_style(method)["color"], lw=0.7, alpha=0.6)
        if y == "error":
            worst = [max(row["error_worst"], lowest) for row in own]
            axes.vlines(works, values, worst, color=_style(method)["color"], lw=0.7, alpha=0.6)
            front = [(w, v) for w, v, row in zip(works, values, own, strict=True) if row[f"pareto_{x}"]]
            axes.scatter(*np.array(front or [(math.nan, math.nan)]).T, s=90, facecolor="none", edgecolor="black", lw=1)
    axes.set(xlabel=x_label, ylabel=y_label)
    if lowest and all((line.get_ydata() == lowest).all() for line in axes.lines):
        axes.text(0.5, 0.6, f"{lowest:.0e} or less", ha="center", fontsize=8, transform=axes.transAxes)
    if any((line.get_ydata() > 0).any() for line in axes.lines):
        axes.set(xscale="log", yscale="log")
    if work is EVALUATIONS:
        low, high = axes.get_xlim()
        ticks = [2.0**n for n in range(16) if low <= 2.0**n <= high]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
    axes.grid(True, which="major", color="0.88", lw=0.6)
    axes.tick_params(labelsize=8)


def _legend(figure: Figure, rows: Sequence[Row], title: str) -> None:
    handles = [Line2D([], [], **_style(method), ms=5, lw=1.1, label=method) for method in _by(rows, "method")]
    handles.append(Line2D([], [], marker="o", ls="", mfc="none", mec="black", ms=9, label="Pareto front"))
    spread = "in the solver's colour: to the worst scan; quartiles of time"
    handles.append(Line2D([], [], color="0.4", lw=0.8, label=spread))
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=11)


def _style(method: str) -> dict[str, Any]:
    place = METHODS.index(method) if method in METHODS else sum(map(ord, method))
    return STYLES[place % len(STYLES)]


def _by(rows: Sequence[Row], key: str) -> dict[str, list[Row]]:
    """The rows of each value of a key."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return groups
