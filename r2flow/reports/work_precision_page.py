"""Error against work, told: figures, tables and which solver for which budget."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import shown, table
from r2flow.reports.work_precision import BUDGETS, METHODS, TRUST, Reference, best_within, reached

Row = Mapping[str, Any]
Axis = tuple[str, str]  # key of a row, label

EVALUATIONS: Axis = ("evaluations", "network evaluations a scene")
SECONDS: Axis = ("seconds", "seconds a scene")
ERROR: Axis = ("error", "RMS error, model space")


def work_precision_page(
    rows: Sequence[Row],
    name: str | None,
    found: Reference | None,
    seeds: Mapping[str, int],
    command: str,
    device: str = "cpu",
    budgets: Sequence[int] = BUDGETS,
) -> Page:
    """The report, of a checkpoint, of exact problems or of both.

    Args:
        name: The checkpoint's, as in its rows; None where there is none.
        found: What it was judged against.
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
    return Page("work_precision", "Error against work", text, rows, figures, command, seeds, device)


def checkpoint_text(rows: Sequence[Row], name: str, found: Reference, budgets: Sequence[int] = BUDGETS) -> list[str]:
    """Which solver for which budget on a checkpoint, and how far that can be trusted."""
    scenes = rows[0]["scenes"]
    intro = (
        f"**{name}**, {scenes} scenes, against its own tight solution: rk4 in {found.steps} steps, which dopri5 at "
        f"{found.tolerance:.0e} confirms to {shown(float(np.median(found.disagreement)))} (median RMS; worst scene "
        f"{shown(float(found.disagreement.max()))}), both with a float64 state, {found.evaluations:.0f} "
        "evaluations a scene."
    )
    below = sum(not row["judged"] for row in rows)
    trust = f"Errors above {shown(found.floor)}, {TRUST:g} times that, can be judged by it"
    closer = f"; {below} of {len(rows)} configurations come closer: more --reference-steps may tell them apart."
    trust += closer if below else ", and all are."
    # The upper quartile: as many evaluations of another solver fit into it, whatever the clock's noise.
    euler = {row["steps"]: row["seconds_three_quarters"] for row in rows if row["method"] == "euler"}
    said = [f"{intro} {trust}", sentence(f"On **{name}**, by evaluations a scene:", rows, budgets, "evaluations")]
    if euler:
        times = {euler[steps]: f"the time of {steps} Euler steps ({shown(euler[steps])} s)" for steps in sorted(euler)}
        said.append(sentence(f"On **{name}**, by time a scene:", rows, list(times), "seconds", times))
    columns = {
        "label": "configuration", "evaluations": "evaluations", "seconds": "seconds", "seconds_quarter": "quartile",
        "seconds_three_quarters": "quartile", "error": "error, median", "error_p95": "95th percentile",
        "error_worst": "worst scene", "range_rms_m": "range, RMS m", "range_median_m": "range, median m",
        "drop_differs": "ray-drop differs", "front": "Pareto",
    }  # fmt: skip
    few = "" if scenes >= 20 else f" With {scenes} scenes the 95th percentile is the worst scene."
    note = (
        "Errors are RMS over the elements of a scene in model space; in metres, over the rays that both solutions "
        "return, the median over scenes; a share of 0 is not drawn. Seconds are for a scene, the median and quartiles "
        "over all its solutions, "
        f"which took turns with those of the other configurations.{few}"
    )
    return [*said, note, table([{**row, "front": _front(row)} for row in rows], columns)]


def sentence(
    begin: str,
    rows: Sequence[Row],
    budgets: Sequence[float],
    work: str,
    names: Mapping[float, str] | None = None,
) -> str:
    """'within 4 **ab2** (4 steps: 0.03); within 8 to 16 ...': the most accurate solver of each budget."""
    best = [(budget, row) for budget in sorted(budgets) if (row := best_within(rows, budget, work))]
    parts = []
    for method, group in groupby(best, key=lambda pair: pair[1]["method"]):
        run = list(group)
        (first, _), (last, row) = run[0], run[-1]
        first_name, last_name = (names[b] if names else f"{b:g}" for b in (first, last))
        where = f"within {first_name}" if len(run) == 1 else f"within {first_name} to {last_name}"
        setting = row["label"].removeprefix(f"{method}, ")
        parts.append(f"{where} **{method}** ({setting}: {shown(reached(row))}{'' if row['judged'] else ' or less'})")
    return f"{begin} {'; '.join(parts)}." if parts else f"{begin} no solver arrives within any budget."


def problems_text(rows: Sequence[Row], budgets: Sequence[int] = BUDGETS) -> list[str]:
    """The winner of every exact problem and budget, and which solver is nearest to the winners throughout."""
    problems, budgets = list(dict.fromkeys(row["problem"] for row in rows)), sorted(set(budgets))
    wins = []
    for problem in problems:
        own = [row for row in rows if row["problem"] == problem]
        line: dict[str, Any] = {"problem": problem}
        for budget in budgets:
            line[str(budget)] = _winner(own, budget)
        wins.append(line)
    parts = []
    for method, group in groupby(budgets, key=lambda budget: steadiest(rows, budget)):
        of = list(group)
        within = f"{of[0]:g}" + (f" to {of[-1]:g}" if len(of) > 1 else "")
        parts.append(f"{within} evaluations " + ("no solver arrives" if method is None else f"**{method}**"))
    scenes = rows[0]["scenes"]
    said = (
        f"On {len(problems)} exact problems, {scenes} scenes each, in float64. Nearest to the best solver of every "
        f"problem (by the geometric mean of the ratio of their errors): within {'; '.join(parts)}."
    )
    lost = Counter(row["problem"] for row in rows if row["converged"] < row["scenes"])
    trouble = ", ".join(f"{problem} ({count})" for problem, count in lost.items())
    note = f"Configurations that left a scene unsolved, by problem: {trouble}." if lost else "Every scene was solved."
    columns = {"problem": "problem", **{str(budget): f"within {budget}" for budget in budgets}}
    heading = "The most accurate within a number of evaluations, and its median error; none where x_0 is as near:"
    clock = f"Seconds are those of {scenes} scenes solved together, over their number; torchdiffeq takes one at a time."
    return [said, f"{heading}\n\n{table(wins, columns)}", f"{note} {clock}"]


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

    By the geometric mean over problems of (its error / the best error); where it does not get nearer than x_0, its
    error is that of x_0. None where no method solves any problem within the budget.
    """
    problems = {row["problem"]: [r for r in rows if r["problem"] == row["problem"]] for row in rows}
    regret: dict[str, float] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        ratios, arrives = [], False
        for own in problems.values():
            best, mine = best_within(own, budget), best_within([r for r in own if r["method"] == method], budget)
            if best is not None:
                arrives |= mine is not None
                ratios.append(math.log((best["length"] if mine is None else reached(mine)) / reached(best)))
        if arrives:
            regret[method] = sum(ratios) / len(ratios)
    return min(regret, key=lambda method: regret[method], default=None)


def _front(row: Row) -> str:
    fronts = [name for name in ("evaluations", "seconds") if row[f"pareto_{name}"]]
    return " and ".join(fronts)


def checkpoint_figure(rows: Sequence[Row], name: str) -> Figure:
    """Error of a checkpoint's solutions against evaluations and time, and what it is in metres and ray-drop."""
    figure = blank_figure(10.5, 8.2)
    panels: list[tuple[Axis, Axis]] = [
        (EVALUATIONS, ERROR),
        (SECONDS, ERROR),
        (EVALUATIONS, ("range_rms_m", "RMS range error, m")),
        (EVALUATIONS, ("drop_differs", "share of rays that differ in ray-drop")),
    ]
    for place, (work, error) in enumerate(panels):
        axes = figure.add_subplot(2, 2, place + 1)
        _draw(axes, rows, work, error)
        if error is ERROR and math.isfinite(rows[0]["floor"]):
            _draw_floor(axes, rows[0]["floor"])
    _legend(figure, rows, f"{name}: error against work, median of {rows[0]['scenes']} scenes")
    return figure


def problems_figure(rows: Sequence[Row], work: Axis) -> Figure:
    """Error on every exact problem against evaluations or time."""
    problems = list(dict.fromkeys(row["problem"] for row in rows if math.isfinite(reached(row))))
    columns = max(min(4, len(problems)), 1)
    lines = math.ceil(len(problems) / columns)
    figure = blank_figure(3.2 * columns + 0.4, 2.7 * lines + 0.9)
    for place, problem in enumerate(problems):
        axes = figure.add_subplot(lines, columns, place + 1)
        _draw(axes, [row for row in rows if row["problem"] == problem], work, ERROR, lowest=1e-10)
        axes.set_title(problem.replace("_", " "), fontsize=9)
        axes.set_ylabel("RMS error" if place % columns == 0 else "")
        axes.set_xlabel(work[1].replace("network ", "") if place >= len(problems) - columns else "")
    missing = [row["problem"] for row in rows if row["problem"] not in problems]
    unsolved = f"; unsolved: {', '.join(dict.fromkeys(missing))}" if missing else ""
    _legend(figure, rows, f"Exact problems, median of {rows[0]['scenes']} scenes{unsolved}")
    return figure


def _draw(axes: Any, rows: Sequence[Row], work: Axis, error: Axis, lowest: float = 0.0) -> None:
    """One line a method; ringed where no other configuration is both cheaper and more accurate."""
    (x, x_label), (y, y_label) = work, error
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method and math.isfinite(reached(row))]
        own = [row for row in own if row[y] is not None and math.isfinite(row[y])]
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
        _powers_of_two(axes)
    axes.grid(True, which="major", color="0.88", lw=0.6)
    axes.tick_params(labelsize=8)


def _powers_of_two(axes: Any) -> None:
    """Ticks where budgets of evaluations are counted."""
    low, high = axes.get_xlim()
    ticks = [2.0**n for n in range(16) if low <= 2.0**n <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()


def _draw_floor(axes: Any, floor: float) -> None:
    """Where the reference is not good enough to judge."""
    low = min(axes.get_ylim()[0], floor / 2)
    axes.axhspan(low, floor, facecolor="0.93", hatch="///", edgecolor="0.75", lw=0)
    axes.text(0.02, 0.02, "too close to the reference to be judged", fontsize=8, transform=axes.transAxes, color="0.25")
    axes.set_ylim(bottom=low)


def _legend(figure: Figure, rows: Sequence[Row], title: str) -> None:
    from matplotlib.lines import Line2D

    methods = dict.fromkeys(row["method"] for row in rows)
    handles = [Line2D([], [], **_style(method), ms=5, lw=1.1, label=method) for method in methods]
    ring: dict[str, Any] = {"marker": "o", "ls": "", "mfc": "none", "mec": "black", "ms": 9}
    handles.append(Line2D([], [], **ring, label="Pareto front"))
    handles.append(
        Line2D([], [], color="0.4", lw=0.8, label="in the solver's colour: to the worst scene; quartiles of time")
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=11)


def _style(method: str) -> dict[str, Any]:
    place = METHODS.index(method) if method in METHODS else sum(map(ord, method))
    return STYLES[place % len(STYLES)]
