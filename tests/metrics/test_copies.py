"""Copies among generated scans are found, turned or mirrored."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.evaluation.copies import _copies_result, find_nearest
from r2flow.evaluation.measuring import Work
from tests.conftest import SENSOR, folder, images


@pytest.fixture
def made() -> dict[str, np.ndarray]:
    """Training scans, generated ones of which the last three are copies, and held-out ones."""
    made = {"training": images(9, 1), "generated": images(6, 2), "held": images(7, 3)}
    training = made["training"]
    made["generated"][3:] = (
        training[5],
        np.roll(training[6], 20, -1),
        np.roll(training[7][..., ::-1], 13, -1),
    )
    return made


@pytest.fixture
def sets(tmp_path: Path, made):
    # samples of a model of other limits
    reading = {"generated": Reading(replace(SENSOR, max_range=63.0))}
    return {
        n: open_scans(str(folder(tmp_path / n, x)), reading.get(n, Reading(SENSOR)))
        for n, x in made.items()
    }


def log_range(image: np.ndarray) -> np.ndarray:
    """Model space: log2(r + 1) / log2(81) onto [-1, 1], a dropped ray -1; outside 1.45 to 63 m
    dropped too.
    """
    r = np.where((image[0] > 1.45) & (image[0] < 63), image[0], 0).astype(np.float64)
    return np.where(r > 0, 2 * np.log2(r + 1) / np.log2(81) - 1, -1)


def by_hand(x: np.ndarray, training: np.ndarray) -> np.ndarray:
    """Mean squared difference from every training scan over turns and mirrors, (M,), one by one."""
    y = [
        np.roll(log_range(image)[:, ::flip], -u, -1)
        for flip in (1, -1)
        for u in range(64)
        for image in training
    ]
    return ((log_range(x) - np.stack(y)) ** 2).mean((1, 2)).reshape(2 * 64, len(training)).min(0)


def test_each_has_its_nearest_over_turns_and_mirror_and_copies_are_found(sets, made):
    found = find_nearest(
        {name: sets[name] for name in ("generated", "held")}, sets["training"], Work(2)
    )
    for name, one in found.items():
        for i, image in enumerate(made[name]):
            d = by_hand(image, made["training"])
            assert one.distances[i] == pytest.approx(math.sqrt(d.min()), rel=1e-5)
    one, real = found["generated"], found["held"]
    assert one.distances[3:].tolist() == [0, 0, 0]
    result = _copies_result(one, real)
    assert f"{(one.distances < min(real.distances)).sum()} of 6 scans" in result.remarks[0]
    assert result.figures["copies"] == np.median(one.distances)
    wins = np.mean([a < b for a in one.distances for b in real.distances])
    assert result.figures["copies_nearer"] == pytest.approx(wins)


@pytest.mark.usefixtures("quick_pictures")
def test_real_scans_that_are_training_scans_are_left_out_of_the_test(r2flow, tmp_path, sets, made):
    own = made["training"][3:5]
    found = {}
    for name, real in {
        "mixed": np.concatenate([made["held"], own]),
        "held": made["held"],
        "own": own,
    }.items():
        options = (
            "--size",
            "8x64",
            "--metrics",
            "jsd",
            "--workers",
            0,
            "--json",
            tmp_path / "e.json",
        )
        options += ("--out", tmp_path / "page") if name == "mixed" else ()
        place = folder(tmp_path / f"real_{name}", real)
        said = r2flow(
            "evaluate", place, tmp_path / "generated", "--train", tmp_path / "training", *options
        ).said
        assert ("2 of 9 real scans are training scans" in said) == (name == "mixed")
        comparisons = json.loads((tmp_path / "e.json").read_text())["comparisons"]
        found[name] = {one["comparison"]: one["metrics"][-1] for one in comparisons}
    assert all(
        found["mixed"][n]["figures"] == found["held"][n]["figures"]
        for n in ("generated", "real halves")
    )
    assert found["own"]["generated"]["figures"].keys() == {"copies"}
    nearest = find_nearest(
        {name: sets[name] for name in ("generated", "held")}, sets["training"], Work()
    )
    for name, one in (("generated", nearest["generated"]), ("real halves", nearest["held"])):
        assert found["held"][name]["figures"]["copies"] == pytest.approx(
            np.median(one.distances), rel=1e-6
        )
    assert found["held"]["noise"]["metric"] != "copies"


def test_scans_without_a_return_have_no_neighbour(sets, tmp_path, made):
    empty = images(3, 2)
    empty[1] = 0
    with_empty = open_scans(str(folder(tmp_path / "e", empty)), Reading(SENSOR))
    assert find_nearest({"e": with_empty}, sets["training"], Work())["e"].distances.shape == (2,)
    with pytest.raises(InputError, match="none of the 1 scans"):
        find_nearest({"e": with_empty.part([1], "empty")}, sets["training"], Work())
    apart = [by_hand(image, empty[[0, 2]]).min() for image in made["generated"]]
    found = find_nearest({"g": sets["generated"]}, with_empty, Work())["g"].distances
    np.testing.assert_allclose(found**2, apart, rtol=1e-5)
