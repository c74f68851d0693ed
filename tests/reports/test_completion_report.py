"""`r2flow report completion`: what is hidden, who answers, what is written."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from r2flow.generators import Generated, build_generator
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.completion import errors
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.completion import INTERPOLATIONS, completion_rows, kept_rays
from r2flow.samplers import build_sampler
from r2flow.simulator import simulate
from r2flow.simulator.folder import SimulatedFolder
from tests.conftest import CONFIG as FLOW
from tests.conftest import refused
from tests.simulator.test_folder import write_folder
from tests.stages.test_transfer_flow import CONFIG

pytestmark = pytest.mark.usefixtures("quick_pictures")


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    config = {**CONFIG, "generator": {"name": "transfer_flow"}}
    return Checkpoint(build_generator(config).eval(), config)


@pytest.fixture(scope="module")
def truths() -> list[np.ndarray]:
    random = np.random.default_rng(0)
    images = np.stack([random.uniform(2, 70, (3, 8, 32)), random.random((3, 8, 32))], 1).astype(
        np.float32
    )
    return list(images * (random.random((3, 1, 8, 32)) > 0.2))


def test_a_model_that_knows_the_truth_has_no_error_and_one_that_is_off_has_that(
    checkpoint, truths, monkeypatch
):
    sensor, encoding, by = checkpoint.sensor, checkpoint.encoding, 0.0
    scan = iter(torch.from_numpy(np.stack([*truths, *truths])))

    def answer(self, noise, condition, **_):
        truth = next(scan)[None]
        moved = torch.where(truth[:, :1] > 0, (truth[:, :1] + by).clamp(max=79.9), 0)
        return Generated.after(encoding.encode(torch.cat([moved, truth[:, 1:]], 1)), 7)

    monkeypatch.setattr(type(checkpoint.generator), "forward", answer)
    ways = {"truth": (checkpoint, build_sampler("euler", steps=7))}
    *plain, row = completion_rows(truths, sensor, ways, ["rows:4"], 1)
    assert [one["method"] for one in plain] == list(INTERPOLATIONS)
    assert row["evaluations"] == 7
    assert row["mae_m"] == pytest.approx(0, abs=1e-4)
    assert (row["drop_wrong"], row["panel"]) == (0, pytest.approx(0, abs=1e-3))
    by = 0.5
    row = list(completion_rows(truths, sensor, ways, ["rows:4"], 1))[-1]
    assert (row["mae_m"], row["mae_common_m"]) == pytest.approx((0.5, 0.5), abs=1e-3)
    hidden = [~kept_rays("rows:4", sensor, i) for i in range(3)]
    shares = np.mean([(x[0] > 0)[h].sum() / x[0].size for x, h in zip(truths, hidden, strict=True)])
    # all pixels, known ones without error
    assert row["mae_all_m"] == pytest.approx(0.5 * shares, rel=1e-3)


def test_interpolations_are_judged_as_any_answer(checkpoint, truths):
    config = {**checkpoint.config.stored, "encoding": {**CONFIG["encoding"], "reflectance": False}}
    ways = {
        "range": (Checkpoint(build_generator(config).eval(), config), checkpoint.generator.sampler)
    }
    rows = {
        row["method"]: row
        for row in completion_rows(truths, checkpoint.sensor, ways, ["points:0.3"])
    }
    of_range = next(
        completion_rows([truth[:1] for truth in truths], checkpoint.sensor, {}, ["points:0.3"])
    )
    assert rows["nearest"]["panel"] == of_range["panel"]  # means of the lines that every method has
    known = [
        (x, kept_rays("points:0.3", checkpoint.sensor, number)) for number, x in enumerate(truths)
    ]
    expected = [
        errors(x, interpolated(x, mask), ~mask, checkpoint.sensor)["mae_m"] for x, mask in known
    ]
    assert rows["linear, 1/r"]["mae_m"] == pytest.approx(np.mean(expected), rel=1e-4)


def test_what_is_hidden_depends_on_the_scan_s_number_alone(checkpoint):
    one, again, other = (kept_rays("points:0.5", checkpoint.sensor, i) for i in (0, 0, 1))
    assert (one == again).all()
    assert (one != other).any()


@pytest.mark.parametrize("task", ["rows:1", "points:0", "rain:2", "nothing"])
def test_a_task_that_is_none_is_one_line(checkpoint, task):
    with refused():
        kept_rays(task, checkpoint.sensor, 0)


def test_the_verb_writes_a_page(r2flow, checkpoint, tmp_path: Path):
    checkpoint.save(tmp_path / "model.safetensors")
    said = r2flow(
        "report", "completion", "simulated:3", tmp_path / "model.safetensors", "--num", 2, "--answers", 2,
        "--sampler", "jump", "--steps", 1, "--tasks", "rows:4,rows:2", "--out", (out := tmp_path / "out"),
    ).said  # fmt: skip
    assert said.startswith("2 scans of simulated:3 (at most 2, --num), 2 completions per scan. ")
    rows = json.loads((out / "completion.json").read_text())["rows"]
    assert [row["method"] for row in rows] == 2 * [
        *INTERPOLATIONS,
        "model.safetensors, jump, 1 step",
    ]
    assert "coverage" in (out / "completion.md").read_text()


def test_a_densifier_takes_a_flow_s_size_and_range_alone_has_no_reflectance(
    r2flow, checkpoint, tmp_path: Path
):
    flow = Checkpoint(build_generator(FLOW).eval(), FLOW)
    models = tmp_path / "dense" / "model.safetensors", tmp_path / "flow" / "model.safetensors"
    checkpoint.save(models[0])
    flow.save(models[1])
    np.save(tmp_path / "scan.npy", simulate(flow.sensor, 3, 0).image[:1])
    asked = tmp_path / "scan.npy", *models, "--tasks", "rows:2", "--out", tmp_path / "out"
    assert r2flow("report", "completion", *asked).said
    rows = json.loads((tmp_path / "out" / "completion.json").read_text())["rows"]
    assert [row["method"][:5] for row in rows[-2:]] == ["dense", "flow/"]
    assert [row["evaluations"] for row in rows[-2:]] == [1, 30]
    assert all(math.isfinite(row["panel"]) and "reflectance_mae" not in row for row in rows)
    assert "reflectance MAE" not in (tmp_path / "out" / "completion.md").read_text()


# the folder's manifest, or options
@pytest.mark.parametrize("given", [(), ("--sensor", "vlp16", "--size", "8x96")])
def test_a_densifier_is_measured_on_the_sensor_of_the_scans(
    r2flow, checkpoint, tmp_path: Path, given
):
    checkpoint.save(tmp_path / "model.safetensors")
    sensor = SENSORS["vlp16"].resized(8, 96)
    truth = simulate(sensor, 3, 500 if given else 0).image  # the middle of 1000 scenes
    if not given:
        write_folder(SimulatedFolder(tmp_path / "scans", sensor, 3, ["npy"]), range(1), workers=1)
    assert r2flow(
        "report", "completion", "simulated:3" if given else tmp_path / "scans", tmp_path / "model.safetensors",
        "--num", 1, "--tasks", "rows:2", "--out", tmp_path / "out", *given,
    ).said  # fmt: skip
    *_, row = json.loads((tmp_path / "out" / "completion.json").read_text())["rows"]
    ways = {"model": (checkpoint.through(sensor), checkpoint.generator.sampler)}
    *_, expected = completion_rows([truth], sensor, ways, ["rows:2"], 1)
    assert row["mae_m"] == pytest.approx(expected["mae_m"])
