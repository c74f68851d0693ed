"""Copies among generated scans are found, turned, mirrored or in parts, and shown."""

import csv
import math
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from r2flow.data.opening import open_scans
from r2flow.data.reading import Reading
from r2flow.errors import InputError
from r2flow.evaluation.measuring import Work
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.neighbours import SECTORS, find_neighbours, nearer, pair_rows, sentences
from tests.test_cli import r2flow  # noqa: F401  a fixture
from tests.test_evaluation import folder, images

SENSOR = SENSORS["hdl64e"].resized(8, 64)
PART = 64 // SECTORS


@pytest.fixture
def made() -> dict[str, np.ndarray]:
    """Training scans, generated ones of which the last four are copies, and held-out ones."""
    made = {"training": images(9, 1), "generated": images(7, 2), "held": images(7, 3)}
    copies, training = made["generated"], made["training"]
    copies[3] = training[5]
    copies[4] = np.roll(training[6], 20, -1)
    copies[5] = np.roll(training[7][..., ::-1], 13, -1)
    copies[6] = training[2]
    copies[6, ..., 4 * PART :] = np.roll(training[8], 3, -1)[..., 4 * PART :]
    return made


@pytest.fixture
def sets(tmp_path: Path, made):
    return {name: open_scans(str(folder(tmp_path / name, scans)), Reading(SENSOR)) for name, scans in made.items()}


def log_range(image: np.ndarray) -> np.ndarray:
    """Model space: log2(r + 1) / log2(81) onto [-1, 1], a dropped ray -1; outside 1.45 to 63 m dropped too."""
    r = np.where((image[0] > 1.45) & (image[0] < 63), image[0], 0).astype(np.float64)
    return np.where(r > 0, 2 * np.log2(r + 1) / np.log2(81) - 1, -1)


def by_hand(x: np.ndarray, training: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean squared difference of every sector from every training scan, (turns and mirrors, M, S), one by one."""
    y = [np.roll(log_range(image)[:, ::flip], -u, -1) for flip in (1, -1) for u in range(64) for image in training]
    d = (log_range(x) - np.stack(y)) ** 2
    return d.reshape(2 * 64, len(training), 8, SECTORS, PART).mean((2, 4))


def test_each_is_beside_its_nearest_over_turns_mirror_and_parts(sets, made):
    found = find_neighbours(sets["generated"], sets["training"], sets["held"], Work(2))
    for one, name in ((found.generated, "generated"), (found.real, "held")):
        for i, image in enumerate(made[name]):
            d = by_hand(image, made["training"])
            whole, parts = d.mean(2).min(0), d.min(0)
            assert int(one.neighbours[i, 0]) == whole.argmin()
            assert one.distances("whole")[i] == pytest.approx(math.sqrt(whole.min()), abs=1e-3)
            assert one.distances("parts")[i] == pytest.approx(math.sqrt(parts.min(0).mean()), abs=1e-3)
            if d.mean(2).min() > 0.01:  # a copy's sectors may lie equally near in several places
                np.testing.assert_array_equal(one.neighbours[i, 1:], parts.argmin(0))


def test_copies_are_found_with_their_turn_and_their_parts(sets, made):
    found = find_neighbours(sets["generated"], sets["training"], sets["held"], Work())
    assert set(found.generated.order("whole")[:3]) == {3, 4, 5}
    assert set(found.generated.order("parts")[:4]) == {3, 4, 5, 6}
    rows = {row["scan"]: row for row in pair_rows(found) if row["set"] == "generated"}
    assert [rows[f"00000{i}.npy"]["nearest"] for i in (3, 4, 5)] == ["000005.npy", "000006.npy", "000007.npy"]
    assert [rows[f"00000{i}.npy"]["mirrored"] for i in (3, 4, 5)] == [False, False, True]
    # The sheet draws the training scan as the sample shows it.
    for way, places in (("whole", (3, 4, 5)), ("parts", (3, 6))):
        for place in places:
            image, _ = found.generated.match(place, way, sets["training"])
            np.testing.assert_array_equal(image[0], made["generated"][place][0])
    for way, said in zip(("whole", "parts"), sentences(found), strict=True):
        count = (found.generated.distances(way) < min(found.real.distances(way))).sum()
        assert count >= 3
        assert f"**{count} of 7** generated scans lie nearer to a training scan than any of 7 held-out" in said


def test_how_unlikely_it_is_is_counted_over_all_orders():
    """Of 3 and 4 numbers, by the 35 ways in which chance can mix them."""
    a, b = np.array([0.1, 0.2, 0.5]), np.array([0.3, 0.4, 0.6, 0.7])
    found = nearer(a, b)
    orders = {tuple(order) for order in permutations("aaabbbb")}
    first = [order.index("b") for order in orders]  # how many of a lie before every b
    assert found.count == 2
    assert found.expected == pytest.approx(np.mean(first)) == 3 / 5
    assert found.p_count == pytest.approx(np.mean([k >= 2 for k in first]))
    wins = [sum(x == "a" and y == "b" for i, x in enumerate(order) for y in order[i:]) for order in orders]
    assert found.share == 10 / 12
    assert found.p_share == pytest.approx(np.mean([win >= 10 for win in wins]))


def test_without_held_out_scans_training_scans_are_compared_to_the_others(sets):
    found = find_neighbours(sets["generated"], sets["training"], None, Work(4))
    assert (found.real.neighbours.numpy() != found.real.numbers[:, None]).all()
    assert (found.real.distances("parts") > 0.1).all()
    assert len(found.real.numbers) == 7


def test_scans_without_a_return_have_no_neighbour(sets, tmp_path):
    made = images(3, 2)
    made[1] = 0
    with_empty = open_scans(str(folder(tmp_path / "e", made)), Reading(SENSOR))
    found = find_neighbours(with_empty, sets["training"], sets["held"], Work())
    assert found.generated.numbers.tolist() == [0, 2]
    nothing = with_empty.part([1], "empty")
    with pytest.raises(InputError, match="none of the 1 scans"):
        find_neighbours(nothing, sets["training"], sets["held"], Work())
    # nor are they one
    found = find_neighbours(sets["generated"], with_empty, sets["held"], Work())
    assert (found.generated.neighbours != 1).all()


def test_the_verb_writes_the_page(r2flow, sets, tmp_path):  # noqa: F811
    places = [tmp_path / name for name in ("generated", "training", "held")]
    code, said, _ = r2flow(
        "report", "neighbours", places[0], places[1], "--real", places[2], "--size", "8x64",
        "--pairs", 1, "--workers", 0, "--out", tmp_path / "sheet",
    )  # fmt: skip
    assert code == 0
    assert "generated scans lie nearer to a training scan than any of 7 held-out real scans" in said
    assert "no copy" not in said
    assert len(list((tmp_path / "sheet").glob("*.png"))) == 2
    lines = (tmp_path / "sheet" / "neighbours.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(rows) == 7 + 7
