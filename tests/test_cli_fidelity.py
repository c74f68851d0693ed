"""r2flow report fidelity as a user types it."""

import json

import numpy as np
import pytest

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.fidelity import PANEL, distances, panel
from tests.metrics.test_fidelity import walls
from tests.test_cli import r2flow  # noqa: F401  a fixture

SENSOR = SENSORS["hdl64e"].resized(16, 64)
SIZE = ("--size", "16x64")


@pytest.fixture
def folders(tmp_path):
    """Two real drives, and scans to judge."""
    sets = {"real/one": walls(4, 2), "real/two": walls(4, 4), "judged": walls(6, 3)}
    for name, images in sets.items():
        (tmp_path / name).mkdir(parents=True)
        for number, image in enumerate(images):
            np.save(tmp_path / name / f"{number}.npy", image)
    return sets


def test_the_page_holds_the_distances_of_the_folders(r2flow, folders, tmp_path):  # noqa: F811
    arguments = ("report", "fidelity", tmp_path / "real", tmp_path / "judged", *SIZE, "--name", "mine")
    code, said, _ = r2flow(*arguments, "--train", tmp_path / "judged", "--out", tmp_path / "page")
    assert code == 0
    real = np.concatenate([folders["real/one"], folders["real/two"]])
    expected = distances(panel(folders["judged"], SENSOR), panel(real, SENSOR))
    between = distances(panel(folders["real/one"], SENSOR), panel(folders["real/two"], SENSOR))
    assert set(expected) == set(PANEL)
    content = json.loads((tmp_path / "page" / "fidelity.json").read_text())
    assert content["sets"]["other"] == pytest.approx(expected)
    assert content["sets"]["drive against drive"] == pytest.approx(between)
    assert content["nearest"]["other"] == pytest.approx([0, 0], abs=1e-3)  # the judged scans are the training scans
    assert "| gradient, azimuth | " in said
    assert {path.name for path in (tmp_path / "page").iterdir()} == {
        "fidelity.png", "fidelity_histograms.png", "fidelity_scans.png", "fidelity.csv", "fidelity.json", "fidelity.md",
    }  # fmt: skip


def test_without_a_folder_the_table_is_printed(r2flow, folders, tmp_path):  # noqa: F811
    code, said, _ = r2flow(
        "report", "fidelity", tmp_path / "real/one", tmp_path / "judged", *SIZE, "--also", tmp_path / "real/two",
        "--floor", tmp_path / "real/two",
    )  # fmt: skip
    assert code == 0
    assert said.startswith("| distance to the real scans | judged | drive against drive | other real scans | noise |")
    assert "The floor is the distance of the real scans given as --floor." in said
    assert "Scans: 8 real, 6 other, 4 other real." in said


def test_a_folder_without_scans_is_one_line(r2flow, tmp_path):  # noqa: F811
    code, _, said = r2flow("report", "fidelity", tmp_path, tmp_path, "--out", tmp_path / "page")
    assert code == 2
    assert "holds no scan" in said
    assert said.count("\n") == 1
