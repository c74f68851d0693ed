"""train.py as a user runs it: in a process, from a folder, with overrides."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml

from r2flow.checkpoints import checkpoints_of, load_checkpoint, read_checkpoint
from tests.training.conftest import ROOT, TINY, Run, run_train


def weights(run: Path) -> tuple[dict, dict]:
    """(raw, averaged) of the last checkpoint."""
    content = read_checkpoint(checkpoints_of(run)[0])
    return content["current_model_state"], content["state_dict"]


def assert_bit_equal(first: Path, second: Path) -> None:
    for a, b in zip(weights(first), weights(second), strict=True):
        assert a.keys() == b.keys()
        assert all(torch.equal(a[name], b[name]) for name in a)


def test_a_run_leaves_everything_in_its_folder_and_says_where(alone: tuple[Path, str]):
    run, said = alone
    for name in ("config.yaml", "loss.png", "samples/000000.ply", "samples/000000.npy", "samples/samples.png"):
        assert (run / name).is_file(), name
    for words in (str(Path("runs/alone/checkpoints")), "loss.png", "000000.ply", "r2flow sample", "val/loss"):
        assert words in said
    assert [p.name for p in checkpoints_of(run)] == ["step-00000012.ckpt", "step-00000010.ckpt"]
    loaded = load_checkpoint(run)
    assert loaded.step == 12
    assert loaded.config == yaml.safe_load((run / "config.yaml").read_text())


def test_a_finished_run_is_not_trained_again(train: Run, copied: Path):
    before = weights(copied)
    done = train("name=copied")
    assert "step 12/12" not in done.stdout  # the line of training's progress
    assert "checkpoint" in done.stdout
    assert all(torch.equal(a[name], b[name]) for a, b in zip(before, weights(copied), strict=True) for name in a)


def stop_when(
    run: Path, step: int, scans: Path, cwd: Path, *overrides: str, by: int = signal.SIGKILL
) -> tuple[int, str]:
    """Start the run and send it a signal once it has written the checkpoint of a step: (exit code, output)."""
    command = [sys.executable, str(ROOT / "train.py"), *TINY, f"data.root={scans}", *overrides]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=cwd, env=environment, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        # A shell's background job is started with Ctrl-C ignored, and hands that on.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    waited = time.monotonic()
    while not (run / "checkpoints" / f"step-{step:08d}.ckpt").exists():
        assert process.poll() is None, process.stdout and process.stdout.read().decode()
        assert time.monotonic() - waited < 200
        time.sleep(0.005)
    os.killpg(process.pid, by)
    said, _ = process.communicate(timeout=100)
    return process.returncode, said.decode()


@pytest.mark.parametrize(("step", "workers"), [pytest.param(2, 0, marks=pytest.mark.slow), (6, 2)])
def test_a_killed_run_ends_as_the_one_left_alone(
    train: Run, alone: tuple[Path, str], scans: Path, tmp_path: Path, step: int, workers: int
):
    killed = tmp_path / "runs" / "killed"
    stop_when(killed, step, scans, tmp_path, "name=killed", f"data.workers={workers}")
    train("name=killed", f"data.workers={workers}")
    assert_bit_equal(alone[0], killed)


@pytest.mark.slow
def test_a_run_killed_at_ten_random_moments_ends_as_the_one_left_alone(
    alone: tuple[Path, str], scans: Path, tmp_path: Path
):
    draw = random.Random(2)
    command = [sys.executable, str(ROOT / "train.py"), *TINY, f"data.root={scans}", "name=killed"]
    for _ in range(10):
        process = subprocess.Popen(
            command, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "1"}, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        time.sleep(draw.uniform(4, 8))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    run_train(tmp_path, scans, "name=killed")
    assert_bit_equal(alone[0], tmp_path / "runs" / "killed")


def test_ctrl_c_says_how_to_go_on(train: Run, scans: Path, tmp_path: Path):
    run = tmp_path / "runs" / "stopped"
    code, said = stop_when(run, 2, scans, tmp_path, "name=stopped", "trainer.max_steps=500", by=signal.SIGINT)
    assert code == 130
    assert "the same command goes on from the last checkpoint" in said
    assert "Traceback" not in said


def test_a_damaged_last_checkpoint_is_passed_over(train: Run, alone: tuple[Path, str], copied: Path):
    newest = checkpoints_of(copied)[0]
    newest.write_bytes(newest.read_bytes()[:1000])
    done = train("name=copied")
    assert "Passing it over" in done.stdout + done.stderr
    assert_bit_equal(alone[0], copied)


def test_a_moved_run_goes_on(train: Run, alone: tuple[Path, str], copied: Path):
    moved = copied.rename(copied.parent / "moved")
    checkpoints_of(moved)[0].unlink()  # as if killed before the last step
    train("name=moved")
    assert_bit_equal(alone[0], moved)


def test_another_config_in_the_same_folder_is_refused(train: Run, copied: Path):
    before = (copied / "config.yaml").read_text()
    done = train("name=copied", "seed=5", check=False)
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("error: runs/copied holds a run of another config: seed=0")
    assert (copied / "config.yaml").read_text() == before


def test_a_folder_that_now_holds_other_scans_is_refused(train: Run, copied: Path, scans: Path, tmp_path: Path):
    other = tmp_path / "other"
    shutil.copytree(scans, other)
    checkpoints_of(copied)[0].unlink()
    moved = train("name=copied", f"data.root={other}")  # the same scans elsewhere
    assert "going on from" in moved.stdout + moved.stderr
    (other / "000000.bin").rename(other / "another.bin")
    done = train("name=copied", f"data.root={other}", check=False)
    assert done.returncode == 2
    assert "scans=9 of 12 scans" in done.stderr


def test_a_sweep_runs_every_job_and_reports_the_failed(train: Run, tmp_path: Path):
    done = train("stage.loss=mse,nonsense", "trainer.max_steps=2", check=False, flags=("-m",))
    assert done.returncode == 2
    assert "1 of the sweep's jobs failed" in done.stderr
    finished = {path.parent.name for path in (tmp_path / "runs" / "sweep").glob("*/samples")}
    assert len(finished) == 1
    assert "mse" in finished.pop()


@pytest.mark.parametrize("precision", ["bf16-mixed"])
def test_mixed_precision_trains(train: Run, tmp_path: Path, precision: str):
    train(f"trainer.precision={precision}", "trainer.max_steps=4", "name=half")
    assert all(v.dtype == torch.float32 for v in weights(tmp_path / "runs" / "half")[1].values())


def test_fast_dev_run_leaves_nothing(train: Run, tmp_path: Path):
    train("trainer.fast_dev_run=true", "name=quick")
    assert list(tmp_path.iterdir()) == []


def test_fast_dev_run_leaves_a_run_as_it_was(train: Run, copied: Path):
    before = {path: path.stat().st_mtime_ns for path in copied.rglob("*")}
    train("trainer.fast_dev_run=true", "name=copied")
    assert {path: path.stat().st_mtime_ns for path in copied.rglob("*")} == before
