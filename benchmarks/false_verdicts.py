"""How often the paper report's claims are decided by noise, and how often a true difference is seen.

    python benchmarks/false_verdicts.py        # 1,000 trials a cell, one minute on one core

Two generators are trained on some seeds each. A figure is its generator's level times exp(0.1 z): trainings spread by
10 %, half of the variance common to all metrics of a training. The claim is "At many evaluations the 1-RF is better
than the 2-RF" as `r2flow report paper` judges it; equal levels make every verdict a false one.
"""

import argparse
import math

import numpy as np

from r2flow.reports.paper.claims import At, all_better
from r2flow.reports.tables import print_table
from r2flow.reports.verdicts import FAILS, HOLDS

SPREAD, COMMON = 0.1, 0.5  # of a figure over trainings; share of its variance that all metrics have in common
SEEDS, METRICS = (1, 2, 3, 5, 10), (1, 3, 7)
LARGER = (1.0, 1.1, 1.2, 1.5)  # the 2-RF's distances over the 1-RF's


def rows_of(draw: np.random.Generator, seeds: int, metrics: int, larger: float) -> list[dict]:
    """A row for each flow and seed, as `claims` takes them."""
    rows = []
    for seed in range(seeds):
        for role, level in (("1-RF", 1.0), ("2-RF", larger)):
            z = math.sqrt(COMMON) * draw.standard_normal() + math.sqrt(1 - COMMON) * draw.standard_normal(metrics)
            figures = {f"metric {k}": value for k, value in enumerate((level * np.exp(SPREAD * z)).tolist())}
            rows.append({"family": str(seed), "role": role, "steps": 32, **figures})
    return rows


def shares(trials: int, seeds: int, metrics: int, larger: float = 1.0) -> dict[str, float]:
    """The share of trials in which the claim holds, and in which it does not."""
    draw = np.random.default_rng([seeds, metrics, round(100 * larger)])
    measured = {f"metric {k}": "smaller" for k in range(metrics)}
    found = [
        all_better(rows_of(draw, seeds, metrics, larger), measured, "metric 0", (At("1-RF", None), At("2-RF", None)))
        for _ in range(trials)
    ]
    return {verdict: sum(one == verdict for one, _ in found) / trials for verdict in (HOLDS, FAILS)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    trials = parser.parse_args().trials
    false = [
        {"metrics": metrics, **{f"{seeds} {verdict}": f"{share:.1%}" for seeds in SEEDS
                                for verdict, share in shares(trials, seeds, metrics).items()}}
        for metrics in METRICS
    ]  # fmt: skip
    print_table(false, {key: key for key in false[0]}, "equal generators: seeds, verdict")
    seen = [
        {"true difference": f"{larger - 1:.0%}",
         **{f"{seeds} seeds": f"{shares(trials, seeds, 3, larger)[HOLDS]:.0%}" for seeds in SEEDS}}
        for larger in LARGER[1:]
    ]  # fmt: skip
    print_table(seen, {key: key for key in seen[0]}, "a true difference is seen")


if __name__ == "__main__":
    main()
