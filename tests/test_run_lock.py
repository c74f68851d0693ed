"""One process at a time in a run's folder."""

import os
import platform
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from r2flow.errors import InputError
from r2flow.runs.folder import run_lock

HOLD = """
import sys, time
from r2flow.runs.folder import run_lock
with run_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_the_lock_names_its_holder_and_ends_when_that_is_killed(tmp_path: Path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        for _ in range(2):  # who is refused takes nothing away
            named = rf"\(pid {holder.pid} on {platform.node()}\). Wait for it, or give name=OTHER.$"
            with pytest.raises(InputError, match=named), run_lock(tmp_path, patience=0):
                pass
    finally:
        os.kill(holder.pid, signal.SIGKILL)
        holder.wait()
    with run_lock(tmp_path, patience=0):
        assert f"pid {os.getpid()}" in (tmp_path / ".lock.holder").read_text()


def test_the_lock_is_free_again_after_an_error(tmp_path: Path):
    with pytest.raises(ZeroDivisionError), run_lock(tmp_path):
        raise ZeroDivisionError
    with run_lock(tmp_path, patience=0):
        pass
