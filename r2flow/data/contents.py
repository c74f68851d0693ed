"""What files held when a run began: it resumes with the same contents alone."""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from stat import S_ISREG

from r2flow.errors import InputError
from r2flow.files import atomic_write, read_json

RECORD = "files.json"  # in the folder of the run
FORMAT = "r2flow files 1"
MOST_READ = 1 << 30  # bytes of all files up to which contents are compared; of more, sizes and times of change
CHUNK = 1 << 20


def record_contents(folder: Path, files: Mapping[str, str | Path]) -> None:
    """Note of each file, by its name, its size and a CRC-32 of its contents or, of many files, its time of change."""
    size = sum(os.stat(path).st_size for path in files.values() if os.path.exists(path))
    by = "contents" if size <= MOST_READ else "times"
    content = {"format": FORMAT, "by": by, "files": {name: _stamp(path, by) for name, path in files.items()}}
    with atomic_write(folder / RECORD, "w") as file:
        json.dump(content, file)


def check_contents(run: Path, files: Mapping[str, str | Path]) -> None:
    """Compare files with what was noted when the run began.

    Raises:
        InputError: a file is another one now.
    """
    try:
        noted = read_json(run / RECORD)
        by, there = noted["by"], dict(noted["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return record_contents(run, files)
    for name, path in files.items():
        if name in there and there[name] != _stamp(path, by):
            copied = f" Or, if they were copied alone, remove {run / RECORD}." if by == "times" else ""
            raise InputError(
                f"{path} has changed since {run} began to train on it. Give back the scans that it began with, or take "
                f"name=OTHER for a new run.{copied}"
            )


def _stamp(path: str | Path, by: str) -> list[int]:
    """Size and CRC-32 or time of change in nanoseconds of a regular file; of others, nothing is read."""
    try:
        found = os.stat(path)
        if not S_ISREG(found.st_mode):
            return [0, 0]
        if by == "times":
            return [found.st_size, found.st_mtime_ns]
        crc = 0
        with open(path, "rb") as file:
            while chunk := file.read(CHUNK):
                crc = zlib.crc32(chunk, crc)
        return [found.st_size, crc]
    except OSError:  # reading it as a scan says what is wrong
        return [0, 0]
