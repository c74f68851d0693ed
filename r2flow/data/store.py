"""What the two stores of shards share: prepared scans (`preparing`, `prepared`) and pairs (`shards`).

Both cut numbered items into shards of equal size, write every file under a temporary name that takes its place when it
is whole, know a damaged file by its checksum and make it again, and refuse a folder that holds something else.
"""

import json
import logging
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from r2flow.errors import InputError

log = logging.getLogger(__name__)

MANIFEST = "manifest.json"


class Damaged(Exception):
    """A file that is not what was written."""


def shard_count(items: int, size: int) -> int:
    """The number of shards of `size` items, the last one perhaps shorter."""
    return -(-items // size)


def shard_items(shard: int, items: int, size: int) -> range:
    """The numbers of the items of one shard."""
    return range(shard * size, min((shard + 1) * size, items))


def shard_bytes(tensors: dict[str, np.ndarray], key: str, notes: Mapping[str, Any]) -> bytes:
    """A shard as a safetensors file, its notes as JSON under one key: several keys come in no fixed order."""
    return save(tensors, metadata={key: json.dumps(notes)})


def warn_damaged(path: Path, damage: str | Damaged, level: int = logging.WARNING) -> None:
    log.log(level, "%s is damaged (%s): it is made again.", path, damage)


def clear_leftovers(files: Iterable[Path], older: float = 0.0) -> None:
    """Remove the temporary files of killed writers, those that nobody has written to for `older` seconds."""
    for leftover in files:
        with suppress(FileNotFoundError):
            if not older or time.time() - leftover.stat().st_mtime > older:
                leftover.unlink()


def refuse_other(folder: Path, what: str, there: Mapping[str, Any], here: Mapping[str, Any], option: str) -> None:
    """Refuse a folder that holds `what` of other settings; `option` is how another folder is given.

    Raises:
        InputError: the settings differ.
    """
    found = difference(there, here)
    if found:
        raise InputError(
            f"{folder} holds other {what}: {found}. Give the same settings, or another folder by {option}."
        )


def difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str | None:
    """The first setting that differs, in words; None where all are equal, as JSON writes them."""
    there, here = json.loads(json.dumps([there, here]))
    for key in {**there, **here}:
        old, new = there.get(key), here.get(key)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            return f"{key}: {difference(old, new)}"
        if key == "names":
            return "the names of the scans are others"
        if isinstance(old, list) and isinstance(new, list):
            return f"{key} are others ({len(old)} values there, {len(new)} values here)"
        return f"{key} is {old} there, {new} here"
    return None
