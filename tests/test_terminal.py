"""What reaches a terminal or a pipe, and how a program ends whose reader, locale or peer is gone."""

import os
import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from r2flow.callbacks import Stopping
from r2flow.callbacks.progress import Progress

import r2flow.training
from r2flow.base.errors import InputError
from r2flow.base.progress import Bar, track
from r2flow.base.signals import LATER, Stopped
from tests.conftest import CONFIG, make_stage
from tests.training.conftest import scans, tiny  # noqa: F401  a fixture

R2FLOW = [sys.executable, "-m", "r2flow"]


@pytest.mark.parametrize("channel", [os.pipe, pytest.param(os.openpty, marks=pytest.mark.slow)])
def test_a_training_outlives_the_reader_of_its_output(tmp_path: Path, scans: Path, channel):  # noqa: F811
    """As of `2>&1 | head -1`, or of a terminal that is closed."""
    more = ["trainer.max_steps=6", "callbacks.progress.seconds=0", "samples.num=0", "run_dir=run"]
    there, here = channel()
    with subprocess.Popen(
        [*R2FLOW, "train", *tiny(scans, *more)], cwd=tmp_path, stdout=here, stderr=here
    ) as process:
        os.close(here)
        assert os.read(there, 1)
        os.close(there)
    assert process.returncode == 0
    assert (tmp_path / "run" / "checkpoints" / "step-00000006.ckpt").is_file()


def test_a_config_file_that_contains_itself_is_one_line(tmp_path: Path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "loop.yaml").write_text("stage: &stage\n  time: *stage\n")
    command = [*R2FLOW, "train", "--config-dir", str(tmp_path), "experiment=loop"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)


@pytest.mark.parametrize(
    ("message", "peer", "kind", "words"),
    [
        ("[../third_party/gloo/pair.cc:534] Connection closed by peer [127.0.0.1]:42619", -9, Stopped, "resumes"),
        ("NCCL error: remote process exited or there was a network error", LATER, Stopped, "resumes"),
        ("Failed to recv, got 0 bytes. Connection was likely closed.", 2, InputError, "error"),
    ],
)  # fmt: skip
def test_a_lost_device_is_one_line(
    monkeypatch, tmp_path: Path, message: str, peer: int, kind: type, words: str
):
    """As torch.distributed says it in the remaining processes; one of them has launched the others."""
    fit, strategy = Mock(side_effect=RuntimeError(message)), Mock()
    strategy.launcher.procs = [Mock(wait=lambda timeout: peer)]
    trainer = SimpleNamespace(
        world_size=2, max_steps=4, is_global_zero=False, fit=fit, strategy=strategy
    )
    run = SimpleNamespace(
        trainer=trainer,
        folder=tmp_path,
        config=SimpleNamespace(plain=lambda: {"stage": {}}),
        data=Mock(),
        stage=make_stage(CONFIG),
    )
    monkeypatch.setattr(r2flow.training, "open_run", lambda *_, **__: None)
    with pytest.raises(kind, match=f"device ended.* {words}") as raised:
        r2flow.training._fit_in_folder(run, Stopping(tmp_path))
    assert getattr(raised.value, "code", 2) == (LATER if kind is Stopped else 2)
    trainer.world_size = 1
    with pytest.raises(RuntimeError, match="peer|NCCL|closed"):
        r2flow.training._fit_in_folder(run, Stopping(tmp_path))


def test_a_bar_goes_to_standard_error_with_count_unit_and_note(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    monkeypatch.setenv("COLUMNS", "120")
    with Bar("sampling", 4, "scans", shown=True) as bar:
        bar(3)
        bar.set(note="12 evaluations")
    out, err = capsys.readouterr()
    assert not out
    assert all(words in err for words in ("sampling", "3/4", "scans", "12 evaluations"))


def test_without_a_terminal_there_is_a_line_every_half_minute(capsys, monkeypatch):
    now = 100.0
    monkeypatch.setattr("r2flow.base.progress.time.monotonic", lambda: now)
    with Bar("completing", 300, "scans") as bar:
        bar.set(100)  # of an earlier run
        for _ in range(8):
            now += 10.0
            bar(5.2)
    # 15.6 scans in 30 s leave 184.4 for 5 min 55 s; 31.2 in 60 s leave 168.8 for 5 min 25 s
    lines = (
        "completing 115/300 scans  0.52/s  5:55 left\ncompleting 131/300 scans  0.52/s  5:25 left\n"
    )
    assert capsys.readouterr() == ("", lines)


@pytest.mark.parametrize("first", [True, False])
def test_the_first_process_of_a_training_writes_its_losses_and_scans_per_second(
    capsys, monkeypatch, first
):
    now = 100.0
    monkeypatch.setattr("r2flow.base.progress.time.monotonic", lambda: now)
    data = SimpleNamespace(batch_size=4)
    trainer: Any = SimpleNamespace(
        max_steps=17, global_step=10, is_global_zero=first, datamodule=data
    )
    trainer.estimated_stepping_batches = 17
    progress = Progress(seconds=15)
    progress.setup(trainer, Mock(), "fit")
    progress.on_train_start(trainer, Mock())  # resumed at step 10
    for step in range(11, 18):
        # two parts of a batch
        for seconds, trainer.global_step, loss in ((4.5, step - 1, 9.0), (0.5, step, 0.25)):
            now, trainer.progress_bar_metrics = now + seconds, {"train/loss": loss}
            progress.on_train_batch_end(trainer)
    progress.on_train_end(trainer)
    rows = ("13/17", "0:20"), ("16/17", "0:05"), ("17/17", "0:00")
    lines = "".join(
        f"training {at} steps  0.20/s  {left} left  loss 0.2500  0.8 scans/s\n" for at, left in rows
    )
    assert capsys.readouterr() == ("", lines * first)


@pytest.mark.parametrize(("total", "left"), [(64, "1:20"), (10**15, "694444444444:25:20")])
def test_several_processes_write_lines_on_a_terminal_too(capsys, monkeypatch, total, left):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    now = 100.0
    monkeypatch.setattr("r2flow.base.progress.time.monotonic", lambda: now)
    with Bar("process 2 of 8: drawing", total, "pairs", lines=True) as bar:
        for done in (16, 32):
            now += 40.0
            bar.set(done)
    assert capsys.readouterr() == (
        "",
        f"process 2 of 8: drawing 32/{total} pairs  0.40/s  {left} left\n",
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_what_is_printed_to_a_full_disk_is_one_line():
    with open("/dev/full", "w") as full:
        for verb in (["info"], ["train", "--help"]):
            done = subprocess.run([*R2FLOW, *verb], stdout=full, stderr=subprocess.PIPE, text=True)
            assert (done.returncode, done.stderr) == (
                2,
                "error: standard output: No space left on device\n",
            )
        assert (
            subprocess.run([*R2FLOW, "info"], stdout=subprocess.DEVNULL, stderr=full).returncode
            == 0
        )


def test_work_goes_on_where_standard_error_was_closed(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    assert list(track([1, 2], "reading")) == [1, 2]


BLOCK, TIMES = 64 << 20, 8
PROGRAM = f"""
import resource
from r2flow.base.memory import prepare_process

prepare_process()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({TIMES}):
    b"x" * {BLOCK}
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def new_pages(**settings: str) -> int:
    """Pages that the kernel had to give for a block that is taken and freed again and again."""
    own = {
        name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")
    } | settings
    return int(
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=own, capture_output=True, check=True
        ).stdout
    )


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_a_freed_block_is_used_again_without_new_pages():
    once = BLOCK // os.sysconf("SC_PAGE_SIZE")
    if new_pages(MALLOC_MMAP_THRESHOLD_="131072") < TIMES * once:
        pytest.skip("the kernel gives larger pages than it says")
    assert new_pages() < 1.1 * once
