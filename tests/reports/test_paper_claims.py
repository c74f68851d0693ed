import math

import pytest

from benchmarks.false_verdicts import METRICS, shares
from r2flow.errors import InputError
from r2flow.reports.paper.claims import At, all_better, claims, comparable, compare, primary_of
from r2flow.reports.paper.printed import COLUMNS, PAPER_KIND, TABLE_I, TABLE_II
from r2flow.reports.verdicts import FAILS, HOLDS, UNKNOWN, all_above_0, any_above_0, interval


def rows_of(role: str, steps: int, distances: list[float], **more: float) -> list[dict]:
    return [
        {"family": f"chain {seed}", "role": role, "steps": steps, "jsd": d, **more} for seed, d in enumerate(distances)
    ]


A, B = At("2-RF", 1), At("1-RF", 1)


def verdict(rows: list[dict], a: At, b: At, better: str = "smaller") -> str:
    return all_better(rows, {"jsd": better}, "jsd", (a, b))[0]


@pytest.mark.parametrize("metrics", METRICS)
@pytest.mark.parametrize("seeds", [1, 3, 5])
def test_equal_generators_get_few_verdicts_and_none_from_one_seed(metrics, seeds):
    """1,000 trials, training spread 10 %: at most 5 % either way; 2.5 % are expected, and 4.1 % is 3.3 sigma off."""
    found = shares(1000, seeds, metrics)
    assert max(found.values()) <= (0.0 if seeds == 1 else 0.041)


def test_a_difference_five_times_the_spread_is_seen_by_five_seeds():
    # log 1.5 = 0.405 over a deviation of 0.1 sqrt(2 / 5) = 0.063: t = 6.4 where 2.78 is needed.
    assert shares(200, 5, 3, larger=1.5)[HOLDS] > 0.95


def test_three_seeds_that_agree_hold_and_their_contrary_does_not():
    rows = rows_of("2-RF", 1, [0.10, 0.11, 0.12]) + rows_of("1-RF", 1, [0.30, 0.33, 0.37])
    assert verdict(rows, A, B) == HOLDS
    assert verdict(rows, B, A) == FAILS


def test_a_metric_of_which_more_is_better_is_no_distance():
    rows = rows_of("2-RF", 1, [0.10, 0.11, 0.12]) + rows_of("1-RF", 1, [0.30, 0.33, 0.37])
    assert verdict(rows, A, B, "larger") == FAILS
    assert verdict(rows, B, A, "larger") == HOLDS


def test_the_interval_is_student_s():
    # Mean 0.1, deviation 0.2, the 97.5 % quantile of two degrees of freedom is 4.303: half width 0.4969.
    assert interval([-0.1, 0.1, 0.3]) == pytest.approx((0.1 - 0.4969, 0.1 + 0.4969), abs=1e-4)
    assert interval([0.3]) == interval([]) == (-math.inf, math.inf)
    rows = rows_of("2-RF", 1, [1.0, 1.0, 1.0]) + rows_of("1-RF", 1, [math.exp(x) for x in (-0.1, 0.1, 0.3)])
    said = f"{math.exp(0.1 - 0.4969):.2f} to {math.exp(0.1 + 0.4969):.2f} times as good over 3 seeds"
    assert said in compare(rows, A, B, "jsd").said


def test_a_margin_that_is_not_known_tells_nothing():
    assert all_above_0([[math.nan, 3.0, 3.1]]) == any_above_0([[math.nan, 3.0, 3.1]]) == UNKNOWN


def test_only_the_primary_metric_judges():
    rows = [{**row, "mmd": 1 / row["jsd"]} for seed in range(3) for row in (
        {"family": str(seed), "role": "2-RF", "steps": 1, "jsd": 0.1 + 0.01 * seed},
        {"family": str(seed), "role": "1-RF", "steps": 1, "jsd": 0.3 + 0.01 * seed})]  # fmt: skip
    metrics = dict.fromkeys(("jsd", "mmd"), "smaller")
    assert all_better(rows, metrics, "jsd", (A, B))[0] == HOLDS
    assert all_better(rows, metrics, "mmd", (A, B))[0] == FAILS
    assert primary_of(["jsd", "mmd", "frechet_embedded"]) == "frechet_embedded"
    assert primary_of(["jsd", "mmd"], "mmd") == "mmd"
    with pytest.raises(InputError, match="--primary must be one of jsd, mmd"):
        primary_of(["jsd", "mmd"], "frd")


def test_seeds_that_disagree_and_a_seed_alone_tell_nothing():
    rows = rows_of("2-RF", 1, [0.1, 0.4]) + rows_of("1-RF", 1, [0.2, 0.2])
    assert verdict(rows, A, B) == UNKNOWN
    alone = rows_of("2-RF", 1, [0.1], jsd_low=0.09, jsd_high=0.11) + rows_of("1-RF", 1, [0.9], jsd_low=0.8, jsd_high=1)
    assert verdict(alone, A, B) == UNKNOWN


def test_only_flows_of_one_chain_are_compared():
    rows = [*rows_of("2-RF", 1, [0.1]), {"family": "another", "role": "1-RF", "steps": 1, "jsd": 0.9}]
    assert compare(rows, A, B, "jsd").said == "no chain has both"
    assert compare(rows, A, At("1-TD", 1), "jsd").said == "no run of 1-TD at 1"
    assert verdict(rows, A, B) == verdict(rows, A, At("1-TD", 1)) == UNKNOWN


def test_what_is_missing_is_named():
    found = claims([], {"jsd": "smaller"}, "jsd", [], [])
    assert {claim.verdict for claim in found} == {UNKNOWN}
    assert "jsd no run of 2-RF at 1 nor 1-RF at 1" in [claim.evidence for claim in found]


YES, NO, NEITHER = [0.9, 1.0, 1.1], [-0.9, -1.0, -1.1], [-1.0, 0.0, 1.1]


def test_several_comparisons_have_to_hold_all_of_them_or_any():
    assert all_above_0([YES, YES]) == HOLDS
    assert all_above_0([YES, NEITHER]) == all_above_0([YES, [1.0]]) == all_above_0([]) == UNKNOWN
    assert all_above_0([NO, YES]) == FAILS
    assert any_above_0([YES, NO]) == HOLDS
    assert any_above_0([NEITHER, NO]) == any_above_0([]) == UNKNOWN
    assert any_above_0([NO, NO]) == FAILS
    # Mean 1, deviation 0.3: t = 5.77 has p = 0.029, enough for one comparison and too little for one of two.
    weak = [0.7, 1.0, 1.3]
    assert any_above_0([weak]) == HOLDS
    assert any_above_0([weak, NEITHER]) == UNKNOWN


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
    found = {claim.text: claim for claim in claims(rows, {"frd": "smaller"}, "frd", [], architectures)}
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
        claim.verdict
        for claim in claims(rows, dict.fromkeys(("fpd", "jsd"), "smaller"), "jsd", [], [])
        if claim.text.startswith("On some metrics")
    }


def test_a_curve_of_few_evaluations_says_nothing_of_many():
    rows = rows_of("1-RF", 4, [0.1, 0.1, 0.1]) + rows_of("2-RF", 4, [0.3, 0.3, 0.3])
    many = At("1-RF", None), At("2-RF", None)
    assert compare(rows, *many, "jsd").said == "no run of 1-RF at 16 or more nor 2-RF at 16 or more"
    assert verdict(rows, *many) == UNKNOWN
    assert verdict([{**row, "steps": 16} for row in rows], *many) == HOLDS


@pytest.mark.parametrize(
    ("few", "verdict"), [([1.0, 1.0, 1.0], HOLDS), ([0.8, 1.0, 1.3], UNKNOWN), ([1.4, 1.5, 1.6], FAILS)]
)
def test_a_distance_is_close_only_where_its_interval_over_seeds_is(few, verdict):
    rows = rows_of("2-RF", 256, [1.0, 1.0, 1.0]) + rows_of("2-TD", 2, few)
    assert comparable(rows, {"jsd": "smaller"}).verdict == verdict
    one = rows_of("2-RF", 256, [1.0]) + rows_of("2-TD", 2, few[:1])
    assert comparable(one, {"jsd": "smaller"}).verdict == UNKNOWN


CURVED = {
    "role": "1-RF", "integral_normalised": 1.0, "first_tenth": 0.2, "last_tenth": 0.2, "ends_over_middle": 1.0,
    "paths_dropped": 0.1, "dropped_share": 0.1,
}  # fmt: skip


@pytest.mark.parametrize(
    ("dropped", "verdict"),
    [([0.2], UNKNOWN), ([0.05, 0.2], UNKNOWN), ([0.20, 0.21, 0.22], HOLDS), ([0.01, 0.02, 0.01], FAILS)],
)
def test_ray_drop_of_the_most_curved_paths_is_judged_over_seeds(dropped, verdict):
    curved = [
        {**CURVED, "family": str(i), "kind": PAPER_KIND, "paths_dropped": share} for i, share in enumerate(dropped)
    ]
    # Another network is another question.
    curved += [{**CURVED, "family": f"other {i}", "kind": "adm_unet", "paths_dropped": 0.9} for i in range(9)]
    found = {claim.source: claim.verdict for claim in claims([], {"jsd": "smaller"}, "jsd", curved, [])}
    assert found["figure 8 (b)"] == verdict


@pytest.mark.parametrize(
    ("ends", "verdict"),
    [([3.0], UNKNOWN), ([2.0, 2.2, 2.4], HOLDS), ([0.3, 0.35, 0.4], FAILS), ([0.5, 1.1, 1.6], UNKNOWN)],
)
def test_most_curved_at_both_ends_is_more_curved_than_the_middle(ends, verdict):
    curved = [{**CURVED, "family": str(i), "kind": "x", "ends_over_middle": ratio} for i, ratio in enumerate(ends)]
    found = {claim.text: claim.verdict for claim in claims([], {"jsd": "smaller"}, "jsd", curved, [])}
    assert found["The 1-RF is curved most at its first and last steps."] == verdict


def test_hdit_without_ape_does_not_stand_for_the_paper_s():
    common = {"family": "0", "steps": 256, "gmac": 1.0, "marginals": 0.1}
    rows = []
    for seed in range(3):
        for backbone, position, frd in (("hdit", "learnable", 1.0), ("hdit", "none", 9.0), ("adm_unet", "none", 5.0)):
            rows.append({**common, "seed": seed, "backbone": backbone, "position": position, "frd": frd})
    found = {claim.text: claim.verdict for claim in claims([], {"frd": "smaller"}, "frd", [], rows)}
    assert found["HDiT learns the better 1-RF than either U-Net."] == HOLDS
