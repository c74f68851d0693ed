"""Making prepared scans: which and how is planned, then shard by shard, by any number of processes and attempts."""

import hashlib
import json
import logging
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from filelock import FileLock, Timeout
from torch.utils.data import DataLoader, Dataset

from r2flow import simulator
from r2flow.data.contents import RECORD, record_contents, refuse_changed
from r2flow.data.layouts import Drive
from r2flow.data.opening import find_drives
from r2flow.data.options import SIMULATED
from r2flow.data.prepared import (
    Manifest,
    ScanRecipe,
    ShardEntry,
    checksum,
    damage_of,
    describe_sensor,
    read_head,
    read_manifest,
    scan_crc,
    shard_name,
    write_manifest,
)
from r2flow.data.quantise import OTHER_LEVELS, RangeCodes, ReflectanceCodes, find_levels
from r2flow.data.reading import Reading, lacks_reflectance, range_image, stored_reflectance
from r2flow.data.sources import ScanFiles, ScanSource, SimulatedScans, spread, warn_of_other_sensor
from r2flow.data.store import MANIFEST, clear_leftovers, refuse_other, shard_bytes, warn_damaged
from r2flow.errors import InputError
from r2flow.files import atomic_write, make_folder, read_json
from r2flow.lidar.sensors import Sensor
from r2flow.signals import end_with_parent

log = logging.getLogger(__name__)

SHARD_SCANS = 512  # 100 MB at 64 x 1024, held in memory while they are made
PROBED = 8  # scans that tell whether a data set has reflectance, and in which steps
PROJECTION = 1  # to be raised when the same files give other images, or images other codes

Advance = Callable[[int], None]  # told a number of scans whenever they are done


@dataclass(frozen=True)
class Plan:
    """The scans to prepare, and how; `files` are those that they are read from, by their names and in their order."""

    recipe: ScanRecipe
    drives: tuple[Drive, ...]
    source: ScanSource
    files: Mapping[str, str | Path] = field(default_factory=dict)


def plan_files(
    layout: str,
    root: str | Path,
    sensor: Sensor,
    projection: str = "spherical",
    convention: str = "centre",
    split: str | None = None,
    drives: Sequence[str | int] | None = None,
    reflectance_scale: float = 1.0,
    levels: int | None = None,
    shard_scans: int = SHARD_SCANS,
    columns: tuple[str, ...] | None = None,
) -> Plan:
    """The scans of a data set (`find_drives`). Without `levels`, some of the scans tell those of reflectance.

    Raises:
        InputError: no such scans, or levels out of their range.
    """
    root = Path(root).expanduser()
    found = find_drives(layout, root, split, drives)
    paths = [path for drive in found for path in drive.scans]
    named = tuple(Drive(d.name, tuple(Path(os.path.relpath(p, root)).as_posix() for p in d.scans)) for d in found)
    reading = Reading(sensor, projection, convention, reflectance_scale, "auto", "error", True, columns)  # type: ignore[arg-type]
    warn_of_other_sensor(paths, reading, root)
    known = _reflectance_levels(paths, reading, levels)
    reading = replace(reading, reflectance=known is not None)
    plan = _plan(layout, named, ScanFiles(paths, reading), reading, known, shard_scans, PROJECTION)
    return replace(plan, files=dict(zip((name for drive in named for name in drive.scans), paths, strict=True)))


def plan_simulated(
    num: int, seed: int, sensor: Sensor, levels: int | None = None, shard_scans: int = SHARD_SCANS
) -> Plan:
    """The first `num` scenes of the simulator under a seed."""
    drives = (Drive(SIMULATED, tuple(f"scene {scene}" for scene in range(num))),)
    source = SimulatedScans(sensor, seed, range(num))
    known = find_levels(source[0][1]) if levels is None else levels
    return _plan(SIMULATED, drives, source, Reading(sensor), known, shard_scans, simulator.REVISION, seed)


def _plan(
    layout: str, drives: tuple[Drive, ...], source: ScanSource, reading: Reading, levels: int | None,
    shard_scans: int, revision: int, seed: int | None = None,
) -> Plan:  # fmt: skip
    names = [name for drive in drives for name in drive.scans]
    if levels is not None:
        ReflectanceCodes(levels)  # refuses what is no number of levels
    recipe = ScanRecipe(
        revision, layout, len(names), checksum(names), describe_sensor(reading.sensor), reading.projection,
        reading.convention, reading.reflectance_scale or 1.0, levels,
        RangeCodes(reading.sensor.min_range, reading.sensor.max_range).describe(), shard_scans, seed, reading.columns,
    )  # fmt: skip
    return Plan(recipe, drives, source)


def _reflectance_levels(paths: Sequence[str], reading: Reading, levels: int | None) -> int | None:
    """Levels of reflectance, `levels` where given; None where the scans have none, by `lacks_reflectance`."""
    if lacks_reflectance(paths, "skip", reading.columns) is not None:
        return None
    found, scale, images = [], reading.reflectance_scale or 1.0, False
    for index in spread(len(paths), PROBED):
        with suppress(InputError):  # it is met again, and dealt with, when its turn comes
            reflectance = stored_reflectance(paths[index], reading.columns)
            if reflectance is not None:
                is_image = range_image(Path(paths[index])) is not None  # which has reflectances of [0, 1]
                found.append(reflectance / np.float32(1.0 if is_image else scale))
                images |= is_image
    values = np.concatenate(found) if found else np.zeros(0)
    if not values.any():
        return OTHER_LEVELS if levels is None else levels
    if levels is not None:
        return levels
    levels, highest = find_levels(values), float(values.max())
    if not images and highest < 0.25 and not ReflectanceCodes(levels).fits(values):
        log.warning(
            "reflectance goes up to %.3g of 1 alone and is kept in steps of 1/%d: --reflectance-scale %.3g spreads it",
            highest, levels, highest * scale,
        )  # fmt: skip
    return levels


class Coded(NamedTuple):
    """One scan in codes of range and reflectance, (H, W) each, and the most that these are off."""

    codes: list[np.ndarray]
    errors: list[float]


class CodedScans(Dataset[tuple[int, Coded | str]]):
    """Scan by scan its number and its codes, or why it cannot be used."""

    def __init__(self, source: ScanSource, recipe: ScanRecipe) -> None:
        self.source, self.coders = source, recipe.codes

    def __getitem__(self, number: int) -> tuple[int, Coded | str]:
        try:
            image = self.source[number]
        except InputError as error:
            return number, str(error)
        codes = [coder.encode(channel) for coder, channel in zip(self.coders, image, strict=False)]
        decoded = [coder.values[code].astype(np.float64) for coder, code in zip(self.coders, codes, strict=True)]
        errors = [float(np.abs(one - channel).max()) for one, channel in zip(decoded, image, strict=False)]
        return number, Coded(codes, errors)


class Preparation:
    """A folder in which prepared scans are made.

    A shard is written whole, then a note of it into `making/`; when all are there the notes become the manifest. A
    process owns a shard while it holds the lock `making/SHARD.lock`, which the system releases when the process dies:
    two commands share the work, and what a killed one was making is made again.
    """

    def __init__(self, folder: str | Path, plan: Plan) -> None:
        self.folder, self.plan, self.recipe = Path(folder).expanduser(), plan, plan.recipe
        self.making = self.folder / "making"
        self.finished: tuple[ShardEntry, ...] = ()

    def begin(self, advance: Advance = lambda scans: None) -> list[int]:
        """Take the folder, and check all that is in it; the shards that are missing or damaged.

        What is finished is only read: it may lie where nothing can be written.

        Raises:
            InputError: other scans are in the folder, or its shards were made of other contents of the same files.
        """
        if not self._is_taken():
            with self._lock("manifest", wait=True):
                if not self._is_taken():
                    write_manifest(self.folder, Manifest(self.recipe, self.plan.drives))
        self._look()
        missing = []
        for shard in range(self.recipe.shards):
            if not self._is_whole(shard, logging.WARNING):
                missing.append(shard)
            advance(len(self.recipe.numbers_of(shard)))
        self._refuse_changed(missing)
        if missing and not self.finished and self.plan.files:
            record_contents(self.folder, self.plan.files)
        return missing

    def make(
        self,
        missing: Sequence[int],
        on_bad_scan: str = "error",
        workers: int = 0,
        advance: Advance = lambda scans: None,
        patience: float = 0.5,
    ) -> Manifest:
        """Make the missing shards, wait for those that another process makes, and finish the manifest.

        Args:
            on_bad_scan: `error`, or `skip` to leave out what cannot be used.
            workers: Processes that read and project; 0 does it in this one.
            patience: Seconds between looks at what others do.

        Raises:
            InputError: a scan that cannot be used, with `error`; no usable scan at all; or a shard that is made again
                comes out otherwise than before.
            OSError: the folder cannot be written, or the disk is full.
        """
        if on_bad_scan not in ("error", "skip"):
            raise InputError(f"--on-bad-scan must be 'error' or 'skip', found {on_bad_scan!r}.")
        left = set(missing)
        while left:
            claims: dict[int, ExitStack] = {}
            try:
                self._make_unclaimed(left, claims, on_bad_scan, workers, advance)
            finally:
                for claim in claims.values():
                    claim.close()
            while left and not any(self._is_free(shard) for shard in left):
                time.sleep(patience)
        return self._finish()

    def _make_unclaimed(
        self, left: set[int], claims: dict[int, ExitStack], on_bad_scan: str, workers: int, advance: Advance
    ) -> None:
        """Make what no other process is making; what is there then is `left` no more."""
        loader = DataLoader(
            CodedScans(self.plan.source, self.recipe), sampler=self._claimed(left, claims, advance), batch_size=None,
            num_workers=workers, collate_fn=_as_it_is, worker_init_fn=end_with_parent,
        )  # fmt: skip
        scans: list[Coded] = []
        left_out: list[int] = []
        for number, coded in loader:  # in order, whoever read them
            if not isinstance(coded, str):
                scans.append(coded)
            elif on_bad_scan == "error":
                raise InputError(coded)
            else:
                log.warning("left out: %s", coded)
                left_out.append(number)
            advance(1)
            shard = number // self.recipe.shard_scans
            if number + 1 == self.recipe.numbers_of(shard).stop:
                self._write(shard, scans, left_out)
                claims.pop(shard).close()
                left.remove(shard)
                scans, left_out = [], []

    def _claimed(self, left: set[int], claims: dict[int, ExitStack], advance: Advance) -> Iterator[int]:
        """The scans of shards that no other process is making, claimed as they are asked for.

        It never waits for another process: that one may wait for a shard that is claimed here and not made yet.
        """
        for shard in sorted(left):
            with ExitStack() as claim:
                if not claim.enter_context(self._lock(f"{shard:06d}")):
                    continue
                if not self.finished and not self._note(shard).exists():
                    self._look()
                if self._is_whole(shard):  # another process has made it meanwhile
                    left.remove(shard)
                    advance(len(self.recipe.numbers_of(shard)))
                    continue
                claims[shard] = claim.pop_all()
            clear_leftovers(self.folder.glob(f".{shard_name(shard)}.*.part"))
            yield from self.recipe.numbers_of(shard)

    @contextmanager
    def _lock(self, name: str, wait: bool = False) -> Iterator[bool]:
        """Hold a lock, which the system releases when this process ends, however it ends; whether it is held here."""
        lock = FileLock(self.making / f"{name}.lock", timeout=-1 if wait else 0)
        while not lock.is_locked:
            make_folder(self.making)
            try:
                lock.acquire()
            except Timeout:
                break
            except FileNotFoundError:  # another process has finished, and removed the folder
                continue
        try:
            yield lock.is_locked
        finally:
            lock.release()

    def _is_free(self, shard: int) -> bool:
        with self._lock(f"{shard:06d}") as held:
            return held

    def _is_taken(self) -> bool:
        """Whether a manifest is here that has to stay: not one of other settings by which no shard was ever made."""
        if not (self.folder / MANIFEST).exists():
            return False
        there = read_manifest(self.folder)
        if there.shards or there.recipe.digest == self.recipe.digest or any(self.folder.glob("scans-*")):
            return True
        return not all(self._is_free(int(lock.stem)) for lock in self.making.glob("[0-9]*.lock"))

    def _look(self) -> None:
        """Read the manifest again: another process may have finished it."""
        manifest = read_manifest(self.folder)
        refuse_other(self.folder, "scans", manifest.recipe.describe(), self.recipe.describe(), "--out FOLDER")
        self.finished = manifest.shards

    def _refuse_changed(self, missing: Sequence[int]) -> None:
        """Refuse files that have changed since they became shards; a folder of an older version has noted none."""
        left = {number for shard in missing for number in self.recipe.numbers_of(shard)}
        made = {name: path for number, (name, path) in enumerate(self.plan.files.items()) if number not in left}
        advice = "Give back the scans that it was made of, or prepare these into another folder by --out FOLDER."
        refuse_changed(self.folder, made, "was prepared from it", advice)

    def _note(self, shard: int) -> Path:
        return self.making / f"{shard:06d}.json"

    def _entry(self, shard: int) -> ShardEntry | None:
        """What is known of a shard."""
        if self.finished:
            return self.finished[shard]
        with suppress(OSError, ValueError, TypeError, KeyError):
            note = read_json(self._note(shard))
            if note["recipe"] == self.recipe.digest and note["checksum"] == checksum(note["shard"]):
                return ShardEntry.of(note["shard"])
        return None

    def _is_whole(self, shard: int, level: int = logging.DEBUG) -> bool:
        entry, path = self._entry(shard), self.folder / shard_name(shard)
        damage = damage_of(path, entry) if entry is not None else None
        if damage is not None:
            warn_damaged(path, damage, level)
        return entry is not None and damage is None

    def _write(self, shard: int, scans: Sequence[Coded], left_out: Sequence[int]) -> None:
        data = self._serialised(shard, [scan.codes for scan in scans])
        errors = [*np.max([scan.errors for scan in scans], axis=0).tolist(), 0.0] if scans else [0.0, 0.0]
        entry = ShardEntry(
            scans=len(scans),
            left_out=tuple(left_out),
            bytes=len(data),
            head=zlib.crc32(read_head(BytesIO(data))),
            sha256=hashlib.sha256(data).hexdigest(),
            range_error=errors[0],
            reflectance_error=errors[1],
        )
        path = self.folder / shard_name(shard)
        if self.finished and entry != self.finished[shard]:
            raise InputError(
                f"{path} was damaged, and what it was made of has changed since: prepare all scans into another folder."
            )
        if path.is_dir() and not path.is_symlink():
            raise InputError(f"{path} is a folder where a shard belongs; remove it.")
        if path.is_symlink() and not path.exists():
            path.unlink()
        with atomic_write(path) as file:
            file.write(data)
        if not self.finished:
            note = asdict(entry)
            with atomic_write(self._note(shard), "w") as file:
                json.dump({"recipe": self.recipe.digest, "shard": note, "checksum": checksum(note)}, file)

    def _serialised(self, shard: int, scans: Sequence[Sequence[np.ndarray]]) -> bytes:
        shape = (len(scans), *self.recipe.image_shape)
        tensors: dict[str, np.ndarray] = {
            "crc32": np.array([scan_crc(codes) for codes in scans], np.uint32),
            "range": np.empty(shape, np.uint16),
        }
        if self.recipe.levels is not None:
            tensors["reflectance"] = np.empty(shape, np.uint8)
        for row, codes in enumerate(scans):
            for name, code in zip(("range", "reflectance"), codes, strict=False):
                tensors[name][row] = code
        notes = {
            "recipe": self.recipe.digest,
            "shard": shard,
            "ranges": {"min_range": self.recipe.sensor["min_range"], **self.recipe.ranges},
            "levels": self.recipe.levels,
        }
        return shard_bytes(tensors, "scans", notes)

    def _finish(self) -> Manifest:
        """Turn the notes into the manifest, unless another process has, and clear away what was needed for it."""
        if self.finished and not self.making.exists():
            return read_manifest(self.folder)
        with self._lock("manifest", wait=True):
            self._look()
            if not self.finished:
                shards = tuple(entry for shard in range(self.recipe.shards) if (entry := self._entry(shard)))
                if len(shards) < self.recipe.shards:
                    raise InputError(f"{self.making} was changed meanwhile; the same command goes on.")
                if not any(entry.scans for entry in shards):
                    raise InputError(
                        f"all {self.recipe.scans} scans were left out as unusable; the warnings above say why. Mend "
                        f"them, and remove {self.folder} before it is used again."
                    )
                write_manifest(self.folder, Manifest(self.recipe, self.plan.drives, shards))
            with suppress(OSError):  # another process may have removed the folder, or opened a lock in it
                written = [path for name in (MANIFEST, RECORD) for path in self.folder.glob(f".{name}.*.part")]
                for path in (*written, *self.making.iterdir()):
                    path.unlink(missing_ok=True)
                self.making.rmdir()
        return read_manifest(self.folder)


def _as_it_is(item: Any) -> Any:
    return item
