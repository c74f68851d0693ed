"""Each long verb, ended ten times at random moments by SIGTERM, SIGINT and SIGKILL in turn, ends as
one left alone.
"""

import os
import random
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from r2flow.model.paths import checkpoints_of
from tests.conftest import folder_of
from tests.killing import is_gone, wait_until
from tests.training.conftest import COMMAND, let_go, start, tiny
from tests.training.test_chain import CHAIN, HELD, assert_alike
from tests.training.test_train import assert_bit_equal

pytestmark = pytest.mark.slow

VERBS = {
    "simulate": ["--num", 40, "--size", "32x512", "--labels", "--workers", 2],
    "prepare": ["scans", "--shard-scans", 2, "--workers", 2],
    "pairs": ["run", "--num", 200, "--sampler", "midpoint", "--steps", 8, "--batch-size", 4, "--shard-mib", 0.05,
              "--device", "cpu"],
}  # fmt: skip


def finish(cwd: Path, command: Sequence[object]) -> float:
    begin = time.monotonic()
    process = start(cwd, command, command=[])
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    return time.monotonic() - begin


def end_ten_times(cwd: Path, command: Sequence[object], seed: int, into: str = "") -> None:
    """Run a command to its end into `one`, the last word behind `into`; end it ten times, then
    finish, into `ended`.

    Signals go to the process alone and to its whole group by turns, as `kill` and a terminal send
    them.
    """
    seconds = finish(cwd, [*command, f"{into}one"])
    command, draw, ended = [*command, f"{into}ended"], random.Random(seed), 0
    for number in range(10):
        by = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)[number % 3]
        process = start(cwd, command, command=[])
        time.sleep(draw.uniform(0.05, 0.6) * seconds)
        if process.poll() is None:
            (os.kill if number % 2 else os.killpg)(process.pid, by)
        said, code = process.communicate(timeout=120)[0], process.returncode
        assert code in (0, -by if by == signal.SIGKILL else 128 + by), (by, said)
        assert "Traceback" not in said, said
        assert code in (0, -signal.SIGKILL) or "stopped" in said, said
        ended += code != 0
        wait_until(lambda: is_gone(process.pid), seconds=40)  # noqa: B023
    assert ended >= 3
    finish(cwd, command)


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(("seed", "verb"), [*enumerate(VERBS)])
def test_a_verb(saved, tmp_path: Path, seed: int, verb: str):
    folder_of(tmp_path / "scans", 0, 60)
    end_ten_times(tmp_path, [sys.executable, "-m", "r2flow", verb, *VERBS[verb], "--out"], seed)
    assert files(tmp_path / "ended") == files(tmp_path / "one")


def test_training(scans: Path, tmp_path: Path):
    end_ten_times(
        tmp_path, [*COMMAND, *tiny(scans, "data.workers=2", "data.memory_gib=0")], 3, "name="
    )
    assert_bit_equal(tmp_path / "runs" / "one", tmp_path / "runs" / "ended")


def test_a_sweep(scans: Path, tmp_path: Path):
    end_ten_times(
        tmp_path, [*COMMAND, "-m", *tiny(scans, "seed=1,2", "samples.num=0")], 4, "hydra.sweep.dir="
    )
    jobs = [path.name for path in (tmp_path / "one").iterdir() if checkpoints_of(path)]
    assert len(jobs) == 2
    for job in jobs:
        assert_bit_equal(tmp_path / "one" / job, tmp_path / "ended" / job)


def test_a_chain(scans: Path, tmp_path: Path):
    let_go(tmp_path / HELD)
    end_ten_times(tmp_path, [*COMMAND, *tiny(scans, *CHAIN)], 5, "name=")
    assert_alike(tmp_path / "runs" / "one", tmp_path / "runs" / "ended")
