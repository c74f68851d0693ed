"""Results of an evaluation in the terminal, as JSON and as a page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from matplotlib.figure import Figure

from r2flow.evaluation.comparing import Comparison, Comparisons
from r2flow.metrics.panel import PANEL
from r2flow.reports.figures import Plot, lines_figure
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table, print_table
from r2flow.reports.verdict import heading, remarks_of, verdict

_THINGS = {
    "straight walls": "straight walls, share",
    "right angles": "right angles, 0 to 1",
    "poles": "poles a scan",
    "cars": "cars a scan",
}
# Of lines of the table; those of the panel are parts of the line above them.
_TITLES = {
    "panel": "panel, 0 to 1: mean of",
    **{name: f"- {name}" for name in PANEL},
    **_THINGS,
    **{f"{name}, real": f"{title}, real" for name, title in _THINGS.items()},
}
_SPEED = {"evaluations": "network evaluations a scan", "seconds": "seconds a scan"}


def _value_rows(comparisons: Comparisons) -> list[Row]:
    """One row per value."""
    rows = []
    for comparison in comparisons:
        for result in comparison.measured:
            for name, value in result.figures.items():
                title, factor = heading(result.metric, name)
                rows.append(
                    {
                        "comparison": comparison.name,
                        "kind": comparison.kind,
                        "metric": result.metric,
                        "figure": name,
                        "value": value,
                        "printed_as": title,
                        "printed": value * factor,
                    }
                )
    return rows


def print_comparisons(comparisons: Comparisons) -> None:
    """Print the protocol, a table and remarks. Columns are numbered, since names are long."""
    columns, lines = _table(comparisons)
    numbers = [str(number) for number in range(1, len(columns))]
    print(_protocol(comparisons))
    print_table(list(zip(numbers, columns[1:], strict=True)), ("", "set (its scans : real scans)"))
    print()
    print_table(lines, ["", *numbers])
    for remark in remarks_of(comparisons):
        print(f"  {remark}")
    print(*verdict(comparisons), sep="\n")


def evaluation_page(comparisons: Comparisons, device: str, seeds: Mapping[str, int]) -> Page:
    """Build the page of an evaluation: table, verdict, and quality against speed
    of models.
    """
    columns, lines = _table(comparisons)
    text: list[Part] = [
        _protocol(comparisons),
        Table(lines, columns),
        "\n".join(f"- {remark}" for remark in remarks_of(comparisons)),
        *verdict(comparisons),
    ]
    results = [_plain_comparison(comparison) for comparison in comparisons]
    figures = {}
    sampled = sampled_rows(results)
    if len(sampled) > len({row["flow"] for row in sampled}):
        names = [name for name in sampled[0] if "/" in name]
        figures["evaluation_speed"] = speed_figure(sampled, names)
    title = "Generated scans against real ones"
    rows = _value_rows(comparisons)
    return Page("evaluation", title, text, rows, figures, seeds, device, {"comparisons": results})


def _protocol(comparisons: Comparisons) -> str:
    used = comparisons[0].measured[0].protocol
    top, bottom = used["elevations"]
    return (
        f"Protocol {used['name']}: real points {used['points']['real']}, generated points "
        f"{used['points']['generated']}; images {'x'.join(map(str, used['image']))} of "
        f"{used['sensor']}, "
        f"{top:.2f} to {bottom:.2f} degrees."
    )


def _table(comparisons: Comparisons) -> tuple[list[str], list[list[str]]]:
    """Headings and lines: a column for each set, values as published tables scale them."""
    headings = [""]
    columns = []
    for c in comparisons:
        headings.append(f"{c.title} ({len(c.generated)} : {len(c.real)})")
        column = {}
        for row in _value_rows([c]):
            missing = math.isnan(row["value"])
            column[row["printed_as"]] = "none" if missing else f"{row['printed']:#.4g}"
        columns.append(column)
    titles = dict.fromkeys(title for column in columns for title in column)
    lines = [
        [_TITLES.get(title, title), *(column.get(title, "") for column in columns)]
        for title in titles
    ]
    return headings, lines


def _plain_comparison(comparison: Comparison) -> Row:
    sides = {"real": comparison.real, "generated": comparison.generated}
    return {
        "comparison": comparison.name,
        "kind": comparison.kind,
        **{key: {"set": s.label, "scans": len(s), **s.about} for key, s in sides.items()},
        "metrics": list(map(asdict, comparison.measured)),
    }


def sampled_rows(comparisons: Sequence[Mapping[str, Any]]) -> list[Row]:
    """One row per sampled set of a JSON's `comparisons`: flow, weights, speed and METRIC/FIGURE."""
    rows = []
    for comparison in comparisons:
        generated = comparison["generated"]
        if comparison["kind"] != "judged" or generated.get("kind") != "sampled":
            continue
        protocol = comparison["metrics"][0]["protocol"]
        real = comparison["real"]
        parts = [real[key] for key in ("part", "split") if real.get(key, "all") != "all"]
        size = "x".join(map(str, protocol["image"]))
        row = {
            "flow": generated["set"],
            "weights": generated["weights"],
            "protocol": f"{protocol['name']}, {generated['scans']} scans of {size} against "
            f"{real['scans']} of {' in '.join([*parts, real['set']])}",
        }
        for metric in comparison["metrics"]:
            prefix = "" if metric["metric"] == "speed" else f"{metric['metric']}/"
            for name, value in metric["figures"].items():
                row[prefix + name] = math.nan if value is None else value
        rows.append(row)
    return rows


def speed_figure(rows: Sequence[Row], names: Sequence[str]) -> Figure:
    """Plot each metric's first value against evaluations (top) and seconds (bottom), one line per
    flow.
    """
    first = {name.split("/")[0]: name for name in reversed(names)}
    plots = []
    for x, label in _SPEED.items():
        for metric, name in first.items():
            title, factor = heading(metric, name.removeprefix(f"{metric}/"))
            lines = {}
            for flow in dict.fromkeys(row["flow"] for row in rows):
                points = [row for row in rows if row["flow"] == flow and name in row]
                points.sort(key=lambda row: row["evaluations"])
                lines[flow] = [row[x] for row in points], [row[name] * factor for row in points]
            plots.append(Plot(label, title, lines, log_x=True))
    return lines_figure(plots, len(first))
