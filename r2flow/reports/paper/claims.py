"""The paper's qualitative claims, each judged by our own figures: holds, does not hold, cannot tell."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from r2flow.reports.tables import Row, shown

HOLDS, FAILS, UNKNOWN = "holds", "does not hold", "cannot tell"

CLOSE = 1.1  # a distance up to a tenth larger counts as comparable; the paper's own lie at 0.99 to 1.26
MANY = 16  # evaluations; at least this many stand for the paper's 256
FEW = (1, 2, 4)  # evaluations at which the paper's figure 6 is read

# Two-sided 95 % quantiles of Student's t by degrees of freedom.
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
_T_MORE = 2.201  # for eleven degrees or more: slightly too wide for more than eleven


@dataclass(frozen=True)
class Claim:
    """One claim and its verdict.

    Attributes:
        text: What the paper says.
        source: Where it says so.
        verdict: `HOLDS`, `FAILS` or `UNKNOWN`.
        evidence: The figures that decide, or what is missing.
    """

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


def judge_less(rows: Sequence[Row], a: At, b: At, metric: str) -> tuple[str, str]:
    """Whether a's distance is below b's: the verdict and its figures.

    Flows of one chain are compared with each other. For several chains the 95 % interval of the mean of log(b / a), by
    Student's t, decides. A single chain has only the bootstrap intervals over scans: where they overlap or are missing,
    there is no verdict.
    """
    left, right = _by_family(rows, a, metric), _by_family(rows, b, metric)
    families = sorted(left.keys() & right.keys())
    pairs = [(left[f], right[f]) for f in families]
    figures = [(x[metric], y[metric]) for x, y in pairs]
    if not figures:
        missing = [str(one) for one, found in ((a, left), (b, right)) if not found]
        return UNKNOWN, f"no run of {' nor '.join(missing)}" if missing else "no chain has both"
    said = f"{shown(fmean(x for x, _ in figures))} against {shown(fmean(y for _, y in figures))}"
    if any(x <= 0 or y <= 0 for x, y in figures):
        return UNKNOWN, f"{said}: not above 0"
    if len(figures) == 1:
        return _judge_intervals(*pairs[0], metric, said)
    low, high = _interval([math.log(y / x) for x, y in figures])
    said += f", ratio {math.exp(low):.2f} to {math.exp(high):.2f} over {len(figures)} seeds"
    return _sign(low, high), said


def _judge_intervals(x: Row, y: Row, metric: str, said: str) -> tuple[str, str]:
    ends = [float(row[f"{metric}_{end}"]) for row in (x, y) for end in ("low", "high") if f"{metric}_{end}" in row]
    if len(ends) < 4:
        return UNKNOWN, f"{said}, one seed and no interval"
    low_x, high_x, low_y, high_y = ends
    said += f", one seed, intervals {shown(low_x)}-{shown(high_x)} and {shown(low_y)}-{shown(high_y)}"
    return _sign(low_y - high_x, high_y - low_x), said


def _interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the mean by Student's t."""
    freedom = len(values) - 1
    quantile = _T[freedom - 1] if freedom <= len(_T) else _T_MORE
    half = quantile * stdev(values) / math.sqrt(len(values))
    return fmean(values) - half, fmean(values) + half


def _sign(low: float, high: float) -> str:
    return HOLDS if low > 0 else FAILS if high < 0 else UNKNOWN


def _by_family(rows: Sequence[Row], at: At, metric: str) -> dict[str, Row]:
    """A row for each chain that has the flow; for several runs in one role, the mean of their figures."""
    mine = [row for row in rows if row["role"] == at.role and _known(row.get(metric))]
    if at.steps is None and mine:
        most = max(row["steps"] for row in mine)
        mine = [row for row in mine if row["steps"] == most >= MANY]
    same: dict[str, list[Row]] = {}
    for row in mine:
        if at.steps is None or row["steps"] == at.steps:
            same.setdefault(row["family"], []).append(row)
    return {
        family: own[0] if len(own) == 1 else {metric: fmean(row[metric] for row in own)} for family, own in same.items()
    }


def _known(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def together(verdicts: Mapping[str, tuple[str, str]]) -> tuple[str, str]:
    """One verdict from those of the metrics: it holds where none contradicts it and at least one confirms it."""
    words = {verdict for verdict, _ in verdicts.values()}
    overall = FAILS if FAILS in words else HOLDS if HOLDS in words else UNKNOWN
    names: dict[tuple[str, str], list[str]] = {}
    for name, reason in verdicts.items():
        names.setdefault(reason, []).append(name)
    if len(names) == 1 and overall == UNKNOWN:
        return overall, next(iter(names))[1]
    said = []
    for (verdict, evidence), of in names.items():
        said.append(f"{', '.join(of)}: {evidence}" + ("" if len(words) == 1 else f" ({verdict})"))
    return overall, "; ".join(said)


def all_of(verdicts: Mapping[str, tuple[str, str]]) -> tuple[str, str]:
    """One verdict from several comparisons, all of which must hold."""
    words = [verdict for verdict, _ in verdicts.values()]
    overall = FAILS if FAILS in words else UNKNOWN if UNKNOWN in words else HOLDS
    if len(verdicts) == 1:
        return overall, next(iter(verdicts.values()))[1]
    said = [f"{name} {verdict}: {evidence}" for name, (verdict, evidence) in verdicts.items()]
    return overall, "; ".join(said)


def claims(
    rows: Sequence[Row], metrics: Sequence[str], curved: Sequence[Row], architectures: Sequence[Row]
) -> list[Claim]:
    """Every claim of the paper that figures can decide.

    Args:
        rows: A row for each flow and number of evaluations: family, role, steps, and each metric, with its interval's
            `_low` and `_high` where there is one.
        metrics: Which to judge by.
        curved: A row for each flow: family, role, integral_normalised, first_tenth, last_tenth, paths_dropped,
            dropped_share.
        architectures: A row for each 1-RF at the most evaluations: seed, steps, backbone, gmac, position, the metrics
            and marginals, the distance of figure 5's marginals from the data's.
    """

    def less(text: str, source: str, *pairs: tuple[At, At]) -> Claim:
        found = {f"{a} / {b}": together({m: judge_less(rows, a, b, m) for m in metrics}) for a, b in pairs}
        return Claim(text, source, *all_of(found))

    return [
        less("At many evaluations the 1-RF is better than the 2-RF, whose teacher it is.", "table I",
             (At("1-RF", None), At("2-RF", None))),
        less("At one evaluation the 2-RF is better than the 1-RF.", "table I", (At("2-RF", 1), At("1-RF", 1))),
        less("Distilled to one step, the 1-TD is better than its 2-RF.", "table I", (At("1-TD", 1), At("2-RF", 1))),
        less("Two and four steps are better than one.", "table I",
             (At("2-TD", 2), At("1-TD", 1)), (At("4-TD", 4), At("1-TD", 1))),
        comparable(rows, metrics),
        less("At few evaluations a straightened flow is the better bargain.", "figure 6",
             *((At("2-RF", n), At("1-RF", n)) for n in FEW)),
        *_on_curvature(curved),
        *_on_architectures(architectures, metrics),
    ]  # fmt: skip


def comparable(rows: Sequence[Row], metrics: Sequence[str]) -> Claim:
    """Whether a distilled flow's few steps come close to its parent's many on some metric."""
    text = "On some metrics 2-TD or 4-TD come close to many evaluations of the 2-RF."
    ratios: dict[str, tuple[float, float]] = {}
    for metric in metrics:
        many = _by_family(rows, At("2-RF", None), metric)
        for steps in (2, 4):
            few = _by_family(rows, At(f"{steps}-TD", steps), metric)
            pairs = [(few[f], many[f]) for f in sorted(few.keys() & many.keys())]
            if pairs and all(row[metric] > 0 for pair in pairs for row in pair):
                ratios[f"{metric}, {steps}-TD"] = _ratio(pairs, metric)
    if not ratios:
        return Claim(text, "table I", UNKNOWN, "no chain has a 2-RF and a 2-TD or 4-TD of it")
    best = min(ratios, key=lambda name: ratios[name][1])
    low, high = ratios[best]
    said = f"surest at {low:.2f} to {high:.2f} times its parent's ({best}); close is up to {CLOSE}"
    if high <= CLOSE:
        return Claim(text, "table I", HOLDS, said)
    return Claim(text, "table I", FAILS if all(one > CLOSE for one, _ in ratios.values()) else UNKNOWN, said)


def _ratio(pairs: Sequence[tuple[Row, Row]], metric: str) -> tuple[float, float]:
    """The interval of x / y: over seeds or, for one seed, from its intervals over scans; (0, inf) without these."""
    if len(pairs) > 1:
        low, high = _interval([math.log(x[metric] / y[metric]) for x, y in pairs])
        return math.exp(low), math.exp(high)
    ((x, y),) = pairs
    ends = [row.get(f"{metric}_{end}", math.nan) for row in (x, y) for end in ("low", "high")]
    if not all(end > 0 for end in ends):
        return 0.0, math.inf
    return ends[0] / ends[3], ends[1] / ends[2]


def _on_curvature(curved: Sequence[Row]) -> list[Claim]:
    straighter = [{**row, "steps": 1} for row in curved]
    verdict = judge_less(straighter, At("2-RF", 1), At("1-RF", 1), "integral_normalised")
    ends, drops = _of_role(curved, "1-RF", _ends_bend), _of_role(curved, "1-RF", _drops_bend)
    return [
        Claim("One reflow makes the paths straighter.", "figure 8 (a)", *verdict),
        Claim("The 1-RF is curved most at its first and last steps.", "figure 8 (a)", *ends),
        Claim("The most curved paths of the 1-RF are often those of dropped rays.", "figure 8 (b)", *drops),
    ]


def _ends_bend(row: Row) -> tuple[float, str]:
    first, last = row["first_tenth"], row["last_tenth"]
    return min(first, last) - 0.1, f"{first:.1%} in the first tenth of the path, {last:.1%} in the last"


def _drops_bend(row: Row) -> tuple[float, str]:
    most, share = row["paths_dropped"], row["dropped_share"]
    return most - share, f"{most:.0%} of the most curved paths, {share:.0%} of all rays"


def _of_role(curved: Sequence[Row], role: str, margin: Callable[[Row], tuple[float, str]]) -> tuple[str, str]:
    """Whether a margin is above 0 for the flows of a role, by its 95 % interval over seeds."""
    found = [margin(row) for row in curved if row["role"] == role]
    if not found:
        return UNKNOWN, f"no run of {role}"
    said = "; ".join(evidence for _, evidence in found)
    if len(found) == 1:
        return UNKNOWN, f"{said}, one seed and no interval"
    return _sign(*_interval([value for value, _ in found])), said


def _on_architectures(rows: Sequence[Row], metrics: Sequence[str]) -> list[Claim]:
    best = "HDiT learns the better 1-RF than either U-Net."
    cheap = "HDiT needs fewer multiplications than either U-Net."
    ape = "A learned position embedding brings the azimuths of points nearer to the data's."
    every = [{**row, "role": "hdit", "family": row["seed"]} for row in rows if row["backbone"].startswith("hdit")]
    hdit = [row for row in every if row["position"] == "learnable"] or every  # the paper's, where it is there
    others = sorted({row["backbone"] for row in rows} - {row["backbone"] for row in every})
    if not hdit or not others:
        missing = "no 1-RF with HDiT" if not hdit else "no 1-RF with a U-Net"
        found = [Claim(best, "table II", UNKNOWN, missing), Claim(cheap, "table II", UNKNOWN, missing)]
    else:
        verdicts = {}
        for other in others:
            theirs = [{**row, "role": other, "family": row["seed"]} for row in rows if row["backbone"] == other]
            a, b = At("hdit", None), At(other, None)
            verdicts[f"{a} / {b}"] = together({m: judge_less([*hdit, *theirs], a, b, m) for m in metrics})
        costs = {row["backbone"]: row["gmac"] for row in rows}
        mine = max(row["gmac"] for row in hdit)
        said = ", ".join(f"{name} {gmac:.2f}" for name, gmac in costs.items()) + " GMAC"
        dearer = all(mine < costs[other] for other in others)
        found = [
            Claim(best, "table II", *all_of(verdicts)),
            Claim(cheap, "table II", HOLDS if dearer else FAILS, said),
        ]
    # Other embeddings say where a token is, too: only a flow without any can turn its scenes at will.
    roles = {"learnable": "HDiT with APE", "none": "HDiT without APE"}
    marked = [{**row, "role": roles.get(row["position"])} for row in every]
    return [
        *found,
        Claim(ape, "figure 5", *judge_less(marked, At(roles["learnable"], None), At(roles["none"], None), "marginals")),
    ]
