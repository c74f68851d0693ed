"""The paper's qualitative claims, each judged by our own figures: holds, does not hold, cannot tell."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from r2flow.reports.tables import Row, shown

HOLDS, FAILS, UNKNOWN = "holds", "does not hold", "cannot tell"
Verdict = tuple[str, str]  # one of these, and the figures that decide or what is missing

CLOSE = 1.1  # a distance up to a tenth larger counts as comparable; the paper's own lie at 0.99 to 1.26
MANY = 16  # evaluations; at least this many stand for the paper's 256
FEW = (1, 2, 4)  # evaluations at which the paper's figure 6 is read

# Two-sided 95 % quantiles of Student's t by degrees of freedom.
_T = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228)
_T_MORE = 2.201  # for eleven degrees or more: slightly too wide for more than eleven


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


def judge_less(rows: Sequence[Row], a: At, b: At, metric: str) -> Verdict:
    """Whether a's distance is below b's.

    Flows of one chain are compared with each other. For several chains the 95 % interval of the mean of log(b / a), by
    Student's t, decides. A single chain has only the bootstrap intervals over scans: where they overlap or are missing,
    there is no verdict.
    """
    pairs, missing = _pairs(rows, a, b, metric)
    if not pairs:
        return UNKNOWN, f"no run of {' nor '.join(missing)}" if missing else "no chain has both"
    figures = [(x[metric], y[metric]) for x, y in pairs]
    said = f"{shown(fmean(x for x, _ in figures))} against {shown(fmean(y for _, y in figures))}"
    if any(x <= 0 or y <= 0 for x, y in figures):
        return UNKNOWN, f"{said}: not above 0"
    low, high = _ratio(pairs, metric)
    if len(pairs) > 1:
        said += f", ratio {low:.2f} to {high:.2f} over {len(pairs)} seeds"
    elif all(f"{metric}_{end}" in row for row in pairs[0] for end in ("low", "high")):
        ends = [f"{shown(row[f'{metric}_low'])}-{shown(row[f'{metric}_high'])}" for row in pairs[0]]
        said += f", one seed, intervals {ends[0]} and {ends[1]}"
    else:
        said += ", one seed and no interval"
    return _side(low, high, 1.0), said


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


def _ratio(pairs: Sequence[tuple[Row, Row]], metric: str) -> tuple[float, float]:
    """The 95 % interval of b / a over seeds; of one seed from its intervals over scans, (0, inf) without these."""
    if len(pairs) > 1:
        low, high = _interval([math.log(b[metric] / a[metric]) for a, b in pairs])
        return math.exp(low), math.exp(high)
    ((a, b),) = pairs
    (low_a, high_a), (low_b, high_b) = (
        (row.get(f"{metric}_low", 0.0), row.get(f"{metric}_high", math.inf)) for row in (a, b)
    )
    return low_b / high_a if high_a > 0 else 0.0, high_b / low_a if low_a > 0 else math.inf


def _interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the mean by Student's t."""
    freedom = len(values) - 1
    quantile = _T[freedom - 1] if freedom <= len(_T) else _T_MORE
    half = quantile * stdev(values) / math.sqrt(len(values))
    return fmean(values) - half, fmean(values) + half


def _side(low: float, high: float, of: float) -> str:
    """Whether an interval lies above a number: it holds, or below: it fails."""
    return HOLDS if low > of else FAILS if high < of else UNKNOWN


def together(verdicts: Mapping[str, Verdict]) -> Verdict:
    """One verdict from those of the metrics: it holds where none contradicts it and at least one confirms it."""
    words = {verdict for verdict, _ in verdicts.values()}
    overall = FAILS if FAILS in words else HOLDS if HOLDS in words else UNKNOWN
    names: dict[Verdict, list[str]] = {}
    for name, reason in verdicts.items():
        names.setdefault(reason, []).append(name)
    if len(names) == 1 and overall == UNKNOWN:
        return next(iter(names))
    said = [
        f"{', '.join(of)}: {evidence}" + ("" if len(words) == 1 else f" ({verdict})")
        for (verdict, evidence), of in names.items()
    ]
    return overall, "; ".join(said)


def all_of(verdicts: Mapping[str, Verdict]) -> Verdict:
    """One verdict from several comparisons, all of which must hold."""
    if len(verdicts) == 1:
        return next(iter(verdicts.values()))
    words = [verdict for verdict, _ in verdicts.values()]
    overall = FAILS if FAILS in words else UNKNOWN if UNKNOWN in words else HOLDS
    return overall, "; ".join(f"{name} {verdict}: {evidence}" for name, (verdict, evidence) in verdicts.items())


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
        return Claim(text, source, *_all_less(rows, metrics, *pairs))

    straight = [{**row, "steps": 1} for row in curved]
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
        Claim("One reflow makes the paths straighter.", "figure 8 (a)",
              *judge_less(straight, At("2-RF", 1), At("1-RF", 1), "integral_normalised")),
        Claim("The 1-RF is curved most at its first and last steps.", "figure 8 (a)",
              *_above_0(curved, lambda row: min(row["first_tenth"], row["last_tenth"]) - 0.1,
                        "{first_tenth:.1%} in the first tenth of the path, {last_tenth:.1%} in the last")),
        Claim("The most curved paths of the 1-RF are often those of dropped rays.", "figure 8 (b)",
              *_above_0(curved, lambda row: row["paths_dropped"] - row["dropped_share"],
                        "{paths_dropped:.0%} of the most curved paths, {dropped_share:.0%} of all rays")),
        *_on_architectures(architectures, metrics),
    ]  # fmt: skip


def _all_less(rows: Sequence[Row], metrics: Sequence[str], *pairs: tuple[At, At]) -> Verdict:
    """Whether in every pair the first flow's distances are below the second's."""
    return all_of({f"{a} / {b}": together({m: judge_less(rows, a, b, m) for m in metrics}) for a, b in pairs})


def _above_0(curved: Sequence[Row], margin: Callable[[Row], float], said: str) -> Verdict:
    """Whether a margin of the 1-RFs is above 0, by its 95 % interval over seeds."""
    own = [row for row in curved if row["role"] == "1-RF"]
    if not own:
        return UNKNOWN, "no run of 1-RF"
    evidence = "; ".join(said.format(**row) for row in own)
    if len(own) == 1:
        return UNKNOWN, f"{evidence}, one seed and no interval"
    return _side(*_interval([margin(row) for row in own]), 0.0), evidence


def comparable(rows: Sequence[Row], metrics: Sequence[str]) -> Claim:
    """Whether a distilled flow's few steps come close to its parent's many on some metric."""
    ratios: dict[str, tuple[float, float]] = {}
    for metric in metrics:
        for steps in (2, 4):
            pairs, _ = _pairs(rows, At("2-RF", None), At(f"{steps}-TD", steps), metric)
            if pairs and all(row[metric] > 0 for pair in pairs for row in pair):
                ratios[f"{metric}, {steps}-TD"] = _ratio(pairs, metric)
    verdict, said = UNKNOWN, "no chain has a 2-RF and a 2-TD or 4-TD of it"
    if ratios:
        best = min(ratios, key=lambda name: ratios[name][1])
        low, high = ratios[best]
        said = f"surest at {low:.2f} to {high:.2f} times its parent's ({best}); close is up to {CLOSE}"
        far = all(one > CLOSE for one, _ in ratios.values())
        verdict = HOLDS if high <= CLOSE else FAILS if far else UNKNOWN
    return Claim("On some metrics 2-TD or 4-TD come close to many evaluations of the 2-RF.", "table I", verdict, said)


def _on_architectures(rows: Sequence[Row], metrics: Sequence[str]) -> list[Claim]:
    every = [{**row, "role": "hdit", "family": row["seed"]} for row in rows if row["backbone"].startswith("hdit")]
    hdit = [row for row in every if row["position"] == "learnable"] or every  # the paper's, where it is there
    others = [
        {**row, "role": row["backbone"], "family": row["seed"]}
        for row in rows
        if not row["backbone"].startswith("hdit")
    ]
    if hdit and others:
        names = sorted({row["backbone"] for row in others})
        better = _all_less([*hdit, *others], metrics, *((At("hdit", None), At(name, None)) for name in names))
        costs = {row["backbone"]: row["gmac"] for row in rows}
        mine = max(row["gmac"] for row in hdit)
        said = ", ".join(f"{name} {gmac:.2f}" for name, gmac in costs.items()) + " GMAC"
        cheaper = HOLDS if all(mine < costs[name] for name in names) else FAILS, said
    else:
        better = cheaper = UNKNOWN, "no 1-RF with a U-Net" if hdit else "no 1-RF with HDiT"
    # Other embeddings say where a token is, too: only a flow without any can turn its scenes at will.
    roles = {"learnable": "HDiT with APE", "none": "HDiT without APE"}
    marked = [{**row, "role": roles.get(row["position"])} for row in every]
    nearer = judge_less(marked, At(roles["learnable"], None), At(roles["none"], None), "marginals")
    return [
        Claim("HDiT learns the better 1-RF than either U-Net.", "table II", *better),
        Claim("HDiT needs fewer multiplications than either U-Net.", "table II", *cheaper),
        Claim("A learned position embedding brings the azimuths of points nearer to the data's.", "figure 5", *nearer),
    ]
