"""The paper's qualitative claims, each judged by our own figures: holds, does not hold, cannot tell.

The training seeds are the sample: one seed gives no verdict. A single metric, chosen before anything is measured,
judges; the others stand beside it. So two equal generators get a verdict either way in at most 5 % of cases, however
many metrics are measured (benchmarks/false_verdicts.py).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from r2flow.errors import InputError
from r2flow.metrics.base import Better
from r2flow.reports.paper.printed import PAPER_KIND
from r2flow.reports.tables import Row, shown
from r2flow.reports.verdicts import FAILS, HOLDS, UNKNOWN, all_above_0, any_above_0, interval

# What judges: the first that is measured.
PRIMARY = (
    "frd",
    "frechet_handcrafted",
    "frechet_handcrafted_range",
    "frechet_embedded",
    "frechet_embedded_range",
    "jsd",
)
CLOSE = 1.1  # a distance up to a tenth larger counts as comparable; the paper's own lie at 0.99 to 1.26
MANY = 16  # evaluations; at least this many stand for the paper's 256
FEW = (1, 2, 4)  # evaluations at which the paper's figure 6 is read

Verdict = tuple[str, str]  # one of the three, and the figures that decide or what is missing


@dataclass(frozen=True)
class Claim:
    """One claim of the paper: its text and where it stands, the verdict and its evidence."""

    text: str
    source: str
    verdict: str
    evidence: str


@dataclass(frozen=True)
class At:
    """A flow at a number of evaluations, as `At("2-RF", 1)`; None stands for its most, if at least `MANY`."""

    role: str
    steps: int | None

    def __str__(self) -> str:
        return f"{self.role} at {MANY} or more" if self.steps is None else f"{self.role} at {self.steps}"


@dataclass(frozen=True)
class Compared:
    """How much better a flow is than another: a log ratio for each chain that has both, and the figures in words."""

    margins: Sequence[float]
    said: str


def primary_of(metrics: Sequence[str], asked: str | None = None) -> str:
    """The metric that judges: the one asked for, else the first of `PRIMARY` that is measured.

    Raises:
        InputError: it is not measured.
    """
    found = asked or next((name for name in PRIMARY if name in metrics), "none")
    if found not in metrics:
        raise InputError(f"--primary must be one of {', '.join(metrics)}, which are measured; found {found!r}.")
    return found


def compare(rows: Sequence[Row], a: At, b: At, metric: str, better: Better = "smaller") -> Compared:
    """How much better a is than b. Flows of one chain are compared with each other."""
    pairs, missing = _pairs(rows, a, b, metric)
    if not pairs:
        return Compared([], f"no run of {' nor '.join(missing)}" if missing else "no chain has both")
    said = " against ".join(shown(fmean(pair[side][metric] for pair in pairs)) for side in (0, 1))
    if any(row[metric] <= 0 for pair in pairs for row in pair):
        return Compared([], f"{said}: not above 0")
    margins = [math.log(y[metric] / x[metric]) * (1 if better == "smaller" else -1) for x, y in pairs]
    if len(pairs) == 1:
        return Compared(margins, f"{said}, one seed")
    low, high = (math.exp(end) for end in interval(margins))
    return Compared(margins, f"{said}, {low:.2f} to {high:.2f} times as good over {len(pairs)} seeds")


def _pairs(rows: Sequence[Row], a: At, b: At, metric: str) -> tuple[list[tuple[Row, Row]], list[str]]:
    """The rows of both flows for each chain that has both, and which flow no chain has."""
    left, right = _by_family(rows, a, metric), _by_family(rows, b, metric)
    pairs = [(left[family], right[family]) for family in sorted(left.keys() & right.keys())]
    return pairs, [str(one) for one, found in ((a, left), (b, right)) if not found]


def _by_family(rows: Sequence[Row], at: At, metric: str) -> dict[str, Row]:
    """A row for each chain that has the flow; for several runs in one role, the mean of their figures."""
    mine = [row for row in rows if row["role"] == at.role and row.get(metric) is not None]
    mine = [row for row in mine if math.isfinite(row[metric])]
    steps = at.steps
    if steps is None:
        steps = max((row["steps"] for row in mine), default=0)
        mine = mine if steps >= MANY else []
    same: dict[str, list[Row]] = {}
    for row in mine:
        if row["steps"] == steps:
            same.setdefault(row["family"], []).append(row)
    return {
        family: own[0] if len(own) == 1 else {metric: fmean(row[metric] for row in own)} for family, own in same.items()
    }


def claims(
    rows: Sequence[Row],
    metrics: Mapping[str, Better],
    primary: str,
    curved: Sequence[Row],
    architectures: Sequence[Row],
) -> list[Claim]:
    """Every claim of the paper that figures can decide.

    Args:
        rows: A row for each flow and number of evaluations: family, role, steps, and each metric.
        metrics: Those that are measured, and which way each is better.
        primary: The metric that judges.
        curved: A row for each flow: family, role, kind, integral_normalised, first_tenth, last_tenth,
            ends_over_middle, paths_dropped, dropped_share.
        architectures: A row for each 1-RF at the most evaluations: seed, steps, backbone, gmac, position, the metrics
            and marginals, the distance of figure 5's marginals from the data's.
    """

    def judged(rows: Sequence[Row], *pairs: tuple[At, At]) -> Verdict:
        return all_better(rows, metrics, primary, *pairs)

    few = [(At("2-RF", n), At("1-RF", n)) for n in FEW]
    straight = compare([{**row, "steps": 1} for row in curved], At("2-RF", 1), At("1-RF", 1), "integral_normalised")
    return [
        Claim("At many evaluations the 1-RF is better than the 2-RF, whose teacher it is.", "table I",
              *judged(rows, (At("1-RF", None), At("2-RF", None)))),
        Claim("At one evaluation the 2-RF is better than the 1-RF.", "table I",
              *judged(rows, (At("2-RF", 1), At("1-RF", 1)))),
        Claim("Distilled to one step, the 1-TD is better than its 2-RF.", "table I",
              *judged(rows, (At("1-TD", 1), At("2-RF", 1)))),
        Claim("Two and four steps are better than one.", "table I",
              *judged(rows, (At("2-TD", 2), At("1-TD", 1)), (At("4-TD", 4), At("1-TD", 1)))),
        comparable(rows, metrics),
        Claim("At few evaluations a straightened flow is the better bargain.", "figure 6", *judged(rows, *few)),
        Claim("One reflow makes the paths straighter.", "figure 8 (a)", all_above_0([straight.margins]), straight.said),
        Claim("The 1-RF is curved most at its first and last steps.", "figure 8 (a)",
              *_above_0(curved, lambda row: row["ends_over_middle"] - 1,
                        "{first_tenth:.1%} of the bend in the first tenth of the path, {last_tenth:.1%} in the last; "
                        "the straighter of these bends {ends_over_middle:.2f} times as much as any tenth between")),
        Claim("The most curved paths of the 1-RF are often those of dropped rays.", "figure 8 (b)",
              *_above_0(curved, lambda row: row["paths_dropped"] - row["dropped_share"],
                        "{paths_dropped:.0%} of the most curved paths, {dropped_share:.0%} of all rays")),
        *_on_architectures(architectures, judged),
    ]  # fmt: skip


def all_better(rows: Sequence[Row], metrics: Mapping[str, Better], primary: str, *pairs: tuple[At, At]) -> Verdict:
    """Whether in every pair the first flow is better than the second, by the primary metric."""
    found = {f"{a} / {b}": compare(rows, a, b, primary, metrics[primary]) for a, b in pairs}
    said = "; ".join(one.said if len(pairs) == 1 else f"{name} {one.said}" for name, one in found.items())
    return all_above_0([one.margins for one in found.values()]), f"{primary} {said}"


def _above_0(curved: Sequence[Row], margin: Callable[[Row], float], said: str) -> Verdict:
    """Whether a margin of the 1-RFs is above 0; of several kinds of networks, of the paper's."""
    roots = [row for row in curved if row["role"] == "1-RF"]
    own = [row for row in roots if row["kind"] == PAPER_KIND] or [r for r in roots if r["kind"] == roots[0]["kind"]]
    evidence = "; ".join(said.format(**row) for row in own) or "no run of 1-RF"
    return all_above_0([[margin(row) for row in own]]), evidence


def comparable(rows: Sequence[Row], metrics: Mapping[str, Better]) -> Claim:
    """Whether on some metric a distilled flow's few steps come close to its parent's many.

    The one claim that all metrics judge, the error shared among them.
    """
    found = {
        f"{metric}, {steps}-TD": compare(rows, At(f"{steps}-TD", steps), At("2-RF", None), metric, better)
        for metric, better in metrics.items()
        for steps in (2, 4)
    }
    margins = {name: [value + math.log(CLOSE) for value in one.margins] for name, one in found.items() if one.margins}
    said = "no chain has a 2-RF and a 2-TD or 4-TD of it"
    if margins:
        surest = max(margins, key=lambda name: (interval(margins[name])[0], fmean(margins[name])))
        said = f"surest {surest}: {found[surest].said}; close is 1 / {CLOSE} times and more"
    text = "On some metrics 2-TD or 4-TD come close to many evaluations of the 2-RF."
    return Claim(text, "table I", any_above_0(list(margins.values())), said)


def _on_architectures(rows: Sequence[Row], judged: Callable[..., Verdict]) -> list[Claim]:
    every = [{**row, "role": "hdit", "family": row["seed"]} for row in rows if row["backbone"].startswith("hdit")]
    hdit = [row for row in every if row["position"] == "learnable"] or every  # the paper's, where it is there
    others = [
        {**row, "role": row["backbone"], "family": row["seed"]}
        for row in rows
        if not row["backbone"].startswith("hdit")
    ]
    if hdit and others:
        names = sorted({row["backbone"] for row in others})
        better = judged([*hdit, *others], *((At("hdit", None), At(name, None)) for name in names))
        costs = {row["backbone"]: row["gmac"] for row in rows}
        mine = max(row["gmac"] for row in hdit)
        said = ", ".join(f"{name} {gmac:.2f}" for name, gmac in costs.items()) + " GMAC"
        cheaper = HOLDS if all(mine < costs[name] for name in names) else FAILS, said
    else:
        better = cheaper = UNKNOWN, "no 1-RF with a U-Net" if hdit else "no 1-RF with HDiT"
    # Other embeddings say where a token is, too: only a flow without any can turn its scenes at will.
    roles = {"learnable": "HDiT with APE", "none": "HDiT without APE"}
    marked = [{**row, "role": roles.get(row["position"])} for row in every]
    nearer = compare(marked, At(roles["learnable"], None), At(roles["none"], None), "marginals")
    return [
        Claim("HDiT learns the better 1-RF than either U-Net.", "table II", *better),
        Claim("HDiT needs fewer multiplications than either U-Net.", "table II", *cheaper),
        Claim("A learned position embedding brings the azimuths of points nearer to the data's.", "figure 5",
              all_above_0([nearer.margins]), nearer.said),
    ]  # fmt: skip
