"""Copies among generated scans are found, and shown."""

import csv
from pathlib import Path

import numpy as np
import pytest

from r2flow.data.opening import open_scans
from r2flow.data.sources import Reading
from r2flow.errors import InputError
from r2flow.evaluation.measuring import Work
from r2flow.lidar.sensors import SENSORS
from r2flow.reports.neighbours import find_neighbours, pair_rows, representation_of, sentences
from tests.test_cli import r2flow  # noqa: F401  a fixture
from tests.test_evaluation import folder, images

SENSOR = SENSORS["hdl64e"].resized(8, 64)


@pytest.fixture
def sets(tmp_path: Path):
    """Training scans, generated ones of which the last but one is a copy of number 5, and held-out ones."""
    made = {"training": images(9, 1), "generated": images(6, 2), "held": images(7, 3)}
    made["generated"][4] = made["training"][5]
    return {name: open_scans(str(folder(tmp_path / name, scans)), Reading(SENSOR)) for name, scans in made.items()}


def log_range(image: np.ndarray) -> np.ndarray:
    """Model space: log2(r + 1) / log2(81) onto [-1, 1], a dropped ray -1; outside 1.45 to 63 m dropped too."""
    r = np.where((image[0] > 1.45) & (image[0] < 63), image[0], 0).astype(np.float64)
    return np.where(r > 0, 2 * np.log2(r + 1) / np.log2(81) - 1, -1).ravel()


def test_each_is_beside_its_nearest_by_the_rms_of_log_range(sets):
    found = find_neighbours(
        sets["generated"], sets["training"], sets["held"], representation_of("pixels", [*sets.values()], "cpu"), Work(2)
    )
    for one, name in ((found.generated, "generated"), (found.real, "held")):
        a, b = (
            np.stack([log_range(s[i]) for i in range(len(s))]) for s in (sets[name].source, sets["training"].source)
        )
        d = np.sqrt(((a[:, None] - b) ** 2).mean(-1))
        np.testing.assert_array_equal(one.neighbours, d.argmin(1))
        np.testing.assert_allclose(one.distances, d.min(1), rtol=1e-4, atol=1e-12)
    assert found.generated.order()[0] == 4
    assert found.generated.neighbours[4] == 5
    assert found.generated.distances[4] == 0


@pytest.mark.parametrize("by", ["pixels", "embedded"])
def test_a_copy_is_told(sets, by):
    found = find_neighbours(
        sets["generated"], sets["training"], sets["held"], representation_of(by, [*sets.values()], "cpu"), Work()
    )
    nearer, copies = sentences(found)
    assert by == "embedded" or nearer.startswith("1 of 6 generated scans lie nearer")
    assert copies.startswith("1 lie nearer than a tenth")
    rows = pair_rows(found)
    assert rows[0] == {"set": "generated", "scan": "000004.npy", "nearest": "000005.npy", "distance": 0.0}
    assert [row["distance"] for row in rows[:6]] == sorted(row["distance"] for row in rows[:6])


def test_without_held_out_scans_training_scans_are_compared_to_the_others(sets):
    found = find_neighbours(
        sets["generated"], sets["training"], None, representation_of("pixels", [*sets.values()], "cpu"), Work(4)
    )
    assert (found.real.neighbours != found.real.numbers).all()
    assert (found.real.distances > 0.1).all()
    assert len(found.real.distances) == 6


def test_scans_without_a_return_have_no_neighbour(sets, tmp_path):
    made = images(3, 2)
    made[1] = 0
    with_empty = open_scans(str(folder(tmp_path / "e", made)), Reading(SENSOR))
    representation = representation_of("pixels", [with_empty], "cpu")
    found = find_neighbours(with_empty, sets["training"], sets["held"], representation, Work())
    assert found.generated.numbers.tolist() == [0, 2]
    nothing = with_empty.part([1], "empty")
    with pytest.raises(InputError, match="none of the 1 scans"):
        find_neighbours(nothing, sets["training"], sets["held"], representation, Work())
    # nor are they one
    found = find_neighbours(sets["generated"], with_empty, sets["held"], representation, Work())
    assert 1 not in found.generated.neighbours


def test_the_verb_writes_the_page(r2flow, sets, tmp_path):  # noqa: F811
    places = [tmp_path / name for name in ("generated", "training", "held")]
    code, said, _ = r2flow(
        "report", "neighbours", places[0], places[1], "--real", places[2], "--by", "pixels", "--size", "8x64",
        "--pairs", 2, "--workers", 0, "--out", tmp_path / "sheet",
    )  # fmt: skip
    assert code == 0
    assert "they are copies or nearly so" in said
    assert len(list((tmp_path / "sheet").glob("*.png"))) == 2
    lines = (tmp_path / "sheet" / "neighbours.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert len(rows) == 6 + 7
    code, _, said = r2flow("report", "neighbours", *places[:2], "--by", "looks", "--size", "8x64", "-o", tmp_path / "n")
    assert code == 2
    assert "--by must be embedded or pixels" in said
