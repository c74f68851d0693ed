"""Many processes, half precision, SLURM and sweeps on a cluster: the same run, however it is
spread.
"""

import json
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from lightning.pytorch.utilities import rank_zero_only
from r2flow.callbacks.stopping import slurm_job

from r2flow.base.errors import InputError
from r2flow.base.signals import LATER
from r2flow.model.paths import checkpoints_of
from r2flow.model.tensor_files import read_checkpoint
from r2flow.training import build, compose
from tests.training.conftest import TINY, Run, hold_at, start, tiny, wait_for
from tests.training.test_train import assert_bit_equal, weights

STEPS = 20
# dropout's masks are drawn per device batch
EXACT = [f"trainer.max_steps={STEPS}", "backbone.dropout=0"]
TWO = ["trainer.devices=2", "trainer.strategy=ddp"]


def recorded(
    cwd: Path,
    scans: Path,
    record: Path,
    *overrides: str,
    code: int = 0,
    broken: tuple[int, ...] = (),
) -> subprocess.CompletedProcess[str]:
    recorder = str(Path(__file__).with_name("recorder.py"))
    command = [
        sys.executable,
        recorder,
        *TINY,
        f"data.root={scans}",
        *overrides,
        "+callbacks.recorder={}",
    ]
    environment = {
        **os.environ, "OMP_NUM_THREADS": "1", "R2FLOW_RECORD": str(record), "R2FLOW_BROKEN": json.dumps(broken),
    }  # fmt: skip
    record.mkdir(exist_ok=True)
    done = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done


def losses(record: Path) -> dict[int, float]:
    """The global batch's loss by step: the mean over ranks, whose shares are of one size."""
    ranks = [json.loads(path.read_text()) for path in sorted(record.glob("losses-*.json"))]
    assert len({tuple(rank) for rank in ranks}) == 1
    return {int(step): float(np.mean([rank[step] for rank in ranks])) for step in ranks[0]}


@pytest.fixture(scope="module")
def one(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cwd = tmp_path_factory.mktemp("one")
    recorded(cwd, scans, cwd / "record", "name=one", *EXACT)
    return cwd


@pytest.fixture(scope="module")
def two(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cwd = tmp_path_factory.mktemp("two")
    done = recorded(cwd, scans, cwd / "record", "name=two", *EXACT, *TWO)
    said = [line for line in (done.stdout + done.stderr).splitlines() if line]
    assert len(said) == len(set(said))  # once, not by each process
    return cwd


def test_two_processes_have_the_losses_of_one(one: Path, two: Path):
    alone, together = losses(one / "record"), losses(two / "record")
    assert list(alone) == list(together) == list(range(1, STEPS + 1))
    assert max(abs(alone[step] - together[step]) for step in alone) < 1e-5
    # Both learn: otherwise equal losses would say little.
    assert np.mean([alone[s] for s in range(16, 21)]) < np.mean([alone[s] for s in range(1, 6)])


def test_two_processes_share_one_average_and_one_writes(one: Path, two: Path):
    average = [json.loads((two / "record" / f"average-{rank}.json").read_text()) for rank in (0, 1)]
    assert average[0] == average[1]
    assert {path.name.split("-")[1] for path in (two / "record").glob("wrote-*")} == {"0"}
    assert [p.name for p in checkpoints_of(two / "runs" / "two")] == [
        "step-00000020.ckpt",
        "step-00000018.ckpt",
    ]
    torch.testing.assert_close(
        weights(one / "runs" / "one"), weights(two / "runs" / "two"), rtol=0, atol=1e-4
    )


@pytest.mark.slow
def test_a_run_goes_on_in_more_processes(one: Path, scans: Path, tmp_path: Path):
    # Killed at the end of step 18 in one process; steps 19 and 20 in two.
    shutil.copytree(one / "runs", tmp_path / "runs")
    checkpoints_of(tmp_path / "runs" / "one")[0].unlink()
    recorded(tmp_path, scans, tmp_path / "record", "name=one", *EXACT, *TWO)
    alone, resumed = losses(one / "record"), losses(tmp_path / "record")
    assert list(resumed) == [19, 20]
    assert all(abs(alone[step] - resumed[step]) < 1e-5 for step in resumed)
    torch.testing.assert_close(
        weights(one / "runs" / "one"), weights(tmp_path / "runs" / "one"), rtol=0, atol=1e-5
    )


@pytest.mark.slow
def test_a_defect_on_one_device_is_skipped_and_ends_on_all(scans: Path, tmp_path: Path):
    # Batches of 4 over two ranks: odd images are rank 1's. Images 9, 13 and 17 break steps 3, 4 and
    # 5.
    done = recorded(tmp_path, scans, tmp_path, "name=broken", *EXACT, *TWO, "callbacks.guard.skips=3",
                    code=2, broken=(9, 13, 17))  # fmt: skip
    errors = [line for line in done.stderr.splitlines() if line.startswith("error:")]
    assert (
        "stopped at step 5: steps skipped in a row for a non-finite loss or gradient: 3"
        in errors[0]
    )
    assert "images k = 16 to 19" in errors[0]
    assert len(set(errors)) == 1
    states = [read_checkpoint(path) for path in checkpoints_of(tmp_path / "runs" / "broken")]
    assert [state["global_step"] for state in states] == [4, 2]
    for name, value in states[0]["current_model_state"].items():
        assert torch.equal(value, states[1]["current_model_state"][name])


@pytest.mark.slow
def test_accumulated_batches_have_the_losses_of_the_whole(one: Path, scans: Path, tmp_path: Path):
    recorded(tmp_path, scans, tmp_path, "name=parts", *EXACT, "trainer.accumulate_grad_batches=2",
             "trainer.val_check_interval=20")  # fmt: skip
    whole, parts = losses(one / "record"), losses(tmp_path)
    assert whole.keys() == parts.keys()
    assert max(abs(whole[step] - parts[step]) for step in whole) < 1e-5


def srun(
    cwd: Path,
    scans: Path,
    *overrides: str,
    tasks: int = 1,
    leave_after: Path | None = None,
    apart: bool = False,
) -> list[tuple[int, str]]:
    """(exit code, output) of every task of the tiny run as srun starts it, with a `scontrol` that
    notes what it gets; the last task is sent SIGUSR1 when the file `leave_after` is there; `apart`:
    in folders a and b.
    """
    scontrol = cwd / "bin" / "scontrol"
    scontrol.parent.mkdir(exist_ok=True)
    scontrol.write_text(f'#!/bin/sh\necho "$@" >> {cwd}/scontrol.log\n')
    scontrol.chmod(scontrol.stat().st_mode | stat.S_IXUSR)
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    environment = {
        "PATH": f"{cwd}/bin:{os.environ['PATH']}", "MASTER_PORT": str(port),
        "SLURM_JOB_ID": "4711", "SLURM_JOB_NAME": "flow", "SLURM_NODEID": "0", "SLURM_NNODES": "1",
        "SLURM_NODELIST": "localhost", "SLURM_NTASKS": str(tasks), "SLURM_NTASKS_PER_NODE": str(tasks),
    }  # fmt: skip
    started = [
        start(
            cwd / folder,
            tiny(scans, *overrides),
            **environment,
            SLURM_PROCID=str(task),
            SLURM_LOCALID=str(task),
        )
        for task, folder in zip(range(tasks), "ab" if apart else "..", strict=False)
    ]
    if leave_after:
        wait_for(leave_after, started[-1])
        os.killpg(started[-1].pid, signal.SIGUSR1)  # its loader's workers get it too, as from SLURM
    said = [process.communicate(timeout=200)[0] for process in started]
    return [(process.returncode, words) for process, words in zip(started, said, strict=True)]


@pytest.mark.slow
def test_a_job_told_to_leave_is_queued_again_and_ends_as_the_one_left_alone(alone, scans, tmp_path):
    run = tmp_path / "runs" / "queued"
    command = ["name=queued", "data.workers=1", *hold_at(4, tmp_path / "held")]
    [(code, said)] = srun(tmp_path, scans, *command, leave_after=tmp_path / "held")
    assert code == LATER, said
    assert (tmp_path / "scontrol.log").read_text() == "requeue 4711\n"
    assert [read_checkpoint(path)["global_step"] for path in checkpoints_of(run)] == [4, 2]
    assert "stopped at step 4; the same command resumes" in said
    assert not list(run.rglob("hpc_ckpt*"))  # Lightning's own, which nothing would remove or read
    [(code, said)] = srun(tmp_path, scans, *command)
    assert code == 0, said
    assert "step-00000004.ckpt" in said[said.index("resuming from") :].splitlines()[0]
    assert_bit_equal(alone[0], run)
    assert [p.name for p in checkpoints_of(run)] == ["step-00000012.ckpt", "step-00000010.ckpt"]


@pytest.mark.slow
def test_two_tasks_leave_together_when_one_is_told_to(one: Path, scans: Path, tmp_path: Path):
    run = tmp_path / "runs" / "queued"
    command = [
        "name=queued",
        *EXACT,
        *TWO,
        "callbacks.requeue.every=2",
        *hold_at(3, tmp_path / "held", seconds=5.0),
    ]
    for code, said in srun(tmp_path, scans, *command, tasks=2, leave_after=tmp_path / "held"):
        assert code == LATER, said
    assert (tmp_path / "scontrol.log").read_text() == "requeue 4711\n"
    assert len(checkpoints_of(run)) == 2
    assert read_checkpoint(checkpoints_of(run)[0])["global_step"] < STEPS
    for code, said in srun(tmp_path, scans, *command, tasks=2):
        assert code == 0, said
    torch.testing.assert_close(weights(one / "runs" / "one"), weights(run), rtol=0, atol=1e-4)


@pytest.mark.slow
def test_machines_whose_run_folders_differ_do_not_train(alone, scans: Path, tmp_path: Path):
    run = Path(shutil.copytree(alone[0], tmp_path / "a" / "runs" / "alone"))
    checkpoints_of(run)[0].unlink()
    (tmp_path / "b").mkdir()
    for task, (code, said) in enumerate(
        srun(tmp_path, scans, "name=alone", *TWO, tasks=2, apart=True)
    ):
        assert code == 2, said
        assert f"process {task} starts from step {(10, 0)[task]}, on 9 of 12 scans" in said


@pytest.mark.slow
def test_two_processes_of_which_one_is_told_to_stop_leave_together(scans: Path, tmp_path: Path):
    held = tmp_path / "held"
    options = [
        "name=stopped",
        *EXACT,
        *TWO,
        "callbacks.requeue.every=2",
        *hold_at(5, held, seconds=5.0),
    ]
    process = start(tmp_path, tiny(scans, *options))
    wait_for(held, process)
    process.send_signal(signal.SIGTERM)  # to the launching process alone
    said, _ = process.communicate(timeout=100)
    assert process.returncode == 143, said
    assert said.count("stopped at step 6; the same command resumes from the last checkpoint") == 1
    assert "Traceback" not in said
    assert read_checkpoint(checkpoints_of(tmp_path / "runs" / "stopped")[0])["global_step"] == 6


@pytest.mark.slow
def test_a_run_that_waits_for_another_machine_ends_when_told_to(scans: Path, tmp_path: Path):
    process = start(
        tmp_path, tiny(scans, "name=waits", "trainer.num_nodes=2", "trainer.strategy=ddp")
    )
    try:
        wait_for(tmp_path / "runs" / "waits" / "config.yaml", process)
        time.sleep(5)  # in which it begins to wait
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == -signal.SIGTERM
    finally:
        process.kill()


@pytest.mark.parametrize(
    ("variables", "job"),
    [
        ({}, None),
        ({"SLURM_JOB_ID": "12"}, "12"),
        ({"SLURM_JOB_ID": "15", "SLURM_ARRAY_JOB_ID": "12", "SLURM_ARRAY_TASK_ID": "3"}, "12_3"),
        ({"SLURM_JOB_ID": "12", "SLURM_JOB_NAME": "interactive"}, None),
    ],
)
def test_what_is_queued_again_is_named_as_scontrol_names_it(
    variables: dict[str, str], job: str | None
):
    with patch.dict(os.environ, variables, clear=True):
        assert slurm_job() == job


def test_tasks_of_a_job_train_together_or_alone(scans: Path):
    slurm = dict.fromkeys(("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NODEID"), "0") | {
        "SLURM_NTASKS": "1"
    }
    # Lightning's SLURM_PROCID
    with patch.dict(os.environ, slurm), patch.object(rank_zero_only, "rank", 3):
        build(compose(tiny(scans)))
        assert rank_zero_only.rank == 0  # else it has no curves
        # it would train on one device
        with pytest.raises(InputError, match="1 of 2 .* srun --ntasks-per-node=2"):
            build(compose(tiny(scans, *TWO)))


@pytest.mark.slow
def test_a_sweep_through_submitit_runs_every_job_and_reports_a_failed_one(
    train: Run, tmp_path: Path
):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs the extra 'slurm'")
    launcher = ["hydra/launcher=submitit_local", "trainer.max_steps=2"]
    done = train(*launcher, "stage.loss=mse,nonsense", check=False, flags=("-m",))
    assert done.returncode == 2
    assert (
        f"jobs of the sweep failed: {tmp_path / 'runs' / 'sweep' / 'stage.loss=nonsense'}-"
        in done.stderr
    )
    (finished,) = (tmp_path / "runs" / "sweep").glob("*/samples")
    # named by what is swept although another process made it
    assert "stage.loss=mse" in finished.parent.name
    assert train(*launcher, "stage.loss=mse", flags=("-m",)).returncode == 0
