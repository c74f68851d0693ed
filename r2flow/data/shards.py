"""Pairs on disk: batches as they are made, shards when a row of them is whole."""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import MISSING, asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from r2flow.data.store import (
    MANIFEST,
    Damaged,
    clear_leftovers,
    refuse_other,
    shard_bytes,
    shard_count,
    shard_items,
    warn_damaged,
)
from r2flow.errors import InputError
from r2flow.files import atomic_write, parse_json, read_json
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.scan_files import FIRM_ENDINGS

ELSEWHERE = "data.root=FOLDER (r2flow pairs --out FOLDER)"  # how another folder is given
FORMAT = "r2flow pairs 1"
STALE = 3600  # seconds after which a temporary file has no writer any more


@dataclass(frozen=True)
class PairRecipe:
    """What a pair is a function of, beside its index: two folders of one recipe hold the same bytes."""

    parent: str  # hash of the flow's weights and of what they mean
    shape: tuple[int, int, int]  # (C, H, W) of a scan in model space
    seed: int  # x_0 of index i is the noise of (seed, "pairs", i); it is never stored
    first: int  # index of the first pair
    method: str  # the solver's, like steps and tolerance
    steps: int
    tolerance: float
    batch_size: int  # consecutive indices that are solved together
    shard_batches: int  # batches in a shard
    noise_shape: tuple[int, ...] | None = None  # of x_0, where it is not the scan's
    grid: str = "uniform"  # where fixed steps fall
    knots: int = 0  # inner states of each path that are kept with it
    precision: Precision = "32-true"  # of the network

    def describe(self) -> dict[str, Any]:
        """All of it as plain values; what pairs of older versions did not have only where it is not as it was then, the
        default."""
        then = {f.name: f.default for f in fields(self)}
        return {key: value for key, value in asdict(self).items() if value != then[key]}

    @property
    def sampler(self) -> Sampler:
        """How the generator is run."""
        return Sampler(self.method, self.steps, self.tolerance, self.grid).changed(precision=self.precision)

    @cached_property
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.describe(), sort_keys=True).encode()).hexdigest()[:16]


NO_KNOTS = np.empty(0, np.float16)


class Block(NamedTuple):
    """Consecutive pairs.

    Attributes:
        x_1: (n, C, H, W) float16.
        evaluations: (n,) int32.
        usable: (n,) bool.
        knots: Inner states of each path, (n, K, C, H, W) float16, at `r2flow.flow.solvers.knot_times`; or none.
    """

    x_1: np.ndarray
    evaluations: np.ndarray
    usable: np.ndarray
    knots: np.ndarray = NO_KNOTS

    def with_knots(self, knots: Tensor | None) -> "Block":
        """With inner states, (n, K, C, H, W); a path with one that half precision cannot hold is not usable."""
        assert knots is not None
        kept = knots.to(torch.float16).cpu()
        return self._replace(knots=kept.numpy(), usable=self.usable & kept.isfinite().flatten(1).all(1).numpy())

    @property
    def checksum(self) -> str:
        digest = hashlib.sha256(self.usable.astype(bool).tobytes())
        for values in (self.evaluations, self.x_1, self.knots):
            digest.update(np.ascontiguousarray(values).data)
        return digest.hexdigest()


class _Unwanted(Exception):
    """What was about to be written is there already."""


class PairStore:
    """A folder of pairs: `manifest.json`, shards, and the batches of shards that are not whole yet.

    Batch b holds indices first + [b B, (b + 1) B), shard s holds batches [s S, (s + 1) S). Every file is written under
    a temporary name, flushed and renamed, and carries the checksum of its tensors and the digest of its recipe. Any
    number of processes may write into one folder: what two of them write under one name are the same bytes.

    Raises:
        InputError: the folder holds other pairs, or a damaged manifest.
    """

    def __init__(self, folder: str | Path, recipe: PairRecipe) -> None:
        self.folder, self.recipe = Path(folder).expanduser(), recipe
        self.staging = self.folder / "batches"
        self._check_manifest()

    def _check_manifest(self) -> None:
        path = self.folder / MANIFEST
        if not path.is_file():
            scan = next((one for one in self.folder.glob("*") if one.name.endswith(FIRM_ENDINGS)), None)
            if scan is not None:
                raise InputError(
                    f"{self.folder} holds scans ({scan.name}), and pairs are kept in a folder of their own: give "
                    f"another by {ELSEWHERE}."
                )
            return
        try:
            content = read_json(path)
            kind, found = content.get("format", FORMAT), dict(content["recipe"])
        except (ValueError, KeyError, TypeError, AttributeError):
            raise InputError(f"{path} is damaged. Delete it: the shards beside it know their recipe.") from None
        if kind != FORMAT:
            raise InputError(
                f"{self.folder} is of the format {kind!r}, and pairs are kept in a folder of their own: give another "
                f"by {ELSEWHERE}."
            )
        then = {f.name: f.default for f in fields(PairRecipe) if f.default is not MISSING and f.name not in found}
        refuse_other(self.folder, "pairs", found | then, asdict(self.recipe), ELSEWHERE)

    def begin(self) -> None:
        """Write the manifest where there is none, and clear away what killed writers left."""
        content = {"format": FORMAT, "recipe": self.recipe.describe(), "digest": self.recipe.digest}
        try:
            if not (self.folder / MANIFEST).is_file():
                with atomic_write(self.folder / MANIFEST, "w") as file:
                    json.dump(content, file, indent=2)
        except PermissionError:
            raise InputError(f"{self.folder} cannot be written to; give another folder by {ELSEWHERE}.") from None
        self._check_manifest()
        # Another process may be writing the younger ones.
        clear_leftovers((*self.folder.glob(".*.part"), *self.staging.glob(".*.part")), STALE)

    def shard_path(self, shard: int) -> Path:
        return self.folder / f"pairs-{shard:06d}.safetensors"

    def batch_path(self, batch: int) -> Path:
        return self.staging / f"{batch:09d}.safetensors"

    def batches(self, num: int) -> range:
        """The batches that hold the first `num` pairs; the last one is made whole."""
        return range(shard_count(num, self.recipe.batch_size))

    def shards(self, num: int) -> range:
        return range(shard_count(len(self.batches(num)), self.recipe.shard_batches))

    def batches_of(self, shard: int, num: int) -> range:
        return shard_items(shard, len(self.batches(num)), self.recipe.shard_batches)

    def held(self, shard: int) -> int:
        """How many batches a shard's file holds, by its head; a whole shard of other pairs is refused."""
        try:
            with self._opened(self.shard_path(shard)) as (_, notes):
                return len(notes["usable"]) // self.recipe.batch_size
        except (Damaged, FileNotFoundError):
            return 0

    def usable(self, num: int) -> np.ndarray:
        """Whether each of the first `num` pairs came to an end, (num,) bool; their shards must be there."""
        flags = []
        for shard in self.shards(num):
            with self._opened(self.shard_path(shard)) as (_, notes):
                flags += notes["usable"]
        return np.array(flags[:num], dtype=bool)

    def has(self, batch: int) -> bool:
        """Whether a batch is there, by itself or in its shard; its bytes are not read."""
        shard, offset = divmod(batch, self.recipe.shard_batches)
        return self.batch_path(batch).is_file() or offset < self.held(shard)

    def missing(self, num: int) -> list[int]:
        """The batches that have yet to be made."""
        return [batch for shard in self.shards(num) for batch in self._missing_of(shard, num)]

    def _missing_of(self, shard: int, num: int) -> list[int]:
        rest = self.batches_of(shard, num)[self.held(shard) :]
        return [batch for batch in rest if not self.batch_path(batch).is_file()]

    def is_sealed(self, shard: int, num: int) -> bool:
        """Whether a shard's file holds all that the first `num` pairs ask of it."""
        return self.held(shard) >= len(self.batches_of(shard, num))

    def is_whole(self, num: int) -> bool:
        return all(self.is_sealed(shard, num) for shard in self.shards(num))

    def check(self, shard: int, num: int) -> list[int]:
        """Read every byte of one shard and its loose batches; the batches that were damaged, now removed."""
        batches = self.batches_of(shard, num)
        loose = [(self.batch_path(batch), range(batch, batch + 1)) for batch in batches]
        lost: set[int] = set()
        for path, held in [(self.shard_path(shard), batches), *loose]:
            try:
                self._read(path, held[0])
            except FileNotFoundError:
                continue
            except Damaged as error:
                warn_damaged(path, error)
                path.unlink(missing_ok=True)
                lost |= set(held)
        return sorted(batch for batch in lost if not self.has(batch))

    def commit(self, batch: int, block: Block) -> None:
        """Keep a batch: from here on it is not made again."""
        self._write(self.batch_path(batch), batch, block)

    def seal(self, shard: int, num: int) -> bool:
        """Turn the batches of a shard into its one file, once all are there."""
        if self.is_sealed(shard, num):
            self._clear(shard, num)
            return True
        batches = self.batches_of(shard, num)
        if self._missing_of(shard, num):
            return False
        try:
            blocks = self._gather(shard, batches)
        except FileNotFoundError:  # another process sealed it in between
            return self.is_sealed(shard, num)
        except Damaged:
            self.check(shard, num)
            return False
        whole = Block(*(np.concatenate(part) for part in zip(*blocks, strict=True)))
        # A process that was asked for more pairs may have sealed a longer one meanwhile.
        self._write(self.shard_path(shard), batches[0], whole, unless=lambda: self.is_sealed(shard, num))
        self._clear(shard, num)
        return True

    def _gather(self, shard: int, batches: range) -> list[Block]:
        held, count = [], 0
        if self.shard_path(shard).is_file():  # shorter: fewer pairs were asked for then
            held = [self._read(self.shard_path(shard), batches[0])]
            count = len(held[0].usable) // self.recipe.batch_size
        return held + [self._read(self.batch_path(batch), batch) for batch in batches[count:]]

    def _clear(self, shard: int, num: int) -> None:
        for batch in self.batches_of(shard, num):
            self.batch_path(batch).unlink(missing_ok=True)
        with suppress(OSError):
            self.staging.rmdir()

    def _write(self, path: Path, batch: int, block: Block, unless: Callable[[], bool] = lambda: False) -> None:
        notes = {
            "recipe": self.recipe.digest,
            "first": self.recipe.first + batch * self.recipe.batch_size,
            "usable": [int(one) for one in block.usable],
            "sha256": block.checksum,
        }
        tensors = {"evaluations": block.evaluations, "x_1": block.x_1}
        if self.recipe.knots:
            tensors["knots"] = block.knots
        data = shard_bytes(tensors, "pairs", notes)
        with suppress(_Unwanted), atomic_write(path) as file:
            file.write(data)
            if unless():
                raise _Unwanted

    @contextmanager
    def _opened(self, path: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
        """A file of pairs, and what it says of itself: its head is read, and the file's length held to it.

        Raises:
            FileNotFoundError: no such file.
            Damaged: whatever else goes wrong in reading it.
            InputError: it is a whole file of other pairs.
        """
        if not path.is_file():
            raise FileNotFoundError(path)
        try:
            with safe_open(path, framework="numpy") as file:
                notes: dict[str, Any] = parse_json((file.metadata() or {})["pairs"])
                recipe, *_ = (notes[key] for key in ("recipe", "first", "usable", "sha256"))
                if recipe != self.recipe.digest:
                    raise InputError(
                        f"{path} holds pairs of another recipe. Give the settings that they were made with, or another "
                        f"folder by {ELSEWHERE}."
                    )
                yield file, notes
        except (FileNotFoundError, InputError):
            raise
        except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
            raise Damaged(str(error)) from None

    def _read(self, path: Path, batch: int) -> Block:
        """A file that begins with a batch, every byte of it checked."""
        with self._opened(path) as (file, notes):
            x_1, evaluations = file.get_tensor("x_1"), file.get_tensor("evaluations")
            knots = file.get_tensor("knots") if self.recipe.knots else NO_KNOTS
            block = Block(x_1, evaluations, np.array(notes["usable"], dtype=bool), knots)
        if notes["first"] != self.recipe.first + batch * self.recipe.batch_size:
            raise Damaged(f"it begins with pair {notes['first']}")
        if notes["sha256"] != block.checksum or len(block.usable) != len(block.x_1):
            raise Damaged("its checksum differs")
        return block
