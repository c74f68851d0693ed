"""What own steps save, and rows that add up."""

import math

import pytest
import torch

from r2flow.generators import Field
from r2flow.reports import savings
from r2flow.reports.pages import write_page
from r2flow.reports.savings import (
    EULER,
    LEAVING,
    LONE,
    MIXED,
    ONE_STATE,
    STAYING,
    channel_rows,
    exact_rows,
    region_rows,
    regions_to_measure,
    savings_page,
    scan_rows,
)
from tests.test_sampling import flow, network


@pytest.fixture(autouse=True)
def _one_timing(monkeypatch):
    monkeypatch.setattr(savings, "REPEATS", 1)


def by_way(rows: list, tolerance: float | None = None) -> dict:
    return {row["way"]: row for row in rows if tolerance is None or row["tolerance"] in (tolerance, None)}


@pytest.mark.parametrize("seed", [0, 1])
def test_own_steps_take_at_most_0_6_of_the_evaluations_of_one_state(seed):
    rows = exact_rows(MIXED, "mixed", (1e-3, 1e-5), seed)
    for tolerance in (1e-3, 1e-5):
        ways = by_way(rows, tolerance)
        assert ways[LEAVING]["evaluations"] <= 0.6 * ways[ONE_STATE]["evaluations"]
        assert ways[STAYING]["evaluations"] > ways[LEAVING]["evaluations"]
    hardest = by_way(rows, 1e-3)
    assert hardest[LEAVING]["worst_error"] < hardest[ONE_STATE]["worst_error"]
    assert ways[EULER]["evaluations"] == 16 * 32


def test_one_hard_scan_among_easy_ones_is_solved():
    ways = by_way(exact_rows(LONE, "lone", (1e-3,), seed=0))
    assert ways[LEAVING]["error_ray_drop"] < 5e-3 < ways[ONE_STATE]["error_ray_drop"]


def test_scans_of_a_flow_are_compared_with_its_tight_solution():
    calls: list[int] = []
    ways = by_way(scan_rows(flow(), 2, 1e-3, seed=0, progress=lambda: calls.append(1)))
    # the exact flow of a Gaussian: a solution at 1e-6 is the truth to that
    assert ways[LEAVING]["worst_error"] < 1e-2
    assert ways[EULER]["worst_error"] > ways[LEAVING]["median_error"]
    assert len(calls) > 0


def test_regions_cost_their_share_and_are_measured_where_they_were_asked_for():
    rows = region_rows(network(), 2, steps=2, seed=0)
    whole, *parts = rows
    assert (whole["share"], whole["time"]) == (1.0, 1.0)
    ways, known = {row["way"] for row in parts}, set(regions_to_measure((8, 64)))
    margins = [row["share"] for row in parts if "margin" in row["way"]]
    assert {way for way in known if "margin" not in way} <= ways <= known
    assert len(margins) == len(set(margins)) > 0  # those that rounding makes one are measured once
    for row in parts:
        assert 0 < row["share"] < 1
        assert row["error"] > 0
        assert 0 <= row["dropped"] <= 1
        assert row["unrelated"] > 0
    by_name = {row["way"]: row for row in parts}
    assert by_name["sector of 180 degrees"]["share"] == 0.5
    assert by_name["sector of 90 degrees"]["share"] == 0.25


def test_a_velocity_pixel_by_pixel_is_the_same_on_a_part(monkeypatch):
    # the exact Gaussian flow acts on each pixel by itself: any region of it is that of the whole
    monkeypatch.setattr(Field, "unit", (1, 1))
    monkeypatch.setattr(Field, "part", lambda generator, region: generator)
    for row in region_rows(flow(), 2, steps=4, seed=0)[1:]:
        assert row["error"] == pytest.approx(0, abs=1e-6)
        assert row["median_m"] == pytest.approx(0, abs=1e-4)


def test_channels_share_the_network_and_not_the_bytes():
    both, alone = channel_rows(network(), budget=0.01)
    assert both["bytes"] > alone["bytes"]
    # PLY: 12 of 16 bytes a point; image: one of two channels
    assert alone["bytes"] / both["bytes"] > 0.5
    assert channel_rows(network(reflectance=False)) == []


def test_the_page_is_written_with_and_without_a_checkpoint(tmp_path):
    page = savings_page(network(), num=1, steps=1, tolerance=1e-1, command="r2flow report savings run")
    written = {path.name for path in write_page(page, tmp_path)}
    assert written == {
        "savings_scenes.png", "savings_regions.png", "savings.csv", "savings.json", "savings.md"
    }  # fmt: skip
    text = (tmp_path / "savings.md").read_text()
    for words in ("One hard scan among 255", "A part of the image", "One channel", "r2flow report savings run"):
        assert words in text
    assert not any(math.isnan(row.get("evaluations", 0)) for row in page.rows)
    torch.manual_seed(0)
