"""The paper's tables I and II: ours, the printed ones and both side by side, and what differs in words."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import fmean, stdev
from typing import Any

from r2flow.evaluation.protocols import PAPER, WORDS, Rules
from r2flow.reports.paper.claims import MANY, Claim
from r2flow.reports.paper.printed import COLUMNS, PAPER_KIND, TABLE_I, TABLE_II, Architecture
from r2flow.reports.tables import Row, shown, table

# The paper's settings.
SCANS, REAL, IMAGES, SIZE = 10_000, 81_106, 2_560_000, (64, 1024)


def over_seeds(rows: Sequence[Row], metrics: Sequence[str]) -> list[dict[str, Any]]:
    """One row for each flow, kind of network and number of evaluations: means over seeds, and `METRIC text`."""
    grouped: dict[tuple[str, str, int], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["role"], row.get("kind", ""), row["steps"]), []).append(row)
    merged = []
    for (role, kind, steps), same in grouped.items():
        one: dict[str, Any] = {"role": role, "kind": kind, "steps": steps, "n": len(same)}
        one["seconds"] = fmean(row["seconds"] for row in same)
        for metric in metrics:
            values = _values(same, metric)
            one[metric] = fmean(values) if values else None
            one[f"{metric} text"] = _text(same, metric)
        merged.append(one)
    return merged


def _values(rows: Sequence[Row], metric: str) -> list[float]:
    return [row[metric] for row in rows if row.get(metric) is not None]


def _text(rows: Sequence[Row], metric: str) -> str:
    """Mean ± spread over seeds, or one seed's figure with the bootstrap's interval where it has one."""
    values = _values(rows, metric)
    if len(values) > 1:
        return f"{shown(fmean(values))} ± {shown(stdev(values))}"
    if values and f"{metric}_low" in rows[0]:
        return f"{shown(values[0])} ({shown(rows[0][f'{metric}_low'])} to {shown(rows[0][f'{metric}_high'])})"
    return shown(values[0]) if values else "-"


def ours(rows: Sequence[Row], metrics: Mapping[str, str]) -> str:
    """Every generator at every number of evaluations."""
    headings = {
        "role": "method", "kind": "backbone", "steps": "evaluations", "n": "seeds", "seconds": "seconds a scan",
    }  # fmt: skip
    figures = {f"{metric} text": heading for metric, heading in metrics.items()}
    return table(over_seeds(rows, list(metrics)), headings | figures)


def beside(rows: Sequence[Row], metrics: Sequence[str]) -> str:
    """Table I's rows, printed and ours, in the columns that both have; "" where they share none.

    The paper's flows are of HDiT with APE: of several kinds of ours, that one. Where the paper has many evaluations,
    ours of the nearest number.
    """
    shared = [metric for metric in COLUMNS if metric in metrics]
    if any(row.get("kind") == PAPER_KIND for row in rows):
        rows = [row for row in rows if row.get("kind") in (PAPER_KIND, "")]
    mine = over_seeds(rows, shared)
    lines = []
    for printed in TABLE_I:
        role, count = printed.role or printed.method, printed.evaluations
        near = [
            row for row in mine if row["role"] == role and (row["steps"] == count or min(row["steps"], count) >= MANY)
        ]
        if not near:
            continue
        own = min(near, key=lambda row: abs(math.log(row["steps"] / count)))
        line: dict[str, Any] = {"role": role, "printed": count, "own": own["steps"]}
        for metric, figure in zip(COLUMNS, printed.figures, strict=True):
            value = own.get(metric)
            line |= {f"{metric} printed": figure, metric: None if value is None else value * COLUMNS[metric][1]}
        lines.append(line)
    if not lines or not shared:
        return ""
    headings = {"role": "method", "printed": "NFE, paper", "own": "NFE, ours"}
    for metric in shared:
        headings |= {f"{metric} printed": f"{COLUMNS[metric][0]}, paper", metric: "ours"}
    return table(lines, headings)


def printed_table() -> str:
    """Table I as the paper has it."""
    headings = ("method", "flow", "NFE", *(heading for heading, _ in COLUMNS.values()))
    cells = [["-" if figure is None else f"{figure:.2f}" for figure in one.figures] for one in TABLE_I]
    lines = [[one.method, one.role, one.evaluations, *own] for one, own in zip(TABLE_I, cells, strict=True)]
    return table(lines, headings)


def architectures_table(rows: Sequence[Row], metrics: Mapping[str, str]) -> str:
    """Table II: each kind of 1-RF, mean ± spread over seeds, with the paper's figures where it is the same network."""
    grouped: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["kind"], row["parameters"]), []).append(row)
    lines = []
    for (kind, parameters), same in grouped.items():
        printed = same_architecture(parameters)
        lines.append({
            "kind": kind, "n": len(same), "parameters": f"{parameters:,}", "gmac": f"{same[0]['gmac']:.2f}",
            "latency_ms": same[0]["latency_ms"], "gmac_printed": printed and printed.gmac,
            "latency_printed": printed and printed.latency_ms, "frd_printed": printed and printed.frd,
            **{metric: _text(same, metric) for metric in metrics},
        })  # fmt: skip
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
    protocol: Rules = PAPER,
    why: str | None = None,
) -> list[str]:
    """The differences between our protocol and the paper's, a sentence each.

    Args:
        data: What the flows were trained on, in words.
        real, generated: Scans that were compared to, and of each flow.
        parameters: Of the 1-RFs' networks.
        images: That each 1-RF was trained on, repeats counted.
        missing: Metrics of the paper that were not computed, and why.
        protocol, why: Under which the figures hold, and why not the paper's.
    """
    others = sorted({count for count in parameters if same_architecture(count) is None})
    least, most = min(images, default=IMAGES), max(images, default=IMAGES)
    seen = f"{least:,}" if least == most else f"{least:,} to {most:,}"
    said = {
        f"**Data:** {data}; the paper: KITTI-360, drives 3 4 5 6 7 9 10.": True,
        f"**Scans compared:** {generated:,} generated against {real:,} real ones; the paper: {SCANS:,} against "
        f"{REAL:,}. Distances between small sets come out larger.": (real, generated) != (REAL, SCANS),
        f"**Protocol:** `{protocol.name}`: real points {WORDS[protocol.real]}, generated points "
        f"{WORDS[protocol.generated]}; the paper: real points {WORDS[PAPER.real]}, generated points "
        f"{WORDS[PAPER.generated]}. Its figures and these are not comparable{f': {why}' if why else ''}.": (
            protocol is not PAPER
        ),
        f"**Image:** {shape[0]} x {shape[1]}; the paper: {SIZE[0]} x {SIZE[1]}.": shape != SIZE,
        f"**Network:** {', '.join(f'{count:,}' for count in others)} parameters; the paper's HDiT: 80,908,420.": others,
        f"**Budget:** {seen} training images a 1-RF; the paper: {IMAGES:,}.": least < IMAGES,
    }
    for why in dict.fromkeys(missing.values()):
        names = ", ".join(COLUMNS[name][0].split()[0] for name in missing if missing[name] == why)
        said[f"**{names}:** not computed: {why}"] = True
    return [sentence for sentence, differs in said.items() if differs]
