"""Results of an evaluation in the terminal, as JSON and as a page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from r2flow.evaluation.comparing import Comparison
from r2flow.evaluation.copies import Nearest
from r2flow.evaluation.sets import AS_MANY, HALVES
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.pictures import draw_range
from r2flow.reports.tables import print_table, shown, table, words

ENOUGH = 100  # least number of scans of a set, or of a half of the real ones, for a verdict
MARGIN = 1.5  # 95 % of equal sets of one source differ by less: 200 splits of simulated scans, 50 to 160 a set
HEADLINE = "panel"  # metric of the verdict, if measured
AXES = (("evaluations", "network evaluations a scan"), ("seconds", "seconds a scan"))

# Values that published tables print scaled: heading and factor, for printing only.
PRINTED = {
    "jsd": ("JSD x 10^2", 1e2), "mmd": ("MMD x 10^4", 1e4), "seconds": ("s a scan", 1.0),
}  # fmt: skip


def heading(metric: str, figure: str) -> tuple[str, float]:
    """Heading of a value in a table, and its printed factor."""
    return PRINTED[figure] if figure in PRINTED and metric in (figure, "speed") else (figure, 1.0)


def rows_of(comparisons: Sequence[Comparison]) -> list[dict[str, Any]]:
    """One row per value."""
    rows = []
    for comparison, result in ((c, result) for c in comparisons for result in c.measured):
        sizes = result.protocol["sizes"]
        for name, value in result.figures.items():
            title, factor = heading(result.metric, name)
            rows.append({
                "comparison": comparison.name, "kind": comparison.kind, "metric": result.metric, "figure": name,
                "value": value, "printed_as": title, "printed": value * factor,
                "real": sizes["real"], "generated": sizes["generated"], "remarks": "; ".join(result.remarks),
            })  # fmt: skip
    return rows


def print_comparisons(comparisons: Sequence[Comparison]) -> None:
    """Print the protocol, a table and remarks. Sets in columns are numbered, since names are long."""
    columns, lines = _table(comparisons)
    print(_protocol(comparisons))
    if not columns[0]:
        numbers = list(map(str, range(1, len(columns))))
        print_table(list(zip(numbers, columns[1:], strict=True)), ("", "its scans : real"))
        columns = ["", *numbers]
        print()
    print_table(lines, columns)
    print(*(f"  {remark}" for remark in _remarks(comparisons)), *verdict(comparisons), sep="\n")


def verdict(comparisons: Sequence[Comparison]) -> list[str]:
    """One sentence per judged set, the nearest first: its panel next to those of real halves and the best baseline.

    Without the panel the first biased distance is taken: an unbiased one of equal sets is above that of the halves as
    often as not, by any factor. As it is larger for fewer scans, a set is compared with real halves in as many scans
    as they have, if measured.
    """
    biased = [name for name, larger in _distances(comparisons).items() if larger]
    metric = HEADLINE if HEADLINE in biased else next(iter(biased), "")
    near = sorted((pair for pair in _first(comparisons, metric) if math.isfinite(pair[0])), key=lambda pair: pair[0])
    judged, baselines = ([pair for pair in near if pair[1].kind == kind] for kind in ("judged", "baseline"))
    references = {c.name: (value, c) for value, c in near if c.kind == "reference"}
    if HALVES not in references:
        return []
    reference, halves = references[HALVES]
    best = baselines[0][0] if baselines else math.inf
    title, factor = heading(metric, metric)
    lines = []
    for value, comparison in judged:
        as_many = references.get(f"{comparison.name}{AS_MANY}")
        compared, pair = as_many or (value, comparison)
        scans, of_half = (min(len(c.real), len(c.generated)) for c in (pair, halves))
        farther = compared > MARGIN * reference
        clause = "" if not baselines else ", below the baselines" if value < best else ", not below the baselines"
        if min(scans, of_half) < ENOUGH:
            judgement = (
                f"{'above' if compared > reference else 'not above'} the real halves{clause}; too few scans "
                f"for a verdict: {len(comparison.real)} real, {len(comparison.generated)} generated, {2 * ENOUGH} and "
                f"{ENOUGH} needed"
            )
        elif value >= best:
            judgement = "no lower than a baseline"
        elif reference >= best:
            judgement = "undecided, as the real halves are above a baseline"
        elif scans < of_half if farther else scans > of_half:
            judgement = f"undecided, as the halves have other numbers of scans: give {of_half} generated scans"
        elif farther:
            judgement = "higher than between the real halves"
        else:
            judgement = "not distinguishable from real scans by this figure"
        if empty := comparison.measured[0].protocol.get("sizes", {}).get("generated_empty"):
            judgement += f"; {empty} of its scans are empty and not compared"
        bounds = [f"{c.title} {v * factor:.3g}" for v, c in ((reference, halves), *baselines[:1])]
        if as_many:
            bounds.insert(0, f"in as many scans as the halves {compared * factor:.3g}")
        lines.append(f"{comparison.name}: {title} {value * factor:.3g} ({', '.join(bounds)}): {judgement}.")
    return lines


def evaluation_page(
    comparisons: Sequence[Comparison],
    device: str,
    seeds: Mapping[str, int],
    nearest: Mapping[str, Nearest],
) -> Page:
    """Build the page of an evaluation: table, sets, protocols and pictures, with nearest training scans if computed."""
    columns, lines = _table(comparisons)
    remarks = "\n".join(f"- {remark}" for remark in _remarks(comparisons))
    sets = [
        (c.name, side, s.label, len(s), words(s.about))
        for c in comparisons
        for side, s in (("real", c.real), ("generated", c.generated))
    ]
    used = [
        (p["metric"], p["representation"], "{:g} < r < {:g}".format(*p["mask"]), p["extractor"], p["weights"],
         p["layer"], words(p["settings"]), p["sizes"]["real_chosen"], p["sizes"]["generated"])
        for p in (result.protocol for result in comparisons[0].measured)
    ]  # fmt: skip
    text = [
        _protocol(comparisons),
        table(lines, columns),
        *([remarks] if remarks else []),
        *verdict(comparisons),
        "## Sets",
        table(sets, ("comparison", "as", "set", "scans", "details, as read")),
        "## Protocols",
        "Before every metric, returns beyond the mask are dropped from both sets. Figures of different protocols are "
        "not comparable.",
        table(used, ("metric", "compares", "mask, m", "network", "weights", "features", "settings", "real scans",
                     "generated scans")),
    ]  # fmt: skip
    more = {"comparisons": [_plain_comparison(c) for c in comparisons]}
    figures = {}
    sampled = points(more["comparisons"])
    if len(sampled) > len({row["flow"] for row in sampled}):
        names = [name for name in dict.fromkeys(key for row in sampled for key in row) if "/" in name]
        figures["evaluation_speed"] = speed_figure(sampled, names)
    if nearest:
        figures["evaluation_copies"] = copies_figure(nearest)
    title = "Generated scans against real ones"
    return Page("evaluation", title, text, rows_of(comparisons), figures, seeds, device, more)


def _protocol(comparisons: Sequence[Comparison]) -> str:
    used = comparisons[0].measured[0].protocol
    points, (top, bottom) = used["points"], used["elevations"]
    return (
        f"Protocol {used['name']}: real points {points['real']}, generated points {points['generated']}; "
        f"images {'x'.join(map(str, used['image']))} of {used['sensor']}, {top:.2f} to {bottom:.2f} degrees."
    )


def _table(comparisons: Sequence[Comparison]) -> tuple[list[str], list[list[str]]]:
    """Headings and lines, with published scaling; the longer of comparisons and values runs down."""
    cells: dict[str, dict[tuple[str, str], str]] = {}  # by kind and name, since a judged set may be named "noise"
    for row in rows_of(comparisons):
        text = "none" if math.isnan(row["value"]) else f"{row['printed']:#.4g}"
        cells.setdefault(row["printed_as"], {})[row["kind"], row["comparison"]] = text
    sizes = [f"({len(c.generated)} : {len(c.real)})" for c in comparisons]
    if len(comparisons) >= len(cells):
        lines = [
            [c.title, size, *(values.get((c.kind, c.name), "") for values in cells.values())]
            for size, c in zip(sizes, comparisons, strict=True)
        ]
        return ["set", "its scans : real", *cells], lines
    columns = ["", *(f"{c.title} {size}" for c, size in zip(comparisons, sizes, strict=True))]
    return columns, [[title, *(v.get((c.kind, c.name), "") for c in comparisons)] for title, v in cells.items()]


def _distances(comparisons: Sequence[Comparison]) -> dict[str, bool]:
    """Names of the metrics that are distances, and whether they are biased."""
    return {m.metric: m.biased for m in comparisons[0].measured if m.biased is not None}


def _first(comparisons: Sequence[Comparison], metric: str) -> list[tuple[float, Comparison]]:
    """The first figure of a metric, with its comparison."""
    return [(next(iter(m.figures.values())), c) for c in comparisons for m in c.measured if m.metric == metric]


def _remarks(comparisons: Sequence[Comparison]) -> list[str]:
    lines = []
    distances = _distances(comparisons)
    if any(distances.values()) and len({(len(c.real), len(c.generated)) for c in comparisons}) > 1:
        lines.append("Distances of fewer scans are larger: compare only sets of equal sizes.")
    for metric in distances:
        first = _first(comparisons, metric)
        reference = next((value for value, c in first if (c.kind, c.name) == ("reference", HALVES)), -math.inf)
        if below := [c.name for value, c in first if c.kind == "baseline" and value < reference]:
            lines.append(f"{metric} ranks nothing here, with baselines below the real halves: {', '.join(below)}.")
    remarks: dict[str, dict[str, list[str]]] = {}  # remark -> comparison -> metrics
    for comparison in comparisons:
        for result in comparison.measured:
            for remark in result.remarks:
                remarks.setdefault(remark, {}).setdefault(comparison.title, []).append(result.metric)
    for remark, where in remarks.items():
        metrics = list(dict.fromkeys(name for names in where.values() for name in names))
        about = [] if len(where) == len(comparisons) else [", ".join(where)]
        if len(metrics) < len(comparisons[0].measured) and not remark.startswith(tuple(metrics)):
            about.append(", ".join(metrics))
        lines.append(f"{'; '.join(about)}: {remark}" if about else remark)
    return lines


def _plain_comparison(comparison: Comparison) -> dict[str, Any]:
    sets, rows = {"real": comparison.real, "generated": comparison.generated}, rows_of([comparison])
    return {
        "comparison": comparison.name,
        "kind": comparison.kind,
        **{side: {"set": s.label, "scans": len(s), **s.about} for side, s in sets.items()},
        "metrics": [
            asdict(result) | {"printed": {r["printed_as"]: r["printed"] for r in rows if r["metric"] == result.metric}}
            for result in comparison.measured
        ],
    }


def points(comparisons: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per sampled set of a JSON's `comparisons`: flow, weights, speed and METRIC/FIGURE."""
    rows = []
    for comparison in comparisons:
        if comparison["kind"] != "judged" or comparison["generated"].get("kind") != "sampled":
            continue
        protocol, real = comparison["metrics"][0]["protocol"], comparison["real"]
        chosen = [real[key] for key in ("part", "split") if real.get(key, "all") != "all"]
        row = {
            "flow": comparison["generated"]["set"], "weights": comparison["generated"]["weights"],
            "protocol": f"{protocol['name']}, {comparison['generated']['scans']} scans of "
            f"{'x'.join(map(str, protocol['image']))} against {real['scans']} of {' in '.join([*chosen, real['set']])}",
        }  # fmt: skip
        for metric in comparison["metrics"]:
            short = "" if metric["metric"] == "speed" else f"{metric['metric']}/"
            row |= {f"{short}{name}": math.nan if value is None else value for name, value in metric["figures"].items()}
        rows.append(row)
    return rows


def speed_figure(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Figure:
    """Plot each metric's first value against evaluations (top) and seconds (bottom), one line per flow."""
    first: dict[str, str] = {}
    for name in names:
        first.setdefault(name.split("/", 1)[0], name)
    flows = list(dict.fromkeys(row["flow"] for row in rows))
    figure = blank_figure(3.4 * len(first) + 0.6, 6.2)
    figure.suptitle("quality against speed: lower left is better for distances", fontsize=11)
    panels = figure.subplots(2, len(first), squeeze=False)
    for (line, (x, label)), (column, name) in product(enumerate(AXES), enumerate(first.values())):
        axes = panels[line, column]
        title, factor = heading(*name.split("/", 1))
        for flow, style in zip(flows, cycle(STYLES), strict=False):
            line_rows = sorted((row for row in rows if row["flow"] == flow), key=lambda row: row[x])
            at = [row[x] for row in line_rows]
            axes.plot(at, [row.get(name, math.nan) * factor for row in line_rows], **style, ms=5, lw=1.2, label=flow)
        positive = all(row[name] > 0 for row in rows if name in row)
        axes.set(xscale="log", yscale="log" if positive else "linear", xlabel=label, ylabel=title)
        # Labels of 1, 2 and 5 alone: nine would overlap.
        axes.xaxis.set(minor_locator=LogLocator(subs=(2, 5)), major_formatter="{x:g}", minor_formatter="{x:g}")
        axes.grid(True, which="major", color="0.88", lw=0.6)
        axes.tick_params(which="both", labelsize=8)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    columns = min(len(flows), 4, max(1, int(16 * figure.get_figwidth() / (8 + max(map(len, flows))))))  # by letters
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)
    return figure


def copies_figure(nearest: Mapping[str, Nearest]) -> Figure:
    """Draw the four scans of each set nearest to training scans, next to the aligned training scan."""
    chosen = [(name, copies, int(i)) for name, copies in nearest.items() for i in np.argsort(copies.distances)[:4]]
    figure = blank_figure(14, 0.9 * len(chosen) + 0.2)
    panels = figure.subplots(len(chosen), 2, squeeze=False)
    for (left, right), (name, copies, place) in zip(panels, chosen, strict=True):
        number = int(copies.numbers[place])
        draw_range(left, copies.scans.source[number], label=False)
        draw_range(right, copies.match(place), label=False)
        left.set_title(f"{name} {number}: {shown(float(copies.distances[place]))} away", fontsize=8, pad=2)
    return figure
