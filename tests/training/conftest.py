"""A run small enough for a test: 8 x 64 images, a flow of a few thousand weights."""

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.base.signals import LATER
from r2flow.cli.verbs import run as run_verb
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import SENSORS
from r2flow.simulator import simulate
from r2flow.training import build, compose, fit
from tests.conftest import ROOT, Done, captured, draw_quickly
from tests.killing import wait_until

HOLDING = Path(__file__).with_name("holding.py")
COMMAND = [sys.executable, str(ROOT / "train.py")]

TINY = [
    "data=folder",
    "sensor.rows=8",
    "sensor.columns=64",
    "backbone.base_channels=8",
    "backbone.depths=[1,1]",
    "backbone.num_heads=[1,2]",
    "backbone.time_channels=16",
    "backbone.patch=[1,4]",
    "backbone.dropout=0.1",
    "data.batch_size=4",
    "data.validation.share=0.25",
    "stage.warmup_images=16",
    "trainer.accelerator=cpu",
    "trainer.max_steps=12",
    "trainer.val_check_interval=3",
    "trainer.log_every_n_steps=1",
    "callbacks.ema.every=2",
    "callbacks.checkpoint.every=2",
    "callbacks.pictures=null",
    "samples.num=1",
    "sampler.steps=2",
    "loggers=[csv]",
]


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, sensor = tmp_path_factory.mktemp("scans"), SENSORS["hdl64e"].resized(32, 256)
    for index in range(12):
        write_points(
            folder / f"{index:06d}.bin", *image_to_points(simulate(sensor, 0, index).image, sensor)
        )
    return folder


Run = Callable[..., Done]


def tiny(scans: Path, *overrides: str) -> list[str]:
    return [*TINY, f"data.root={scans}", *overrides]


def quickly(run: Callable[[], int | None]) -> Done:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as the processes of `start`, which are to end with the same bits
    try:
        with pytest.MonkeyPatch.context() as patch:
            draw_quickly(patch)
            return captured(run)
    finally:
        torch.set_num_threads(threads)


def in_process(cwd: Path, arguments: Sequence[str], check: bool = True) -> Done:
    with contextlib.chdir(cwd):
        done = quickly(lambda: run_verb(["train", *arguments], COMMAND))
    if check and done.returncode:
        raise AssertionError(
            f"{' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
        )
    return done


def job_in_process(command: Sequence[str]) -> int:
    """In place of `r2flow.runs.launch.run_process`: a job of a sweep without a process of its own."""
    overrides = command[len(COMMAND) :]
    try:
        return 0 if fit(build(compose(overrides), overrides)).finished else LATER
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run_train(
    cwd: Path, scans: Path, *overrides: str, check: bool = True, flags: tuple[str, ...] = ()
) -> Done:
    """The tiny run, a sweep's jobs too in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("r2flow.runs.launch.run_process", job_in_process)
        return in_process(cwd, [*flags, *tiny(scans, *overrides)], check)


def start(
    cwd: Path, arguments: Sequence[object], command: Sequence[str] = COMMAND, **environment: str
) -> subprocess.Popen[str]:
    """`train.py ARGUMENTS` or another command from a folder, as a process group of its own."""
    return subprocess.Popen(
        [*command, *map(str, arguments)], start_new_session=True, cwd=cwd, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, env={**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "another", **environment},
        # A shell's background job is started with Ctrl-C ignored, nohup's with SIGHUP, and hands
        # that on.
        preexec_fn=lambda: [signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)],
    )  # fmt: skip


def hold_at(step: int, file: Path, seconds: float = 60.0) -> list[str]:
    """Options by which a run writes a file at a step and waits to be told to stop, if not
    `let_go(file)` before.
    """
    return [
        f"--plugin={HOLDING}",
        f"+callbacks.hold={{file: {file}, step: {step}, seconds: {seconds}}}",
    ]


def let_go(file: Path) -> None:
    file.with_suffix(".go").touch()


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = 200.0) -> None:
    wait_until(lambda: path.exists() or process.poll() is not None, seconds)
    assert path.exists(), process.communicate()[0]


def stop_held(held: Path, by: int, command: list[str]) -> tuple[int, str]:
    """Start a run that waits (`hold_at`) and send its process group a signal there: (exit code,
    output).
    """
    process = start(held.parent, command)
    wait_for(held, process)
    os.killpg(process.pid, by)
    said, _ = process.communicate(timeout=100)
    let_go(held)
    return process.returncode, said


@pytest.fixture
def train(scans: Path, tmp_path: Path) -> Run:
    return functools.partial(run_train, tmp_path, scans)


@pytest.fixture(scope="session")
def alone(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    cwd = tmp_path_factory.mktemp("alone")
    return cwd / "runs" / "alone", run_train(cwd, scans, "name=alone").stdout


@pytest.fixture
def copied(alone: tuple[Path, str], tmp_path: Path) -> Path:
    return Path(shutil.copytree(alone[0], tmp_path / "runs" / "copied"))
