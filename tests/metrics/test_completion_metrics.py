"""Errors of completed scans against hand-made cases."""

import math

import numpy as np
import pytest

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.completion import errors, spread_errors

SENSOR = SENSORS["hdl64e"].resized(2, 4)


def scan(r: list[list[float]], reflectance: float = 0.5) -> np.ndarray:
    r_array = np.array(r, dtype=np.float32)
    return np.stack([r_array, np.where(r_array > 0, np.float32(reflectance), 0)])


def test_every_figure_of_a_case_worked_out_by_hand():
    truth = scan([[10, 10, 10, 10], [10, 0, 10, 10]])
    answer = scan([[10, 10, 12, 10], [10, 10, 0, 10]], reflectance=0.75)
    hidden = np.zeros((2, 4), dtype=bool)
    hidden[0, 2] = hidden[1, 1] = hidden[1, 2] = hidden[1, 3] = True
    found = errors(truth, answer, hidden, SENSOR)
    assert found["mae_all_m"] == pytest.approx((2 + 10 + 10) / 8)  # all 8 pixels, missing as 0
    assert found["mae_m"] == pytest.approx((2 + 0) / 2)
    assert found["drop_wrong"] == pytest.approx(2 / 4)
    assert found["reflectance_mae"] == pytest.approx(0.25)
    # By 10 m and rays 90 degrees and 14 degrees apart, five points agree and two differ on either
    # side.
    assert found["iou"] == pytest.approx(5 / 9)
    apart = 2 * 10 * math.sin(math.radians(14) / 2)  # of two rows at 10 m
    # Truth's (0, 2) is 2 m from the answer's, its (1, 2) a row or the moved point away.
    moved = math.sqrt(10**2 + 12**2 - 2 * 10 * 12 * math.cos(math.radians(14)))
    theirs = 2, min(moved, 10 * math.sqrt(2))
    ours = 2, apart  # the answer's (0, 2) is 2 m away, its (1, 1) a row from truth's (0, 1)
    assert found["chamfer_m"] == pytest.approx(sum(theirs + ours) / 7, rel=1e-5)
    assert found["chamfer_m2"] == pytest.approx(sum(d**2 for d in theirs + ours) / 7, rel=1e-5)


def test_an_empty_scan_has_no_figures_that_do_not_exist():
    empty, hidden = scan([[0] * 4] * 2), np.ones((2, 4), dtype=bool)
    found = errors(empty, empty, hidden, SENSOR)
    assert found.pop("drop_wrong") == found.pop("mae_all_m") == 0
    assert all(map(math.isnan, found.values()))
    # far away: means would leave NaN out
    found = errors(scan([[10] * 4] * 2), empty, hidden, SENSOR)
    assert (found["iou"], found["chamfer_m"], found["chamfer_m2"]) == (0, math.inf, math.inf)


@pytest.mark.parametrize("dropped", [0, 0.24, 1])
def test_coverage_is_nominal_where_the_truth_is_one_more_answer(dropped):
    random = np.random.default_rng(0)
    draws = random.normal(20, 3, (9, 1, 200, 200)).astype(np.float32)
    draws[random.random(draws.shape) < dropped] = 0
    found = spread_errors(draws[0], draws[1:], np.ones((200, 200), dtype=bool))
    assert found["nominal"] == 7 / 9
    assert found["coverage"] == pytest.approx(7 / 9, abs=4 * math.sqrt(7 / 9 * 2 / 9 / 40000))
    if not dropped:  # CRPS of N(m, s) against a draw of the same: s / sqrt(pi)
        assert found["crps_m"] == pytest.approx(3 / math.sqrt(math.pi), rel=0.02)


def test_answers_without_spread_have_the_crps_of_their_error():
    answers = np.full((4, 1, 2, 2), 12.0, dtype=np.float32)
    found = spread_errors(
        np.full((1, 2, 2), 10.0, dtype=np.float32), answers, np.ones((2, 2), dtype=bool)
    )
    assert found["crps_m"] == found["mae_of_median_m"] == 2
    assert found["coverage"] == 0
