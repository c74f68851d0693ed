"""The paper's tables I and II: ours, the printed ones and both side by side, and what differs in words."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import fmean, stdev
from typing import Any

from r2flow.reports.paper.claims import Claim
from r2flow.reports.paper.printed import COLUMNS, TABLE_I, TABLE_II, Architecture
from r2flow.reports.tables import Row, shown, table

# The paper's settings.
SCANS, REAL, IMAGES, SIZE = 10_000, 81_106, 2_560_000, (64, 1024)
PAPER_KIND = "hdit with APE"  # the network of its chains


def over_seeds(rows: Sequence[Row], metrics: Sequence[str]) -> list[dict[str, Any]]:
    """One row for each flow, kind of network and number of evaluations: means over seeds, `_spread` of several."""
    grouped: dict[tuple[str, str, int], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["role"], row.get("kind", ""), row["steps"]), []).append(row)
    merged = []
    for (role, kind, steps), same in grouped.items():
        one: dict[str, Any] = {"role": role, "kind": kind, "steps": steps, "n": len(same)}
        one["seconds"] = fmean(row["seconds"] for row in same)
        for metric in metrics:
            values = [row[metric] for row in same if row.get(metric) is not None]
            one[metric] = fmean(values) if values else None
            if len(values) > 1:
                one[f"{metric}_spread"] = stdev(values)
            elif f"{metric}_low" in same[0]:
                one[f"{metric}_interval"] = (same[0][f"{metric}_low"], same[0][f"{metric}_high"])
        merged.append(one)
    return merged


def ours(rows: Sequence[Row], metrics: Mapping[str, str]) -> str:
    """Every flow at every number of evaluations; mean ± spread over seeds, or the bootstrap's interval of one."""
    lines = []
    for row in over_seeds(rows, list(metrics)):
        cells = {metric: _cell(row, metric) for metric in metrics}
        lines.append({**{key: row[key] for key in ("role", "kind", "steps", "n", "seconds")}, **cells})
    headings = {
        "role": "flow", "kind": "backbone", "steps": "evaluations", "n": "seeds", "seconds": "seconds a scan",
    }  # fmt: skip
    return table(lines, {**headings, **metrics})


def _cell(row: Row, metric: str) -> str:
    if row[metric] is None:
        return "-"
    if f"{metric}_spread" in row:
        return f"{shown(row[metric])} ± {shown(row[f'{metric}_spread'])}"
    if f"{metric}_interval" in row:
        low, high = row[f"{metric}_interval"]
        return f"{shown(row[metric])} ({shown(low)} to {shown(high)})"
    return shown(row[metric])


def beside(rows: Sequence[Row], metrics: Sequence[str]) -> str:
    """Table I's flows, printed and ours, in the columns that both have; "" where they share none.

    The paper's are of HDiT with APE: of several kinds of ours, that one.
    """
    shared = [metric for metric in COLUMNS if metric in metrics]
    rows = [row for row in rows if row.get("kind") == PAPER_KIND] or rows
    mine = {(row["role"], row["steps"]): row for row in over_seeds(rows, shared)}
    most = max((row["steps"] for row in rows), default=0)
    lines = []
    for printed in TABLE_I:
        # Our many evaluations may be fewer than the paper's 256.
        steps = most if printed.evaluations == 256 else printed.evaluations
        own = mine.get((printed.role, steps)) if printed.role else None
        if own is None:
            continue
        line: dict[str, Any] = {"role": printed.role, "printed": printed.evaluations, "own": own["steps"]}
        for metric, figure in zip(COLUMNS, printed.figures, strict=True):
            if metric in shared:
                value = own[metric]
                line |= {f"{metric} printed": figure, metric: None if value is None else value * COLUMNS[metric][1]}
        lines.append(line)
    if not lines or not shared:
        return ""
    headings = {"role": "flow", "printed": "NFE, paper", "own": "NFE, ours"}
    for metric in shared:
        headings |= {f"{metric} printed": f"{COLUMNS[metric][0]}, paper", metric: "ours"}
    return table(lines, headings)


def printed_table() -> str:
    """Table I as the paper has it."""
    lines = []
    for one in TABLE_I:
        cells = zip(COLUMNS, one.figures, strict=True)
        line: Row = {name: "-" if figure is None else f"{figure:.2f}" for name, figure in cells}
        lines.append({"method": one.method, "flow": one.role or "", "nfe": one.evaluations, **line})
    return table(lines, {"method": "method", "flow": "flow", "nfe": "NFE", **{k: v[0] for k, v in COLUMNS.items()}})


def architectures_table(rows: Sequence[Row], metrics: Mapping[str, str]) -> str:
    """Table II: each kind of 1-RF, mean ± spread over seeds, with the paper's figures where it is the same network."""
    grouped: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["kind"], row["parameters"]), []).append(row)
    lines = []
    for (kind, parameters), same in grouped.items():
        printed = same_architecture(parameters)
        line: dict[str, Any] = {
            "kind": kind, "n": len(same), "parameters": f"{parameters:,}", "gmac": f"{same[0]['gmac']:.2f}",
            "latency_ms": same[0]["latency_ms"], "gmac_printed": printed and printed.gmac,
            "latency_printed": printed and printed.latency_ms, "frd_printed": printed and printed.frd,
        }  # fmt: skip
        for metric in metrics:
            values = [row[metric] for row in same if row.get(metric) is not None]
            line[metric] = (
                f"{shown(fmean(values))} ± {shown(stdev(values))}" if len(values) > 1 else (values or [None])[0]
            )
        lines.append(line)
    columns = {
        "kind": "backbone", "n": "seeds", "parameters": "parameters", "gmac": "GMAC", "gmac_printed": "paper",
        "latency_ms": "ms an evaluation", "latency_printed": "paper", **metrics, "frd_printed": "FRD, paper",
    }  # fmt: skip
    return table(lines, columns)


def same_architecture(parameters: int) -> Architecture | None:
    """The row of table II with this number of parameters, to the digits that are printed (its 125.5 M are 125.2 M)."""
    return next((one for one in TABLE_II.values() if abs(parameters - one.parameters) < 4e-3 * one.parameters), None)


def claims_table(found: Sequence[Claim]) -> str:
    lines = [{**asdict(one), "verdict": f"**{one.verdict}**"} for one in found]
    return table(lines, {"text": "the paper says", "source": "where", "verdict": "here", "evidence": "by what"})


def differences(
    data: str,
    real: int,
    generated: int,
    shape: tuple[int, int],
    parameters: Sequence[int],
    images: Sequence[int],
    missing: Mapping[str, str],
) -> list[str]:
    """The differences between our protocol and the paper's, a sentence each.

    Args:
        data: What the flows were trained on, in words.
        real: Scans that were compared to.
        generated: Scans of each flow.
        shape: (H, W).
        parameters: Of the 1-RFs' networks.
        images: That each 1-RF was trained on, repeats counted.
        missing: Metrics of the paper that were not computed, and why.
    """  # fmt: skip
    said = [f"**Data:** {data}; the paper: KITTI-360, drives 3 4 5 6 7 9 10."]
    if real != REAL or generated != SCANS:
        said.append(
            f"**Scans compared:** {generated:,} generated against {real:,} real ones; the paper: {SCANS:,} against "
            f"{REAL:,}. Distances between small sets come out larger."
        )
    if shape != SIZE:
        said.append(f"**Image:** {shape[0]} x {shape[1]}; the paper: {SIZE[0]} x {SIZE[1]}.")
    others = sorted({count for count in parameters if same_architecture(count) is None})
    if others:
        said.append(
            f"**Network:** {', '.join(f'{count:,}' for count in others)} parameters; the paper's HDiT: 80,908,420."
        )
    if images and min(images) < IMAGES:
        low, high = f"{min(images):,}", f"{max(images):,}"
        said.append(
            f"**Budget:** {low if low == high else f'{low} to {high}'} training images a 1-RF; the paper: {IMAGES:,}."
        )
    for why in dict.fromkeys(missing.values()):
        names = ", ".join(COLUMNS[name][0].split()[0] for name in missing if missing[name] == why)
        said.append(f"**{names}:** not computed: {why}")
    return said
