"""`r2flow report completion`: what is hidden, who answers, what is written."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.cli import main
from r2flow.errors import InputError
from r2flow.generators import Generated, build_generator
from r2flow.lidar.interpolation import OPPONENTS, guess
from r2flow.lidar.known import Ray
from r2flow.metrics.completion import errors
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.completion import Way, completion_rows, given_by, ways_of
from tests.stages.test_conditional import CONFIG


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    config = {**CONFIG, "generator": {"name": "conditional_flow"}}
    return Checkpoint(build_generator(config).eval(), config)


@pytest.fixture(scope="module")
def truths() -> list[np.ndarray]:
    random = np.random.default_rng(0)
    images = np.stack([random.uniform(2, 70, (3, 8, 32)), random.random((3, 8, 32))], 1).astype(np.float32)
    return list(images * (random.random((3, 1, 8, 32)) > 0.2))


def test_a_model_that_knows_the_truth_has_no_error_and_one_that_is_off_has_that(checkpoint, truths, monkeypatch):
    sensor, encoding, by = checkpoint.sensor, checkpoint.encoding, 0.0
    stacked = torch.from_numpy(np.stack(truths))

    def answer(noise, condition, **_):
        moved = torch.where(stacked[:, :1] > 0, (stacked[:, :1] + by).clamp(max=79.9), 0)
        return Generated.after(encoding.encode(torch.cat([moved, stacked[:, 1:]], 1)), 7)

    monkeypatch.setattr(checkpoint.generator, "generate", answer)
    ways = [Way("truth", checkpoint, {"method": "euler", "steps": 7})]
    options = {"tasks": ["rows:4"], "answers": 1, "batch_size": 3}
    *plain, (row, _) = completion_rows(truths, sensor, ways, **options)
    assert [one["method"] for one, _ in plain] == list(OPPONENTS)
    assert row["evaluations"] == 7
    assert row["mae_m"] == pytest.approx(0, abs=1e-4)
    assert (row["drop_wrong"], row["panel"]) == (0, pytest.approx(0, abs=1e-3))
    by = 0.5
    row, _ = list(completion_rows(truths, sensor, ways, **options))[-1]
    assert row["mae_m"] == pytest.approx(0.5, abs=1e-3)
    hidden = [given_by("rows:4", x, sensor, i).asked for i, x in enumerate(truths)]
    shares = np.mean([(x[0] > 0)[h].sum() / x[0].size for x, h in zip(truths, hidden, strict=True)])
    assert row["mae_all_m"] == pytest.approx(0.5 * shares, rel=1e-3)  # all pixels, known ones without error


def test_interpolations_are_judged_as_any_answer(checkpoint, truths):
    rows = {row["method"]: row for row, _ in completion_rows(truths, checkpoint.sensor, [], ["points:0.3"])}
    expected = []
    for number, truth in enumerate(truths):
        given = given_by("points:0.3", truth, checkpoint.sensor, number)
        known = np.where(given.asked, 0, truth[0])
        assert (given.image[0] == known).all()
        expected.append(errors(truth, guess(truth, ~given.asked), given.asked, checkpoint.sensor)["mae_m"])
    assert rows["linear, 1/r"]["mae_m"] == pytest.approx(np.mean(expected), rel=1e-4)


def test_a_fault_gives_a_measurement_that_nobody_trusts(checkpoint, truths):
    given = given_by("lost", truths[0], checkpoint.sensor, 0)
    assert (given.state == Ray.DOUBTFUL).all()
    assert given.asked.all()
    assert 0 < ((truths[0][0] > 0) & (given.image[0] == 0)).mean() < 0.4
    names = [row["method"] for row, _ in completion_rows(truths, checkpoint.sensor, [], ["lost"])]
    assert names == ["as it is"]


def test_what_is_hidden_depends_on_the_scan_s_number_alone(checkpoint, truths):
    one, again, other = (given_by("points:0.5", truths[0], checkpoint.sensor, i).asked for i in (0, 0, 1))
    assert (one == again).all()
    assert (one != other).any()


@pytest.mark.parametrize("task", ["rows:1", "points:0", "rain:2", "nothing"])
def test_a_task_that_is_none_is_one_line(checkpoint, truths, task):
    with pytest.raises(InputError) as caught:
        given_by(task, truths[0], checkpoint.sensor, 0)
    assert "\n" not in str(caught.value)


def test_a_model_is_run_by_every_solver_and_number_of_steps(checkpoint):
    names = [way.name for way in ways_of(checkpoint, "street", ["euler", "midpoint"], [2, 4])]
    assert names == ["street, euler 2", "street, euler 4", "street, midpoint 2", "street, midpoint 4"]
    assert [way.name for way in ways_of(checkpoint, "street")] == ["street, adams3 16"]
    own = ways_of(checkpoint, "street", ["euler/3", "midpoint"], [5])
    assert [way.name for way in own] == ["street, euler 3", "street, midpoint 5"]
    with pytest.raises(InputError, match="behind a slash"):
        ways_of(checkpoint, "street", ["euler/x"])


def test_the_verb_writes_a_page_with_its_picture(checkpoint, tmp_path: Path, monkeypatch):
    checkpoint.save(tmp_path / "model.safetensors")
    out = tmp_path / "out"
    monkeypatch.setattr("sys.argv", [
        "r2flow", "report", "completion", "simulated:3", "-c", str(tmp_path / "model.safetensors"), "--num", "2",
        "--answers", "2", "--solvers", "euler/1,mmps:1,0/1", "--tasks", "rows:4 rain", "--out", str(out),
    ])  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert (out / "completion.png").stat().st_size > 10_000
    rows = json.loads((out / "completion.json").read_text())["rows"]
    ways = "model, euler 1", "model, mmps:1,0 1"
    assert [row["method"] for row in rows] == [*OPPONENTS, *ways, "as it is", *ways]
    assert "coverage" in (out / "completion.md").read_text()
