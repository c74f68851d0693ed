"""`r2flow ablate`: what is trained for how long, what is measured, and when two settings differ."""

import csv
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.reports.ablation import (
    TIMES,
    Groups,
    _squared_errors,
    best,
    conclusion,
    table_rows,
)
from r2flow.runs.ablation import Ablation, Clock

TINY = [
    *("backbone=hdit", "backbone.base_channels=8", "backbone.depths=[1,1]"),
    *("backbone.num_heads=[1,2]", "backbone.time_channels=16", "sensor.rows=8"),
    *("sensor.columns=32", "data.scenes=10", "data.batch_size=2"),
]


def ablation(*keys: str, out: Path = Path("out"), seeds: int = 2) -> Ablation:
    return Ablation(keys, seeds, 60.0, out)


def test_every_combination_is_trained_and_named_by_its_swept_values():
    found = ablation("backbone.patch=[1,4],[2,4]", "seed_not=1", "stage=rectify,flow_map")
    assert found.variants == {
        f"{patch}, {stage}": [f"backbone.patch={patch}", "seed_not=1", f"stage={stage}"]
        for patch in ("[1,4]", "[2,4]")
        for stage in ("rectify", "flow_map")
    }
    assert found.swept == "backbone.patch, stage"
    assert found.seconds == 60 / 8
    assert len({run for runs in found.runs.values() for run in runs}) == 8


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (["backbone=hdit"], "nothing to compare"),
        (["seed=1,2"], "sets seed itself"),
        (["stage.learning_rate=1,2", "run_dir=x"], "sets run_dir itself"),
    ],
)
def test_what_an_ablation_cannot_compare_is_refused(keys, message):
    with pytest.raises(InputError, match=message):
        _ = ablation(*keys).variants


def test_scans_of_files_must_be_named():
    with pytest.raises(InputError, match="--real SCANS"):
        ablation("data=folder", "data.root=x", "stage.betas=[0,0],[0,1]").simulated()


def test_the_clock_s_seconds_survive_a_resumption():
    module = SimpleNamespace(device=torch.device("cpu"))
    clock = Clock()
    for images in (7, 2):
        clock.on_train_batch_start(None, module, None, 0)
        clock.on_train_batch_end(None, module, None, {"x_1": torch.ones(images, 1)})
    again = Clock()
    again.load_state_dict(clock.state_dict())
    assert (again.images, again.total) == (9, sum(clock.seconds))


def test_the_error_of_x_1_of_an_exact_flow_is_its_posterior_s_deviation():
    """x_1 ~ N(0, s^2), s = 0.5: E[x_1 | x_t] errs by s (1 - t) / sqrt((t s)^2 + (1 - t)^2), and
    v = (E[x_1 | x_t] - x_t) / (1 - t).
    """

    def velocity(t, x, condition=None):
        share = 0.25 * t / ((0.5 * t) ** 2 + (1 - t) ** 2)
        return (share - 1) * x / (1 - t)

    draws = torch.Generator().manual_seed(0)
    x_0, noise = torch.randn(2, 50, 2, 8, 64, generator=draws)
    squares = _squared_errors(SimpleNamespace(velocity=velocity), x_0, 0.5 * noise) / 50
    t = torch.tensor(TIMES, dtype=torch.float64)
    expected = (0.5 * (1 - t)).square() / ((0.5 * t).square() + (1 - t).square())
    torch.testing.assert_close(squares, expected, rtol=0.02, atol=0)


def groups(**values: list[float]) -> Groups:
    return {name: [{"distance in 1": value} for value in each] for name, each in values.items()}


@pytest.mark.parametrize(
    ("values", "level"),
    [
        # Standard errors are 1 / sqrt(3) = 0.577: intervals of 2 of them end 2.31 apart.
        ({"a": [1.0, 2.0, 3.0], "b": [3.3, 4.3, 5.3]}, ["a", "b"]),
        ({"a": [1.0, 2.0, 3.0], "b": [3.32, 4.32, 5.32]}, ["a"]),
        ({"a": [9.0, 9.0], "b": [1.0, 1.0], "c": [1.0, 1.5]}, ["b", "c"]),
        ({"a": [1.0], "b": [2.0]}, []),
    ],
)
def test_two_settings_differ_if_their_intervals_do_not_overlap(values, level):
    assert best(groups(**values), "distance in 1") == level


def test_things_are_judged_by_their_distance_from_the_real_value():
    real = {"cars, real": 3.0}
    found = {
        "few": [{"cars in 4": n, **real} for n in (0.9, 1.0, 1.1)],
        "many": [{"cars in 4": n, **real} for n in (4.9, 5.0, 5.1)],
        "right": [{"cars in 4": n, **real} for n in (2.9, 3.0, 3.1)],
    }
    assert best(found, "cars in 4") == ["right"]
    (row,) = table_rows(found)
    assert row == {
        "figure": "cars in 4",
        "few": "1 ± 0.06",
        "many": "5 ± 0.06",
        "right": "3 ± 0.06 *",
        "real": 3.0,
        "verdict": "",
    }


def test_a_setting_without_a_figure_is_left_out_of_its_comparison():
    found = {**groups(a=[1.0, 2.0], b=[1.5, 1.6]), "distilled": [{"bend": 0.0}]}
    assert [row["verdict"] for row in table_rows(found)] == ["no difference", ""]
    assert "distilled" not in conclusion(found, "distance in 1")


def test_no_difference_is_said_in_words():
    (row,) = table_rows(groups(a=[1.0, 2.0], b=[1.5, 1.6]))
    assert row["verdict"] == "no difference"
    assert conclusion(groups(a=[1.0, 2.0], b=[1.5, 1.6]), "distance in 1").endswith(
        "no difference: b."
    )


def test_an_ablation_ends_with_a_table_and_resumes(tmp_path, r2flow, quick_pictures):
    keys = [*TINY, "backbone.prediction=velocity,data"]
    command = ["ablate", *keys, "--budget", "1s", "--seeds", "1", "--num", "2"]
    command += ["--evaluations", "2", "--out", tmp_path / "out"]
    done = r2flow(*command)
    assert "Distance in 2: " in done.said
    rows = list(csv.DictReader((tmp_path / "out" / "ablation.csv").open()))
    assert [row["combination"] for row in rows] == ["velocity", "data"]
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    for row in rows:
        assert float(row["error of x_1, t = 0.5"]) > 0
    assert set(plan["steps"]) == {"velocity", "data"}
    again = r2flow(*command)
    assert "[1/2]" in done.said
    assert "[1/2]" not in again.said
    assert list(csv.DictReader((tmp_path / "out" / "ablation.csv").open())) == rows
    other = r2flow(*command[:-4], "--num", "2", "--budget", "2s", "--out", tmp_path / "out")
    assert "holds another ablation" in other.refusal
