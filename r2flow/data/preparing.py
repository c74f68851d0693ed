"""Making prepared scans: shard by shard, by any number of processes, at any number of attempts."""

import hashlib
import json
import logging
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import BaseFileLock
from torch.utils.data import DataLoader, Dataset, Sampler

from r2flow.data.manifest import (
    Manifest,
    Recipe,
    ShardEntry,
    checksum,
    read_entry,
    read_manifest,
    shard_name,
    write_manifest,
)
from r2flow.data.plans import Plan
from r2flow.data.prepared import check_shard, read_head, scan_crc
from r2flow.data.quantise import RangeCodes, ReflectanceCodes
from r2flow.data.sources import ScanSource
from r2flow.data.store import MANIFEST, Damaged, clear_leftovers, lock_file, refuse_other, shard_bytes, warn_damaged
from r2flow.errors import InputError
from r2flow.files import atomic_write

log = logging.getLogger(__name__)


class Coded(NamedTuple):
    """One scan in codes, (H, W) each, and the most that its ranges and reflectances are off by them."""

    codes: list[np.ndarray]
    errors: list[float]


class CodedScans(Dataset[tuple[int, Coded | str]]):
    """Scan by scan its number and its codes, or why it cannot be used."""

    def __init__(self, source: ScanSource, recipe: Recipe) -> None:
        self.source = source
        self.range = RangeCodes(recipe.sensor["min_range"], recipe.sensor["max_range"])
        self.reflectance = None if recipe.levels is None else ReflectanceCodes(recipe.levels)

    def __getitem__(self, number: int) -> tuple[int, Coded | str]:
        try:
            image = self.source[number]
        except InputError as error:
            return number, str(error)
        codes = [self.range.encode(image[0])]
        decoded = [self.range.metres[codes[0]]]
        if self.reflectance is not None:
            codes.append(self.reflectance.encode(image[1]))
            decoded.append(self.reflectance.values[codes[1]])
        errors = [float(np.abs(one.astype(np.float64) - image[i]).max()) for i, one in enumerate(decoded)]
        return number, Coded(codes, errors)


class Preparation:
    """A folder in which prepared scans are made.

    A shard is written whole, then a note of it into `making/`; when all are there the notes become the manifest. A
    process owns a shard while it holds the lock `making/SHARD.lock`, which the system releases when the process dies:
    two commands share the work, and what a killed one was making is made again.
    """

    def __init__(self, folder: str | Path, plan: Plan) -> None:
        self.folder, self.plan, self.recipe = Path(folder).expanduser(), plan, plan.recipe
        self.finished: tuple[ShardEntry, ...] | None = None

    @property
    def _making(self) -> Path:
        return self.folder / "making"

    def begin(self, advance: Callable[[int], None] = lambda scans: None) -> list[int]:
        """Take the folder, and check all that is in it; the shards that are missing or damaged.

        What is finished is only read: it may lie where nothing can be written.

        Args:
            advance: Called with the number of scans of each shard that was looked at.

        Raises:
            InputError: other scans are in the folder.
        """
        if not self._is_taken():
            self._take()
        self._look()
        missing = []
        for shard in range(self.recipe.shards):
            if not self._is_whole(shard, logging.WARNING):
                missing.append(shard)
            advance(len(self.recipe.numbers_of(shard)))
        return missing

    def _take(self) -> None:
        self._making.mkdir(parents=True, exist_ok=True)
        with self._manifest_lock():
            if not self._is_taken():
                write_manifest(self.folder, Manifest(self.recipe, self.plan.drives))

    @contextmanager
    def _manifest_lock(self) -> Iterator[None]:
        lock = lock_file(self._making / "manifest.lock", wait=True)
        assert lock is not None
        try:
            yield
        finally:
            lock.release()

    def _is_taken(self) -> bool:
        """Whether a manifest is here that has to stay: not one of other settings by which no shard was ever made."""
        if not (self.folder / MANIFEST).exists():
            return False
        there = read_manifest(self.folder)
        if there.shards is not None or there.recipe.digest == self.recipe.digest or any(self.folder.glob("scans-*")):
            return True
        return not all(self._is_free(int(lock.stem)) for lock in self._making.glob("[0-9]*.lock"))

    def make(
        self,
        missing: Sequence[int],
        on_bad_scan: str = "error",
        workers: int = 0,
        advance: Callable[[int], None] = lambda scans: None,
        patience: float = 0.5,
    ) -> Manifest:
        """Make the missing shards, wait for those that another process makes, and finish the manifest.

        Args:
            on_bad_scan: `error`, or `skip` to leave out what cannot be used.
            workers: Processes that read and project; 0 does it in this one.
            advance: Called with a number of scans whenever these are done, here or elsewhere.
            patience: Seconds between looks at what others do.

        Raises:
            InputError: a scan that cannot be used, with `error`; no usable scan at all; or a shard that is made again
                comes out otherwise than before.
            OSError: the folder cannot be written, or the disk is full.
        """
        if on_bad_scan not in ("error", "skip"):
            raise InputError(f"--on-bad-scan must be 'error' or 'skip', found {on_bad_scan!r}.")
        left = list(missing)
        while left:
            claims = _Claims(self, left)
            try:
                made = self._make_claimed(claims, on_bad_scan, workers, advance)
            finally:
                claims.release()
            for shard in claims.elsewhere:
                advance(len(self.recipe.numbers_of(shard)))
            left = [shard for shard in left if shard not in made and shard not in claims.elsewhere]
            while left and not any(self._is_free(shard) for shard in left):
                time.sleep(patience)
        return self._finish()

    def _make_claimed(
        self, claims: "_Claims", on_bad_scan: str, workers: int, advance: Callable[[int], None]
    ) -> set[int]:
        loader = DataLoader(
            CodedScans(self.plan.source, self.recipe), sampler=claims, batch_size=None, num_workers=workers,
            collate_fn=_as_it_is,
        )  # fmt: skip
        made, scans, left_out = set(), [], []
        for number, coded in loader:  # in order, whoever read them
            if isinstance(coded, str):
                if on_bad_scan == "error":
                    raise InputError(coded)
                log.warning("left out: %s", coded)
                left_out.append(number)
            else:
                scans.append(coded)
            advance(1)
            shard = number // self.recipe.shard_scans
            if number + 1 == self.recipe.numbers_of(shard).stop:
                self._write(shard, scans, left_out)
                claims.done(shard)
                made.add(shard)
                scans, left_out = [], []
        return made

    def _look(self) -> None:
        """Read the manifest again: another process may have finished it."""
        manifest = read_manifest(self.folder)
        refuse_other(self.folder, "scans", asdict(manifest.recipe), asdict(self.recipe), "--out FOLDER")
        self.finished = manifest.shards

    def _entry(self, shard: int) -> ShardEntry | None:
        """What is known of a shard."""
        if self.finished is not None:
            return self.finished[shard]
        with suppress(OSError, ValueError, TypeError, KeyError):
            note = json.loads(self._note(shard).read_text(encoding="utf-8"))
            if note["recipe"] == self.recipe.digest and note["checksum"] == checksum(note["shard"]):
                return read_entry(note["shard"])
        return None

    def _note(self, shard: int) -> Path:
        return self._making / f"{shard:06d}.json"

    def _is_whole(self, shard: int, level: int = logging.DEBUG) -> bool:
        entry = self._entry(shard)
        if entry is None:
            return False
        try:
            check_shard(self.folder / shard_name(shard), entry)
        except Damaged as error:
            warn_damaged(self.folder / shard_name(shard), error, level)
            return False
        return True

    def claim(self, shard: int) -> BaseFileLock | None:
        """The lock of a shard, None where another process holds it."""
        return lock_file(self._making / f"{shard:06d}.lock")

    def _is_free(self, shard: int) -> bool:
        lock = self.claim(shard)
        if lock is not None:
            lock.release()
        return lock is not None

    def is_made(self, shard: int) -> bool:
        """Whether another process has made a shard meanwhile; to be asked with its lock held."""
        if self.finished is None and not self._note(shard).exists():
            self._look()
        return self._is_whole(shard)

    def clear(self, shard: int) -> None:
        """Remove what a killed process was writing; to be done with the shard's lock held."""
        clear_leftovers(self.folder.glob(f".{shard_name(shard)}.*.part"))

    def _write(self, shard: int, scans: Sequence[Coded], left_out: Sequence[int]) -> None:
        data = self._serialised(shard, [scan.codes for scan in scans])
        errors = [max((scan.errors[i] for scan in scans), default=0.0) for i in range(self._channels)]
        entry = ShardEntry(
            scans=len(scans),
            left_out=tuple(left_out),
            bytes=len(data),
            head=zlib.crc32(read_head(BytesIO(data))),
            sha256=hashlib.sha256(data).hexdigest(),
            range_error=errors[0],
            reflectance_error=errors[1] if len(errors) > 1 else 0.0,
        )
        path = self.folder / shard_name(shard)
        if self.finished is not None and entry != self.finished[shard]:
            raise InputError(
                f"{path} was damaged, and what it was made of has changed since: prepare all scans into another folder."
            )
        if path.is_dir() and not path.is_symlink():
            raise InputError(f"{path} is a folder where a shard belongs; remove it.")
        if path.is_symlink() and not path.exists():
            path.unlink()
        with atomic_write(path) as file:
            file.write(data)
        if self.finished is None:
            note = json.loads(json.dumps({"shard": asdict(entry)}))
            with atomic_write(self._note(shard), "w") as file:
                json.dump({"recipe": self.recipe.digest, **note, "checksum": checksum(note["shard"])}, file)

    @property
    def _channels(self) -> int:
        return 1 if self.recipe.levels is None else 2

    def _serialised(self, shard: int, scans: Sequence[Sequence[np.ndarray]]) -> bytes:
        crc = np.array([scan_crc(codes) for codes in scans], dtype=np.uint32)
        tensors = {"crc32": crc}
        for channel, (name, kind) in enumerate((("range", np.uint16), ("reflectance", np.uint8))[: self._channels]):
            tensors[name] = np.empty((len(scans), *self.recipe.image_shape), dtype=kind)
            for row, codes in enumerate(scans):
                tensors[name][row] = codes[channel]
        notes = {
            "recipe": self.recipe.digest,
            "shard": shard,
            "ranges": {"min_range": self.recipe.sensor["min_range"], **self.recipe.ranges},
            "levels": self.recipe.levels,
        }
        return shard_bytes(tensors, "scans", notes)

    def _finish(self) -> Manifest:
        """Turn the notes into the manifest, unless another process has, and clear away what was needed for it."""
        if self.finished is not None and not self._making.exists():
            return read_manifest(self.folder)
        with self._manifest_lock():
            self._look()
            if self.finished is None:
                entries = [self._entry(shard) for shard in range(self.recipe.shards)]
                shards = tuple(entry for entry in entries if entry is not None)
                if len(shards) < len(entries):
                    raise InputError(f"{self._making} was changed meanwhile; the same command goes on.")
                if not any(entry.scans for entry in shards):
                    raise InputError(
                        f"all {self.recipe.scans} scans were left out as unusable; see the warnings above."
                    )
                write_manifest(self.folder, Manifest(self.recipe, self.plan.drives, shards))
            with suppress(OSError):  # another process may have removed the folder, or opened a lock in it
                for path in (*self.folder.glob(f".{MANIFEST}.*.part"), *self._making.iterdir()):
                    path.unlink(missing_ok=True)
                self._making.rmdir()
        return read_manifest(self.folder)


def _as_it_is(item: Any) -> Any:
    return item


class _Claims(Sampler[int]):
    """The scans of shards that no other process is making, claimed as they are asked for.

    It never waits for another process: that one may wait for a shard that is claimed here and not made yet.

    Attributes:
        elsewhere: Shards that turned out to have been made by another process.
    """

    def __init__(self, work: Preparation, shards: Sequence[int]) -> None:
        self.work, self.shards = work, shards
        self.elsewhere: set[int] = set()
        self._locks: dict[int, BaseFileLock] = {}

    def __iter__(self) -> Iterator[int]:
        for shard in self.shards:
            lock = self.work.claim(shard)
            if lock is None:
                continue
            if self.work.is_made(shard):
                self.elsewhere.add(shard)
                lock.release()
                continue
            self._locks[shard] = lock
            self.work.clear(shard)
            yield from self.work.recipe.numbers_of(shard)

    def done(self, shard: int) -> None:
        self._locks.pop(shard).release()

    def release(self) -> None:
        for lock in self._locks.values():
            lock.release()
        self._locks.clear()
