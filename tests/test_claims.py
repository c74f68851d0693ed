"""Folders that two commands want at once, and what killed commands leave in them."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from r2flow.base.errors import InputError
from r2flow.base.files import atomic_write, clear_leftovers, write_file
from r2flow.store import FileStore, Store

WRITING = """
import sys, time
from pathlib import Path
from r2flow.base.files import atomic_write
with atomic_write(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    print("writing", flush=True)
    time.sleep(60)
"""


def test_of_two_recipes_in_one_empty_folder_the_first_alone_writes(tmp_path: Path):
    """As two commands do it: both looked at the empty folder before either claimed it."""
    first = FileStore(tmp_path, "samples", {"seed": 1}, ["bin"])
    second = FileStore(tmp_path, "samples", {"seed": 2}, ["bin"])
    assert not first.check()
    assert not second.check()
    first.begin()
    with pytest.raises(InputError, match="holds other samples: seed"):
        second.begin()
    write_file(first.file(0), b"one")
    with pytest.raises(InputError, match="holds other samples"):
        second.begin()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000.bin", "manifest.json"]
    Store(tmp_path, "samples", {"seed": 1}).begin()  # the same recipe shares the folder


def test_a_claim_ends_with_its_command_if_nothing_was_made(tmp_path: Path):
    code = f"from r2flow.store import Store; Store({str(tmp_path)!r}, 'samples', {{'seed': 1}}).begin()"
    subprocess.run([sys.executable, "-c", code], check=True)
    second = Store(tmp_path, "samples", {"seed": 2})
    second.begin()
    with pytest.raises(InputError, match="holds other samples"):
        Store(tmp_path, "samples", {"seed": 1}).begin()


def test_files_of_killed_writers_go_and_those_of_living_stay(tmp_path: Path):
    def writer() -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, "-c", WRITING, str(tmp_path / "scan.bin")], stdout=subprocess.PIPE
        )
        assert process.stdout is not None
        assert process.stdout.readline() == b"writing\n"
        return process

    killed, living = writer(), writer()
    try:
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        (tmp_path / ".scans-000001.lock").touch()
        assert len([*tmp_path.glob(".*.part")]) == 2
        Store(tmp_path, "scans", {}).begin()
        assert len([*tmp_path.glob(".*.part")]) == 1
        assert not [*tmp_path.glob(".*.lock")]
    finally:
        living.kill()
        living.wait()
    others = {".download.part", ".notes.lock", ".scan.1234.part", "plain.0123abcd.part"}
    for name in others:
        (tmp_path / name).touch()
    clear_leftovers(tmp_path)
    assert {*os.listdir(tmp_path)} == {"manifest.json", *others}
    with atomic_write(tmp_path / "scan.bin") as file:
        clear_leftovers(tmp_path)  # of another command
        file.write(b"whole")
    assert (tmp_path / "scan.bin").read_bytes() == b"whole"


def test_a_shard_is_made_in_a_folder_that_is_shared(tmp_path: Path):
    stores = [Store(tmp_path, "scans", {"seed": 1}) for _ in range(2)]
    for number, store in enumerate(stores):
        store.begin()
        store.make([number], lambda item, one=store: one.write(item, {"x": np.zeros(2)}))
    assert not stores[0].missing([0, 1])
