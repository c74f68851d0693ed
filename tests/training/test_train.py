"""train.py as a user runs it: from a folder, with overrides."""

import csv
import os
import re
import shlex
import shutil
import signal
import warnings
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import yaml
from hydra.core.global_hydra import GlobalHydra
from r2flow.callbacks import Progress
from r2flow.callbacks.checkpoints import AtomicCheckpointIO

from r2flow.base.signals import LATER
from r2flow.lidar.scan_files import read_points, write_points
from r2flow.lidar.sensors import Sensor, write_sensor
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.paths import checkpoints_of, step_of
from r2flow.model.tensor_files import read_checkpoint
from r2flow.reports.outputs import what_next
from r2flow.reports.training import read_curves
from r2flow.runs.folder import read_config
from r2flow.runs.launch import job_folder
from tests.killing import wait_until
from tests.training.conftest import TINY, Run, hold_at, in_process, start, stop_held, tiny, wait_for


def weights(run: Path) -> tuple[dict, dict]:
    content = read_checkpoint(checkpoints_of(run)[0])
    return content["current_model_state"], content["state_dict"]


def assert_bit_equal(first: Path, second: Path) -> None:
    torch.testing.assert_close(weights(first), weights(second), rtol=0, atol=0)


def test_a_run_leaves_everything_in_its_folder_and_says_where(alone: tuple[Path, str]):
    run, said = alone
    for name in (
        "config.yaml",
        "loss.png",
        "samples/000000.ply",
        "samples/000000.npy",
        "samples/samples.png",
    ):
        assert (run / name).is_file(), name
    for words in (
        str(Path("runs/alone/checkpoints")),
        "loss.png",
        "000000.ply",
        "r2flow sample",
        "validation loss",
    ):
        assert words in said
    assert [p.name for p in checkpoints_of(run)] == ["step-00000012.ckpt", "step-00000010.ckpt"]
    loaded = load_checkpoint(run)
    assert loaded.step == 12
    written = yaml.safe_load((run / "config.yaml").read_text())
    assert loaded.config.stored == {
        **{key: written[key] for key in loaded.config.stored},
        "trainer": {"max_steps": 12},
    }


def test_next_is_what_has_not_been_done(alone: tuple[Path, str]):
    run, said = alone  # of a flow that was trained on scans in files
    assert f"r2flow train experiment=reflow stage.parent={run.relative_to(run.parents[1])}" in said
    for stage, parent, data, words in (
        ("rectify", None, "simulated", "data=kitti_raw data.root=FOLDER"),
        ("rectify", "street", "folder", "r2flow evaluate REAL a"),
        ("reflow", "b", "pairs", "experiment=distill stage.parent=a"),
        ("distill", "b", "pairs", "r2flow evaluate REAL a"),
    ):
        config = ModelConfig({"stage": {"name": stage, "parent": parent}, "data": {"name": data}})
        assert words in what_next(Path("a"), Path("a/samples"), config=config).splitlines()[-1]
    spaced = what_next(Path("a b"), Path("a b/samples"), config=config).split("r2flow ")[1:]
    assert [shlex.split(line)[1] for line in spaced] == ["a b", "a b/samples/000000.ply", "REAL"]
    plugged = {"stage": {"name": "rectify"}, "data": {"name": "folder"}, "plugins": ["mine.py"]}
    assert what_next(Path("a"), Path("a/samples"), config=ModelConfig(plugged)).endswith(
        "stage.parent=a --plugin mine.py"
    )


def test_a_finished_run_is_not_trained_again(train: Run, copied: Path):
    before = weights(copied)
    done = train("name=copied")
    assert "training 12/12" not in done.stderr  # the line of training's progress
    assert "checkpoint" in done.stdout
    assert "(noisy: of one batch)" in done.stdout
    torch.testing.assert_close(weights(copied), before, rtol=0, atol=0)


def test_a_run_from_weights_begins_with_their_validation_loss(
    train: Run, alone: tuple[Path, str], tmp_path: Path
):
    said = train(
        "name='a b'", f"stage.parent={alone[0]}", "loggers=[csv,tensorboard]", "trainer.max_steps=3"
    ).stdout
    assert "tensorboard --logdir 'runs/a b/tensorboard'\n" in said
    before, after = (
        read_curves(run)["val/loss"][1] for run in (alone[0], tmp_path / "runs" / "a b")
    )
    assert len(after) == 2
    assert after[0] == pytest.approx(before[-1], rel=1e-5)


def lines_of(said: str) -> list[str]:
    return [line for line in said.splitlines() if not line.startswith(("INFO", "WARNING", "step "))]


def test_a_killed_run_ends_as_the_one_left_alone(
    train: Run, alone: tuple[Path, str], scans: Path, tmp_path: Path
):
    # An epoch has 2 steps: it resumes from step 5, inside one.
    options = [
        "name=killed",
        "data.workers=2",
        "callbacks.checkpoint.every=5",
        *hold_at(6, tmp_path / "held"),
    ]
    stop_held(tmp_path / "held", signal.SIGKILL, tiny(scans, *options))
    assert "resuming from runs/killed/checkpoints/step-00000005.ckpt" in train(*options).stdout
    assert_bit_equal(alone[0], tmp_path / "runs" / "killed")


@pytest.mark.parametrize(
    ("by", "code"),
    [(signal.SIGTERM, 143), pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow)],
)
def test_a_run_told_to_stop_leaves_a_checkpoint_and_one_line(
    train, alone, scans, tmp_path, by, code
):
    options = ["name=stopped", "data.workers=2", "callbacks.checkpoint={every: 4, keep: 3}"]
    options += ["data.memory_gib=0", *hold_at(7, tmp_path / "held")]  # inside an epoch of 2 steps
    found, said = stop_held(tmp_path / "held", by, tiny(scans, *options))
    assert found == code, said
    assert lines_of(said) == [
        "stopped at step 7; the same command resumes from the last checkpoint"
    ]
    run = tmp_path / "runs" / "stopped"
    assert [step_of(path) for path in checkpoints_of(run)] == [7, 4]
    train(*options)
    assert [step_of(path) for path in checkpoints_of(run)] == [12, 8, 7]
    assert_bit_equal(alone[0], run)
    np.testing.assert_array_equal(*(read_curves(one)["train/loss"] for one in (alone[0], run)))


@pytest.mark.slow
def test_a_run_told_to_stop_before_its_first_step_says_one_line(scans: Path, tmp_path: Path):
    code, said = stop_held(
        tmp_path / "held", signal.SIGINT, tiny(scans, "name=early", *hold_at(0, tmp_path / "held"))
    )
    assert code == 130, said
    assert lines_of(said) == ["stopped; the same command starts it again: no checkpoint yet"]


def test_handlers_and_hydra_are_as_they_were(train: Run, tmp_path: Path):
    before = [
        signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
    ]
    filters = list(warnings.filters)
    train("name=quick", "trainer.max_steps=1", "samples.num=0")
    assert [
        signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR1)
    ] == before
    assert warnings.filters == filters
    assert not GlobalHydra.instance().is_initialized()


def test_odd_later_checkpoints_are_passed_over_and_set_aside(
    train: Run, alone: tuple[Path, str], copied: Path
):
    newest, older = checkpoints_of(copied)
    cut, whole = newest.read_bytes()[:1000], torch.load(newest, weights_only=True)
    newest.unlink()
    empty, unfinished, torn, pipe, folder = (
        newest.with_name(f"step-{step:08d}.ckpt") for step in range(13, 18)
    )
    torch.save({}, empty)
    torch.save({key: part for key, part in whole.items() if key != "optimizer_states"}, unfinished)
    torn.write_bytes(cut)
    os.mkfifo(pipe)
    folder.mkdir()
    assert f"resuming from {older.relative_to(copied.parents[1])}" in train("name=copied").stdout
    assert_bit_equal(alone[0], copied)
    assert checkpoints_of(copied) == [newest, older]
    # the pipe and the folder are not checkpoints
    assert len([*newest.parent.glob("*.damaged")]) == 3


def test_a_run_resumes_with_fewer_checkpoints(
    train: Run, tmp_path: Path, recwarn: pytest.WarningsRecorder
):
    command, run = (
        ["run_dir=run", "trainer.max_steps=8", "samples.num=0", "callbacks.requeue=null"],
        tmp_path / "run",
    )
    for options, kept in (
        ("keep=20", [8, 6, 4, 2]),
        ("keep=2", [8, 6]),
        ("keep=1", [8]),
        ("every=1", [8, 7]),
    ):
        train(*command, f"callbacks.checkpoint.{options}")
        assert [step_of(path) for path in checkpoints_of(run)] == kept
        checkpoints_of(run)[0].unlink()
    assert not [one for one in recwarn if "ckpt_path" in str(one.message)]


def test_another_config_in_the_same_folder_is_refused(train: Run, copied: Path):
    before = (copied / "config.yaml").read_text()
    assert (
        "runs/copied holds a run of another config: seed=0"
        in train("name=copied", "seed=5", check=False).refusal
    )
    checkpoints_of(copied)[0].unlink()  # not finished
    refusal = train("name=copied", "trainer.max_steps=5000", check=False).refusal
    assert (copied / "config.yaml").read_text() == before
    (init,) = re.findall(r"(stage\.parent=\S+) name=OTHER to learn on from its weights", refusal)
    train(init, "name=other", "trainer.max_steps=1")
    content = read_checkpoint(left := checkpoints_of(copied)[0])
    # as of a changed plug-in
    content["state_dict"]["generator.backbone.detokenizer.1.weight"] = torch.zeros(1)
    torch.save(content, left)
    refusal = train("name=copied", check=False).refusal
    assert "its weights do not fit its config: 'generator.backbone.detokenizer.1.weight'" in refusal


def test_a_folder_that_now_holds_other_scans_is_refused(
    train: Run, copied: Path, scans: Path, tmp_path: Path
):
    other = tmp_path / "other"
    shutil.copytree(scans, other)
    checkpoints_of(copied)[0].unlink()
    moved = train("name=copied", f"data.root={other}")  # the same scans elsewhere
    assert "resuming from" in moved.stdout + moved.stderr
    (other / "000005.bin").write_bytes(b"no scan")  # refused before it is read
    assert "scans=9 of 12 scans" in train("name=copied", f"data.root={other}", check=False).refusal


def test_a_sweep_runs_every_job_and_reports_the_failed(train: Run, tmp_path: Path):
    done = train("stage.loss=mse,nonsense", "trainer.max_steps=2", check=False, flags=("-m",))
    assert done.returncode == 2
    assert (
        done.stderr.count(
            f"jobs of the sweep failed: {tmp_path / 'runs' / 'sweep' / 'stage.loss=nonsense'}-"
        )
        == 1
    )
    assert "Error executing job" not in done.stderr
    (finished,) = (tmp_path / "runs" / "sweep").glob("*/samples")
    assert "mse" in finished.parent.name


def test_a_sweep_whose_jobs_reach_their_time_goes_on_with_the_same_command(
    train: Run, tmp_path: Path, monkeypatch
):
    job = "seed=1,2", "trainer.max_time=00:00:00:00", "trainer.max_steps=3", "samples.num=0"
    done = train(*job, check=False, flags=("-m",))
    assert done.returncode == LATER
    assert "jobs of the sweep resume with the same command: " in done.stdout
    assert "failed" not in done.stdout + done.stderr
    assert "stopped before a checkpoint was kept: the same command starts it again" in done.stdout
    mixed = train(*job, "stage.loss=mse,nonsense", check=False, flags=("-m",))
    assert mixed.returncode == 2
    assert "jobs of the sweep failed: " in mixed.stderr
    monkeypatch.setattr("r2flow.runs.launch.run_process", Mock(side_effect=[LATER, MemoryError]))
    assert (
        "out of memory"
        in in_process(tmp_path, ["-m", "backbone=glob(*_small)"], check=False).refusal
    )


def test_a_job_s_folder_names_what_is_swept():
    given = ["backbone.depths=[1,1],[1,2]", "loggers=[csv,wandb]", "seed=range(2)"]
    overrides = "backbone.depths=[1,2],loggers=[csv,wandb],seed=0"
    assert job_folder(given, overrides)[:-6] == "backbone.depths=_1_2_seed=0-"


@pytest.mark.parametrize("option", ["run_dir=here", "run_dir=a,b", "name=here"])
def test_a_sweep_refuses_one_folder_for_all_of_its_runs(train: Run, tmp_path: Path, option: str):
    done = train("seed=1,2", option, check=False, flags=("-m",))
    assert f"leave {option} out, or give hydra.sweep.dir=FOLDER" in done.refusal
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGHUP])
def test_a_killed_sweep_takes_its_job_with_it(scans: Path, tmp_path: Path, by: int):
    process = start(
        tmp_path,
        ["-m", *tiny(scans, "stage.loss=mse,pseudo_huber", *hold_at(3, tmp_path / "held"))],
    )
    wait_for(tmp_path / "held", process)
    (job,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    os.kill(process.pid, by)
    # Its output, into which the job writes too, ends when both are gone; the job would wait for a
    # minute.
    process.communicate(timeout=30)
    state = Path("/proc", job, "stat")
    # Z: nobody has asked for its exit code
    wait_until(lambda: not state.exists() or " Z " in state.read_text(), 10)


def test_a_run_shorter_than_the_interval_is_validated_at_its_end(train: Run):
    _, summary, progress = train("trainer.max_steps=1", "samples.num=0")
    assert "validation loss: " in summary
    assert "training 1/1 steps" in progress


def test_curves_and_checkpoints_are_of_optimiser_steps_also_after_a_stop(
    train: Run, tmp_path: Path, monkeypatch
):
    saved: list[int] = []
    save, update = AtomicCheckpointIO.save_checkpoint, Progress.on_train_batch_end

    def save_checkpoint(self, content, path, storage_options=None):
        saved.append(step_of(path))
        save(self, content, path, storage_options)

    def stop(self, trainer, *rest):  # as a callback does: once, in the first part of step 6
        trainer.should_stop |= (trainer.global_step, rest[-1] % 2) == (5, 0)
        update(self, trainer, *rest)

    monkeypatch.setattr(AtomicCheckpointIO, "save_checkpoint", save_checkpoint)
    command = [
        "trainer.accumulate_grad_batches=2",
        "samples.num=0",
        "callbacks.checkpoint.every=4",
        "run_dir=run",
    ]
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "on_train_batch_end", stop)
        assert train(*command, check=False).returncode == LATER
    train(*command)
    assert saved == [4, 6, 8, 12]
    files = (tmp_path / "run" / "metrics" / f"version_{n}" / "metrics.csv" for n in range(2))
    rows = [row for file in files for row in csv.DictReader(file.read_text().splitlines())]
    assert [int(row["step"]) for row in rows if row["lr-AdamW"]] == [*range(12)]
    assert [int(row["step"]) + 1 for row in rows if row["val/loss"]] == [3, 6, 9, 12]


def test_too_few_scans_for_a_share_of_the_validation_are_one_line(train: Run):
    assert "trainer: You requested" in train("trainer.limit_val_batches=0.1", check=False).refusal


def test_a_reader_that_cannot_start_is_one_line(train: Run, monkeypatch):
    monkeypatch.setattr(
        "multiprocessing.Process.start", Mock(side_effect=OSError(24, "Too many open files"))
    )
    assert train("data.workers=1", check=False).refusal == "error: Too many open files"
    (error := RuntimeError("of a plug-in")).__context__ = OSError(2, "what it was about")
    monkeypatch.setattr(Progress, "on_train_batch_end", Mock(side_effect=error))
    with pytest.raises(RuntimeError, match="of a plug-in"):
        train()


@pytest.mark.parametrize(
    ("precision", "kind"), [("bf16-mixed", torch.float32), ("64-true", torch.float64)]
)
def test_the_average_has_the_precision_of_the_weights(train: Run, tmp_path: Path, precision, kind):
    train(f"trainer.precision={precision}", "trainer.max_steps=4", "name=other")
    _, average = weights(tmp_path / "runs" / "other")
    assert {v.dtype for name, v in average.items() if name.endswith("weight")} == {kind}


def test_fast_dev_run_leaves_folders_as_they_were(train: Run, copied: Path, tmp_path: Path):
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    for name in ("quick", "copied"):
        train("trainer.fast_dev_run=true", f"name={name}")
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_a_run_out_of_time_goes_on_for_as_long_again(train: Run, tmp_path: Path):
    command = [
        "run_dir=run",
        "trainer.max_steps=100000",
        "trainer.max_time=00:00:00:02",
        "samples.num=0",
    ]
    reached = []
    for _ in range(2):
        assert train(*command, check=False).returncode == 75
        reached.append(step_of(checkpoints_of(tmp_path / "run")[0]))
    assert 0 < reached[0] < reached[1]


MINE = Sensor(
    "sparse",
    (3.0, 1.0, 0.0, -1.0, -2.5, -6.0, -12.0, -24.0),
    columns=64,
    min_range=2.0,
    firing=(7, *range(7)),
)


def test_a_sensor_of_one_s_own_trains_and_travels_in_the_checkpoint(scans: Path, tmp_path: Path):
    write_sensor(MINE, tmp_path / "conf" / "sensor" / "sparse.yaml", "a sensor of a test")
    small = [part for part in TINY if not part.startswith("sensor.")]
    options = [
        *small,
        f"data.root={scans}",
        "sensor=sparse",
        "name=own",
        "trainer.max_steps=1",
        "sampler.steps=1",
    ]
    in_process(tmp_path, ["--config-dir", str(tmp_path / "conf"), *options])
    shutil.rmtree(tmp_path / "conf")
    assert load_checkpoint(tmp_path / "runs" / "own").sensor == MINE


@pytest.mark.slow
def test_a_mixture_goes_on_where_it_stopped_and_may_move(train: Run, scans: Path, tmp_path: Path):
    for name, frames in (("a", range(0, 5)), ("b", range(5, 12))):
        (tmp_path / name).mkdir()
        for frame in frames:
            write_points(
                tmp_path / name / f"{frame:06d}.ply", read_points(scans / f"{frame:06d}.bin").xyz
            )

    def options(root_a: Path, name: str) -> list[str]:
        parts = f"[{{name: folder, root: {root_a}, weight: 3}}, {{name: folder, root: {tmp_path / 'b'}, weight: 1}}]"
        augment = "data.augment={flip: true, roll: true}"
        return [
            "data=mixed",
            f"data.parts={parts}",
            augment,
            "backbone.position=none",
            f"name={name}",
        ]

    train(*options(tmp_path / "a", "whole"))
    shutil.copytree(tmp_path / "runs/whole", tmp_path / "runs/stopped")
    checkpoints_of(tmp_path / "runs/stopped")[0].unlink()  # its end: it is left at step 10 of 12
    (tmp_path / "a").rename(tmp_path / "moved")
    assert (
        "resuming from" in train(*options(tmp_path / "moved", "stopped"), "data.workers=2").stdout
    )
    assert_bit_equal(tmp_path / "runs/whole", tmp_path / "runs/stopped")
    # The scans have no reflectance: nobody asked for a flow of range alone, and it is one.
    assert read_config(tmp_path / "runs/whole")["encoding"]["reflectance"] is False
    assert load_checkpoint(tmp_path / "runs/whole").encoding.channels == 1
    assert np.load(next((tmp_path / "runs/whole").rglob("*.npy"))).shape[0] == 1
