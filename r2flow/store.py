"""Stores: folders of numbered items, written by any number of processes and resumable.

    store = Store(folder, "scans", recipe)
    store.begin()                                  # claims the folder, or refuses another recipe
    store.make(store.missing(range(9)), work, 4)   # work(i) calls store.write(i, tensors, notes)
    tensors, notes = store.read(3)

An item depends only on the recipe and on its number: two processes that make the same item write
the same bytes. `manifest.json` stores the recipe; an item is a safetensors file with the digest of
the recipe and a checksum. Files are written under a temporary name and renamed when complete, so
that a killed command can resume.
"""

import fcntl
import hashlib
import json
import logging
import math
import os
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from r2flow.base.config import at_most_three, differences
from r2flow.base.errors import InputError, check
from r2flow.base.files import clear_leftovers, locked, read_json, write_file
from r2flow.base.hashing import state_hash
from r2flow.base.pool import attempts_of
from r2flow.base.registry import Config, Options
from r2flow.lidar.scan_files import FIRM_ENDINGS

_log = logging.getLogger(__name__)

MANIFEST = "manifest.json"
_PATIENCE = 0.2  # seconds between polls of items that other processes make
QUIET = 20.0  # seconds of waiting before a log message


class Damaged(Exception):
    """A file does not have the content that was written."""


class Store:
    """A folder of items of one kind, `KIND-000003.safetensors`, and of one recipe, plain values
    that they depend on.
    """

    option = "--out FOLDER"  # in messages: how a user gives another folder

    def __init__(self, folder: str | Path, kind: str, recipe: Options) -> None:
        self.folder = Path(folder).expanduser()
        self.kind = kind
        self.described: Config = json.loads(json.dumps(recipe))
        self.digest = checksum(self.described)
        self._held: int | None = None  # descriptor of the claimed folder

    def file(self, item: int) -> Path:
        return self.folder / f"{self.kind}-{item:06d}.safetensors"

    def check(self, claimed: bool = False) -> bool:
        """Whether the folder has a manifest; refuses a folder with scans, or with anything of
        another recipe, if `claimed` also its manifest alone.
        """
        if (self.folder / MANIFEST).is_file():
            other = [*differences(self.recipe_there(), self.described).values()]
            if other:
                if not claimed and len(os.listdir(self.folder)) == 1:
                    return False  # its command was refused before it made anything
                raise InputError(
                    f"{self.folder} holds other "
                    f"{self.kind.replace('simulated', 'simulated scans')}: {at_most_three(other)}. "
                    f"Give the same settings, or another folder by {self.option}."
                )
            return True
        for path in self.folder.glob("*"):
            if path.name.lower().endswith(FIRM_ENDINGS):
                raise InputError(
                    f"{self.folder} holds scans ({path.name}) and no {MANIFEST}: "
                    f"give another folder by {self.option}."
                )
        return False

    def recipe_there(self) -> Config:
        """The recipe in the folder's manifest; refuses a manifest of another kind."""
        content = manifest_of(self.folder)
        where = f"{self.folder / MANIFEST} is damaged, or not of r2flow: give another folder."
        check(content, where)
        kind = content["format"].removeprefix("r2flow ")
        same = kind == self.kind
        check(same, f"{self.folder} holds {kind}, not {self.kind}; give another folder.")
        recipe: Config = content["recipe"]
        return recipe

    def begin(self, **notes: Any) -> None:
        """Claim the folder for the recipe: write the manifest, with `notes`, if it is missing.

        Processes of the recipe share a lock of the folder while they live; the manifest of another
        recipe is replaced by a process that has the folder alone, if nothing was made by it.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        clear_leftovers(self.folder)
        if self._held is None:
            self._held = os.open(self.folder, os.O_RDONLY)
            weakref.finalize(self, os.close, self._held)
        alone = locked(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if alone and not self.check():
            self.write_manifest(**notes)
        locked(self._held, fcntl.LOCK_SH)
        if not self.check(claimed=True):  # its process has ended, or a disk without locks
            self.write_manifest(**notes)

    def write_manifest(self, **notes: Any) -> None:
        """Write or overwrite the manifest: the recipe and `notes`."""
        content = {"format": f"r2flow {self.kind}", "recipe": self.described, **notes}
        write_file(
            self.folder / MANIFEST, json.dumps({**content, "checksum": checksum(content)}, indent=1)
        )

    def has(self, item: int) -> bool:
        """Whether an item exists; reads only the header of its file."""
        with suppress(FileNotFoundError, Damaged):
            self.head(item)
            return True
        return False

    def missing(self, items: Iterable[int]) -> list[int]:
        return [item for item in items if not self.has(item)]

    def write(
        self, item: int, tensors: Mapping[str, np.ndarray], notes: Options | None = None
    ) -> None:
        """Write an item; it then counts as made."""
        note = {
            "recipe": self.digest,
            "item": item,
            "sha256": state_hash(tensors, notes or {}),
            "notes": notes or {},
        }
        path = self.file(item)
        if path.is_symlink() and not path.exists():
            path.unlink()
        stored = {name: np.asarray(value, order="C") for name, value in tensors.items()}
        write_file(path, save(stored, metadata={"r2flow": json.dumps(note)}))

    def read(self, item: int) -> tuple[dict[str, np.ndarray], Config]:
        """Read tensors and notes of an item and verify its checksum.

        Raises `FileNotFoundError`, `Damaged`, or `InputError` if the item has another recipe.
        """
        with self._opened(item) as (file, note):
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  not a mapping
            if note["sha256"] != state_hash(tensors, note["notes"]):
                raise Damaged("its checksum differs")
            return tensors, note["notes"]

    def head(self, item: int) -> Config:
        """Read the notes of an item; raises the exceptions of `read`."""
        with self._opened(item) as (_, note):
            return dict(note["notes"])

    @contextmanager
    def _opened(self, item: int) -> Iterator[tuple[Any, Config]]:
        path = self.file(item)
        if not path.is_file():
            raise FileNotFoundError(path)
        try:
            with safe_open(path, framework="numpy") as file:
                note = json.loads((file.metadata() or {})["r2flow"])
                if note["recipe"] != self.digest:
                    raise InputError(
                        f"{path} holds {self.kind} of another recipe: "
                        "give the settings that they were made with, or "
                        f"another folder by {self.option}."
                    )
                if note["item"] != item:
                    raise Damaged(f"it is item {note['item']}")
                yield file, note
        except InputError:
            raise
        except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise Damaged(str(error)) from None

    def mend(self, item: int) -> None:
        """Verify an item if it exists, and delete it with a warning if it is damaged."""
        try:
            self.read(item)
        except FileNotFoundError:
            pass
        except Damaged as error:
            path = self.file(item)
            _log.warning("%s is damaged (%s): it is made again.", path, error)
            path.unlink(missing_ok=True)

    def make(
        self,
        items: Iterable[int],
        work: Callable[[int], None],
        workers: int = 1,
        advance: Callable[[int], None] = lambda item: None,
        wait: bool = True,
    ) -> None:
        """Make items by `work`, which any process must be able to unpickle, in `workers` processes
        (1: this one).

        `advance` is called with each finished item. `wait`: await items that other commands are
        making; else skip them.
        """
        left = list(items)
        since = time.monotonic()
        while left:
            waiting = []
            with closing(attempts_of(self, left, work, workers)) as attempts:
                for item, done in attempts:
                    if done:
                        advance(item)
                    else:
                        waiting.append(item)
            if not wait:
                return
            if len(waiting) < len(left):
                since = time.monotonic()
            else:
                time.sleep(_PATIENCE)
            if waiting and time.monotonic() - since > QUIET:
                since = math.inf  # log once
                _log.warning("waiting for another process, which makes %s", self.file(waiting[0]))
            left = waiting

    def attempt(self, item: int, work: Callable[[int], None]) -> bool:
        """Make an item unless it exists; False if another process is making it.

        The lock ends with its process. It only saves work, since two processes write the same bytes
        for an item.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f".{self.kind}-{item:06d}.lock"
        lock = FileLock(path, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            return False
        try:
            if not self.has(item):
                work(item)
        finally:
            path.unlink(missing_ok=True)
            lock.release()
        return True


class FileStore(Store):
    """A store whose items are files of other formats, `000003.ENDING`; an item exists if all of its
    files exist.
    """

    def __init__(
        self, folder: str | Path, kind: str, recipe: Options, endings: Sequence[str]
    ) -> None:
        super().__init__(folder, kind, recipe)
        self.endings = endings

    def file(self, item: int) -> Path:
        return self.files(item)[0]

    def files(self, item: int) -> list[Path]:
        return [self.folder / f"{item:06d}.{ending}" for ending in self.endings]

    def has(self, item: int) -> bool:
        return all(file.is_file() for file in self.files(item))


def manifest_of(folder: str | Path) -> Config:
    """The verified manifest that r2flow wrote in a folder; empty if there is none."""
    path = Path(folder).expanduser() / MANIFEST
    try:
        content: Config = read_json(path)
        if "checksum" not in content:  # a common name: of a data set, say
            return {}
        whole = content.pop("checksum") == checksum(content) and "recipe" in content
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (ValueError, TypeError, AttributeError):
        whole = False
    check(whole, f"{path} is damaged. If r2flow wrote {folder}, remove it and make it again.")
    return content


def checksum(content: Any) -> str:
    """SHA-256 of a JSON-serialisable value."""
    return hashlib.sha256(
        json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()
