"""Sentences on an evaluation: which sets are as near to the real scans as these to each other."""

import math

from r2flow.evaluation.comparing import Comparison, Comparisons
from r2flow.evaluation.sets import AS_MANY, HALVES

_ENOUGH = 100  # least number of scans of a set, or of a half of the real ones, for a verdict
# 95 % of equal sets of one source differ by less: 200 splits of simulated scans, 50 to 160 a set
_MARGIN = 1.5
_HEADLINE = "panel"  # metric of the verdict, if measured

# Heading and factor of values, for printing only: published tables print some scaled.
PRINTED = {
    "jsd": ("JSD x 10^2", 1e2),
    "mmd": ("MMD x 10^4", 1e4),
    "kid_handcrafted": ("KID, hand-made features", 1.0),
    "frechet_handcrafted": ("Frechet distance, hand-made features", 1.0),
    "evaluations": ("network evaluations a scan", 1.0),
    "seconds": ("seconds a scan", 1.0),
}

_Value = tuple[float, Comparison]


def heading(metric: str, figure: str) -> tuple[str, float]:
    """Heading of a value in a table, and its printed factor."""
    if metric in (figure, "speed"):
        return PRINTED.get(figure, (figure, 1.0))
    return figure, 1.0


def verdict(comparisons: Comparisons) -> list[str]:
    """One sentence per judged set, the nearest first: its panel next to those of real halves and
    the best baseline.

    Without the panel the first biased distance is taken: an unbiased one of equal sets is above
    that of the halves as often as not, by any factor. As it is larger for fewer scans, a set is
    compared with real halves in as many scans as they have, if measured.
    """
    biased = [name for name, larger in _distances(comparisons).items() if larger]
    metric = _HEADLINE if _HEADLINE in biased else next(iter(biased), "")
    values = [pair for pair in _first_values(comparisons, metric) if math.isfinite(pair[0])]
    values.sort(key=lambda pair: pair[0])
    titled = {c.title: (value, c) for value, c in values}
    halves = titled.get(f"reference: {HALVES}")
    if halves is None:
        return []
    baselines = [pair for pair in values if pair[1].kind == "baseline"][:1]
    best = baselines[0][0] if baselines else math.inf
    title, factor = heading(metric, metric)
    bounds = [f"{c.title} {value * factor:.3g}" for value, c in (halves, *baselines)]
    lines = []
    for value, comparison in values:
        if comparison.kind != "judged":
            continue
        equal = titled.get(f"reference: {comparison.name}{AS_MANY}")
        same = [f"in as many scans as the halves {equal[0] * factor:.3g}"] if equal else []
        near = ", ".join([*same, *bounds])
        judgement = _judge((value, comparison), equal, halves, best)
        empty = comparison.measured[0].protocol.get("sizes", {}).get("generated_empty")
        if empty:
            judgement += f"; {empty} of its scans are empty and not compared"
        lines.append(f"{comparison.name}: {title} {value * factor:.3g} ({near}): {judgement}.")
    return lines


def _judge(judged: _Value, equal: _Value | None, halves: _Value, best: float) -> str:
    """Judge a set; `equal` is its distance in as many scans as the halves have, `best` that of the
    best baseline.
    """
    value, comparison = judged
    compared, pair = equal or judged
    reference, half = halves
    scans = min(len(pair.real), len(pair.generated))
    of_half = min(len(half.real), len(half.generated))
    farther = compared > _MARGIN * reference
    if min(scans, of_half) < _ENOUGH:
        above = "above" if compared > reference else "not above"
        clause = ""
        if best < math.inf:
            clause = f", {'below' if value < best else 'not below'} the baselines"
        return (
            f"{above} the real halves{clause}; too few scans for a verdict: {len(comparison.real)} "
            "real, "
            f"{len(comparison.generated)} generated, {2 * _ENOUGH} and {_ENOUGH} needed"
        )
    if value >= best:
        return "no lower than a baseline"
    if reference >= best:
        return "undecided, as the real halves are above a baseline"
    if scans < of_half if farther else scans > of_half:
        return (
            f"undecided, as the halves have other numbers of scans: give {of_half} generated scans"
        )
    if farther:
        return "higher than between the real halves"
    return "not distinguishable from real scans by this figure"


def remarks_of(comparisons: Comparisons) -> list[str]:
    """Remarks on distances that do not rank, and those of the metrics with the sets that they are
    on.
    """
    lines = []
    distances = _distances(comparisons)
    if any(distances.values()) and len({(len(c.real), len(c.generated)) for c in comparisons}) > 1:
        lines.append("Distances of fewer scans are larger: compare only sets of equal sizes.")
    for metric in distances:
        values = _first_values(comparisons, metric)
        halves = [value for value, c in values if (c.kind, c.name) == ("reference", HALVES)]
        below = [
            c.name for value, c in values if c.kind == "baseline" and halves and value < halves[0]
        ]
        if below:
            lines.append(
                f"do not rank by {metric} here: baselines are below the real halves: "
                f"{', '.join(below)}."
            )
    sets: dict[str, dict[str, None]] = {}  # by remark
    for comparison in comparisons:
        for result in comparison.measured:
            for remark in result.remarks:
                sets.setdefault(remark, {})[comparison.title] = None
    for remark, titles in sets.items():
        lines.append(
            remark if len(titles) == len(comparisons) else f"{', '.join(titles)}: {remark}"
        )
    return lines


def _distances(comparisons: Comparisons) -> dict[str, bool]:
    """Names of the metrics that are distances, and whether they are biased."""
    return {m.metric: m.biased for m in comparisons[0].measured if m.biased is not None}


def _first_values(comparisons: Comparisons, metric: str) -> list[_Value]:
    """The first figure of a metric, with its comparison."""
    return [
        (next(iter(m.figures.values())), c)
        for c in comparisons
        for m in c.measured
        if m.metric == metric
    ]
