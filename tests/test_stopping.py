"""Ctrl-C and SIGTERM at moments when nothing of a run is under way yet: one line and the signal's
exit code.
"""

import logging
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from r2flow.base.errors import InputError
from r2flow.base.signals import (
    STOPPING,
    Stopped,
    blocking_signals,
    handling_signals,
    init_loader_worker,
    stop_at_once,
)
from r2flow.store import Store
from tests.conftest import ROOT
from tests.killing import Unreadable, be_killed, fail, is_gone, refuse, wait_until
from tests.training.conftest import start

# Sends this process a signal when it begins to import a module, then does what a command does.
AT_IMPORT = """
import os, runpy, sys

class Told:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), {number})

sys.meta_path.insert(0, Told())
sys.argv = {argv!r}
{command}
"""
VERB = "from r2flow.cli import main; main()"
TRAIN = f"runpy.run_path({str(ROOT / 'train.py')!r}, run_name='__main__')"


@pytest.mark.parametrize(
    ("command", "argv", "module"),
    [
        (VERB, ["r2flow", "info", "x"], "typer"),
        (VERB, ["r2flow", "sample", "x", "-o", "out"], "torch"),
        (VERB, ["r2flow", "train", "name=x"], "hydra"),
        (TRAIN, ["train.py", "name=x"], "hydra"),
        (TRAIN, ["train.py", "name=x"], "lightning"),
    ],
)
def test_told_to_stop_during_an_import(tmp_path: Path, command: str, argv: list[str], module: str):
    number = signal.SIGTERM if module == "lightning" else signal.SIGINT
    script = AT_IMPORT.format(module=module, number=int(number), argv=argv, command=command)
    process = start(tmp_path, ["-c", script], [sys.executable])
    assert process.communicate(timeout=100)[0].splitlines() == ["stopped"]
    assert process.returncode == 128 + number
    assert list(tmp_path.iterdir()) == []


LOADER = """
import os, time
from torch.utils.data import DataLoader
from r2flow.base.signals import init_loader_worker

def big(item):
    open(f"pid-{os.getpid()}", "w").close()
    return b"x" * 2**20  # more than a pipe takes: a worker waits for its reader

loader = iter(DataLoader(range(100), batch_size=None, num_workers=2, collate_fn=big, worker_init_fn=init_loader_worker))
next(loader)
time.sleep(100)
"""

STORE = """
import time
from r2flow.store import Store
Store(".", "scans", {}).make([100, 101], time.sleep, 2)
"""


@pytest.mark.parametrize("script", [LOADER, STORE])
def test_workers_end_when_their_parent_is_killed(tmp_path: Path, script: str):
    parent = start(tmp_path, ["-c", script], [sys.executable])
    try:
        wait_until(lambda: len(list(tmp_path.iterdir())) == 2)  # a file of each
        time.sleep(0.2)  # until both wait
    finally:
        parent.kill()
        parent.wait()
    wait_until(lambda: is_gone(parent.pid), seconds=20)
    assert not list(tmp_path.glob(".*"))  # locks of a store


def test_workers_of_a_failed_run_end_with_it(tmp_path: Path):
    script = LOADER.replace("time.sleep(100)", "")
    assert start(tmp_path, ["-c", script], [sys.executable]).communicate(timeout=25)[0] == ""


def test_a_run_hears_the_signal_of_its_job_that_its_launcher_ignores():
    with (
        handling_signals(signal.SIG_IGN, [signal.SIGUSR1]),
        handling_signals(stop_at_once, [signal.SIGUSR1]),
    ):
        assert signal.getsignal(signal.SIGUSR1) is stop_at_once


def test_a_worker_does_not_hear_what_its_run_ignores(monkeypatch):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    with handling_signals(signal.SIG_IGN):  # as a hang-up under nohup
        init_loader_worker()
        assert {signal.getsignal(number) for number in STOPPING} == {signal.SIG_IGN}


WORKERS = """
import functools, os, signal, sys, types
from r2flow.base.signals import Stopped, handling_signals, stop_at_once
from r2flow.store import Store

if __name__ != "__main__":
    os.killpg(0, {number})  # when a worker has started and imports this file
else:
    from r2flow.data.sets import ScanSet
    signal.signal({number}, lambda *_: None)  # for the signal of the second worker
    source = types.SimpleNamespace(drives={{}}, drawn=False, batch=lambda numbers: os.killpg(0, {number}))
    try:
        with handling_signals(stop_at_once):
            {work}
    except Stopped as stop:
        sys.exit(stop.code)
"""
MAKE = 'Store("out", "scans", {{}}).make(range(4), functools.partial(print, bytes(2**20)), 2)  # more than a pipe takes'
READ = 'list(ScanSet("", source, None).batches(range(99), 1, 2))'


@pytest.mark.parametrize(
    "number",
    [STOPPING[0], *(pytest.param(number, marks=pytest.mark.slow) for number in STOPPING[1:])],
)
# the latter within an import
@pytest.mark.parametrize(("work", "said"), [(MAKE, [""]), (READ, ["", "stopped\n"])])
def test_told_to_stop_when_workers_start(tmp_path: Path, number: int, work: str, said: list[str]):
    (tmp_path / "script.py").write_text(WORKERS.replace("{work}", work).format(number=int(number)))
    process = start(tmp_path, ["script.py"], [sys.executable])
    assert process.communicate(timeout=60)[0] in said
    assert process.returncode == 128 + number


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (be_killed, "killed.* memory for as many"), (refuse, "refuses"), (Unreadable(), "refuses"),
        (fail, "ValueError: of the work"),
    ],
)  # fmt: skip
def test_an_error_of_a_worker(tmp_path: Path, work: Callable[[int], None], message: str):
    with pytest.raises((InputError, RuntimeError), match=message):
        Store(tmp_path, "scans", {}).make(range(3), work, 2)


def test_the_parent_logs_what_a_worker_logs(tmp_path: Path, caplog):
    Store(tmp_path, "scans", {}).make(range(2), logging.getLogger("work").warning, 2)
    assert sorted(caplog.messages) == ["0", "1"]


def test_a_signal_waits_until_workers_are_started():
    with pytest.raises(Stopped) as stop, handling_signals(stop_at_once), blocking_signals():  # noqa: PT012
        signal.raise_signal(signal.SIGTERM)
        raise OSError("a worker is gone")  # ended by the same signal
    assert isinstance(stop.value.__context__, OSError)
