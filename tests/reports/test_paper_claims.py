import math

import pytest

from r2flow.reports.paper.claims import FAILS, HOLDS, UNKNOWN, At, claims, judge_less, together
from r2flow.reports.paper.printed import COLUMNS, TABLE_I, TABLE_II


def rows_of(role: str, steps: int, distances: list[float], **more: float) -> list[dict]:
    return [
        {"family": f"chain {seed}", "role": role, "steps": steps, "jsd": d, **more} for seed, d in enumerate(distances)
    ]


A, B = At("2-RF", 1), At("1-RF", 1)


def test_three_seeds_that_agree_hold_and_their_contrary_does_not():
    rows = rows_of("2-RF", 1, [0.10, 0.11, 0.12]) + rows_of("1-RF", 1, [0.30, 0.33, 0.37])
    assert judge_less(rows, A, B, "jsd")[0] == HOLDS
    assert judge_less(rows, B, A, "jsd")[0] == FAILS


def test_the_interval_is_student_s():
    # log ratios -0.1, 0.1, 0.3: mean 0.1, deviation 0.2, half width 4.303 * 0.2 / sqrt(3) = 0.4969.
    rows = rows_of("2-RF", 1, [1.0, 1.0, 1.0]) + rows_of("1-RF", 1, [math.exp(x) for x in (-0.1, 0.1, 0.3)])
    verdict, evidence = judge_less(rows, A, B, "jsd")
    assert verdict == UNKNOWN
    assert f"ratio {math.exp(0.1 - 0.4969):.2f} to {math.exp(0.1 + 0.4969):.2f} over 3 seeds" in evidence


def test_seeds_that_disagree_and_a_seed_alone_tell_nothing():
    rows = rows_of("2-RF", 1, [0.1, 0.4]) + rows_of("1-RF", 1, [0.2, 0.2])
    assert judge_less(rows, A, B, "jsd")[0] == UNKNOWN
    alone = rows_of("2-RF", 1, [0.1]) + rows_of("1-RF", 1, [0.9])
    assert judge_less(alone, A, B, "jsd")[0] == UNKNOWN


@pytest.mark.parametrize(("low", "verdict"), [(0.45, HOLDS), (0.15, UNKNOWN)])
def test_one_seed_is_judged_by_whether_its_intervals_over_scans_part(low, verdict):
    rows = rows_of("2-RF", 1, [0.2], jsd_low=0.1, jsd_high=0.3) + rows_of("1-RF", 1, [0.5], jsd_low=low, jsd_high=0.6)
    assert judge_less(rows, A, B, "jsd")[0] == verdict


def test_only_flows_of_one_chain_are_compared():
    rows = [*rows_of("2-RF", 1, [0.1]), {"family": "another", "role": "1-RF", "steps": 1, "jsd": 0.9}]
    assert judge_less(rows, A, B, "jsd") == (UNKNOWN, "no chain has both")
    assert judge_less(rows, A, At("1-TD", 1), "jsd") == (UNKNOWN, "no run of 1-TD at 1")


def test_what_is_missing_is_named():
    found = claims([], ["jsd"], [], [])
    assert {claim.verdict for claim in found} == {UNKNOWN}
    assert "no run of 2-RF at 1 nor 1-RF at 1" in [claim.evidence for claim in found]


def test_one_contradiction_outweighs_what_holds():
    assert together({"a": (HOLDS, "x"), "b": (UNKNOWN, "y")})[0] == HOLDS
    assert together({"a": (HOLDS, "x"), "b": (FAILS, "y")})[0] == FAILS


def test_the_paper_s_own_table_bears_out_the_paper_s_claims():
    """Its printed figures, as if every one had been found by three seeds that differ by a thousandth."""
    rows = []
    for printed in TABLE_I:
        if printed.role is None:
            continue
        for seed in range(3):
            figures = {m: f * (1 + 1e-3 * seed) for m, f in zip(COLUMNS, printed.figures, strict=True) if f}
            rows.append({"family": str(seed), "role": printed.role, "steps": printed.evaluations, **figures})
    architectures = []
    for seed in range(3):
        common = {"seed": seed, "family": str(seed), "steps": 256, "position": "learnable", "marginals": 0.1}
        for name in ("hdit", "adm_unet", "efficient_unet"):
            figures = {"gmac": TABLE_II[name].gmac, "frd": TABLE_II[name].frd * (1 + 1e-3 * seed)}
            architectures.append({**common, "backbone": name, **figures})
    found = {claim.text: claim for claim in claims(rows, ["frd"], [], architectures)}
    held = [text for text, claim in found.items() if claim.verdict == HOLDS]
    assert {
        "At many evaluations the 1-RF is better than the 2-RF, whose teacher it is.",
        "At one evaluation the 2-RF is better than the 1-RF.",
        "Distilled to one step, the 1-TD is better than its 2-RF.",
        "Two and four steps are better than one.",
        "HDiT learns the better 1-RF than either U-Net.",
        "HDiT needs fewer multiplications than either U-Net.",
    } <= set(held)
    assert FAILS not in {
        claim.verdict for claim in claims(rows, ["fpd", "jsd"], [], []) if claim.text.startswith("On some metrics")
    }
