import math

import pytest

from r2flow.reports.paper.claims import FAILS, HOLDS, UNKNOWN, At, all_of, claims, comparable, judge_less, together
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


def test_several_comparisons_have_to_hold_all_of_them():
    assert all_of({"a": (HOLDS, "x"), "b": (HOLDS, "y")})[0] == HOLDS
    assert all_of({"a": (HOLDS, "x"), "b": (UNKNOWN, "y")})[0] == UNKNOWN
    assert all_of({"a": (FAILS, "x"), "b": (UNKNOWN, "y")})[0] == FAILS


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


def test_a_curve_of_few_evaluations_says_nothing_of_many():
    rows = rows_of("1-RF", 4, [0.1, 0.1, 0.1]) + rows_of("2-RF", 4, [0.3, 0.3, 0.3])
    many = At("1-RF", None), At("2-RF", None)
    assert judge_less(rows, *many, "jsd") == (UNKNOWN, "no run of 1-RF at 16 or more nor 2-RF at 16 or more")
    assert judge_less([{**row, "steps": 16} for row in rows], *many, "jsd")[0] == HOLDS


@pytest.mark.parametrize(
    ("few", "verdict"), [([1.0, 1.0, 1.0], HOLDS), ([0.8, 1.0, 1.3], UNKNOWN), ([1.4, 1.5, 1.6], FAILS)]
)
def test_a_distance_is_close_only_where_its_interval_over_seeds_is(few, verdict):
    rows = rows_of("2-RF", 256, [1.0, 1.0, 1.0]) + rows_of("2-TD", 2, few)
    assert comparable(rows, ["jsd"]).verdict == verdict


@pytest.mark.parametrize(("high", "verdict"), [(1.05, HOLDS), (1.5, UNKNOWN)])
def test_one_seed_is_close_only_by_its_intervals_over_scans(high, verdict):
    parent = rows_of("2-RF", 256, [1.0], jsd_low=1.0, jsd_high=1.02)
    assert comparable(parent + rows_of("2-TD", 2, [1.0]), ["jsd"]).verdict == UNKNOWN
    child = rows_of("2-TD", 2, [1.0], jsd_low=0.95, jsd_high=high)
    assert comparable(parent + child, ["jsd"]).verdict == verdict


@pytest.mark.parametrize(
    ("dropped", "verdict"),
    [([0.2], UNKNOWN), ([0.05, 0.2], UNKNOWN), ([0.20, 0.21, 0.22], HOLDS), ([0.01, 0.02, 0.01], FAILS)],
)
def test_ray_drop_of_the_most_curved_paths_is_judged_over_seeds(dropped, verdict):
    curved = [
        {"family": str(i), "role": "1-RF", "integral_normalised": 1.0, "first_tenth": 0.2, "last_tenth": 0.2,
         "paths_dropped": share, "dropped_share": 0.1}
        for i, share in enumerate(dropped)
    ]  # fmt: skip
    found = {claim.source: claim.verdict for claim in claims([], [], curved, [])}
    assert found["figure 8 (b)"] == verdict


def test_hdit_without_ape_does_not_stand_for_the_paper_s():
    common = {"family": "0", "steps": 256, "gmac": 1.0, "marginals": 0.1}
    rows = []
    for seed in range(3):
        for backbone, position, frd in (("hdit", "learnable", 1.0), ("hdit", "none", 9.0), ("adm_unet", "none", 5.0)):
            rows.append({**common, "seed": seed, "backbone": backbone, "position": position, "frd": frd})
    found = {claim.text: claim.verdict for claim in claims([], ["frd"], [], rows)}
    assert found["HDiT learns the better 1-RF than either U-Net."] == HOLDS
