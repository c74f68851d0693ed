"""Prepared scans: projected once by `r2flow prepare`, then read from memory-mapped shards.

    source = open_scans("prepared/kitti_360").source
    source[0]                       range in metres and reflectance, (2, H, W)
    source.encoded(0, encoding)     the same in model space

A shard is a safetensors file of `range` uint16 (n, H, W), `reflectance` uint8 (n, H, W) where the scans have any, and
`crc32` uint32 (n,). What the codes mean is told by `r2flow.data.quantise` and by the manifest.
"""

import hashlib
import json
import mmap
import os
import zlib
from collections.abc import Callable, Sequence
from functools import cached_property
from io import BufferedReader
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from r2flow.data.manifest import Manifest, ShardEntry, describe_sensor, read_manifest, shard_name
from r2flow.data.quantise import RangeCodes, ReflectanceCodes
from r2flow.data.sources import ScanSource
from r2flow.data.store import MANIFEST, Damaged, difference
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor

AGAIN = "The same r2flow prepare command makes it again."


def find_prepared(folder: Path, sensor: Sensor, projection: str, convention: str) -> Manifest:
    """The manifest of a folder that `r2flow prepare` has written; of its shards only the heads are read.

    Args:
        sensor, projection, convention: The run's. Nothing is projected here: they must be those of the shards.

    Raises:
        InputError: no prepared scans, unfinished or damaged ones, or ones of another sensor, size, projection or
            convention.
    """
    manifest = read_manifest(folder)
    if manifest.shards is None:
        raise InputError(f"{folder} is not finished: the same r2flow prepare command goes on.")
    _refuse_other_images(folder, manifest, sensor, projection, convention)
    for shard, entry in enumerate(manifest.shards):
        path = folder / shard_name(shard)
        try:
            with _open_shard(path, entry):
                pass
        except Damaged as error:
            raise InputError(f"{path} is damaged ({error}). {AGAIN}") from None
    return manifest


def check_prepared(folder: Path, advance: Callable[[], None] = lambda: None) -> dict[Path, str]:
    """Read every byte of every shard: the damaged ones and what is wrong with them.

    Raises:
        InputError: there is no finished manifest to hold them to.
    """
    manifest = read_manifest(folder)
    if manifest.shards is None:
        raise InputError(f"{folder} is not finished: the same r2flow prepare command checks it and goes on.")
    damaged = {}
    for shard, entry in enumerate(manifest.shards):
        try:
            check_shard(folder / shard_name(shard), entry)
        except Damaged as error:
            damaged[folder / shard_name(shard)] = str(error)
        advance()
    return damaged


def check_shard(path: Path, entry: ShardEntry) -> None:
    """Read every byte of a shard.

    Raises:
        Damaged: it is not there, or not what was written.
    """
    with _open_shard(path, entry) as file:
        file.seek(0)
        if hashlib.file_digest(file, "sha256").hexdigest() != entry.sha256:
            raise Damaged("its checksum differs")


def read_head(file: IO[bytes]) -> bytes:
    """A safetensors file up to its first tensor: the length of its header, and the header."""
    length = file.read(8)
    return length + file.read(min(int.from_bytes(length, "little"), 2**20))


def _open_shard(path: Path, entry: ShardEntry) -> BufferedReader:
    """A shard of the right length with an unharmed head, open behind this head."""
    if path.is_dir():
        raise Damaged("it is a folder")
    if not path.exists():
        raise Damaged("it links to nothing" if path.is_symlink() else "it is missing")
    size = path.stat().st_size
    if not path.is_file() or size != entry.bytes:
        raise Damaged(f"it has {size} bytes, not {entry.bytes}")
    try:
        file = open(path, "rb")  # noqa: SIM115  the caller closes it
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    try:
        if zlib.crc32(read_head(file)) != entry.head:
            raise Damaged("its head is not what was written")
    except BaseException:
        file.close()
        raise
    return file


def _refuse_other_images(folder: Path, manifest: Manifest, sensor: Sensor, projection: str, convention: str) -> None:
    recipe = manifest.recipe
    there = {**recipe.sensor, "projection": recipe.projection, "convention": recipe.convention}
    here = {**describe_sensor(sensor), "projection": projection, "convention": convention}
    # An image is the same whatever these are; the order of the lasers matters where rows are found by it.
    irrelevant = {"name", "height"} if projection == "unfolding" else {"name", "height", "firing"}
    found = difference(*({k: v for k, v in one.items() if k not in irrelevant} for one in (there, here)))
    if found:
        rows, columns = recipe.image_shape
        raise InputError(
            f"{folder} was prepared for other images (sensor {recipe.sensor['name']}, {rows}x{columns}, "
            f"{recipe.projection}, {recipe.convention}): {found}. Give the run the same, or prepare the scans for it."
        )


class PreparedScans(ScanSource):
    """Scans of shards as a source. Every scan that is read is compared with its checksum.

    Attributes:
        folder: Where the shards lie.
        manifest: What they are.
        rows: Number of each scan among all that the shards hold.

    Raises:
        InputError: reflectance is wanted, and the shards have none.
    """

    def __init__(self, folder: Path, manifest: Manifest, rows: np.ndarray, reflectance: bool = True) -> None:
        assert manifest.shards is not None
        if reflectance and manifest.recipe.levels is None:
            raise InputError(
                f"{folder} holds scans without reflectance. Set encoding.reflectance=false for range alone."
            )
        self.folder, self.manifest, self.rows, self.reflectance = folder, manifest, rows, reflectance
        recipe = manifest.recipe
        self._ends = np.cumsum([entry.scans for entry in manifest.shards])
        self._metres = [RangeCodes(recipe.sensor["min_range"], recipe.sensor["max_range"]).metres]
        if reflectance and recipe.levels is not None:
            self._metres.append(ReflectanceCodes(recipe.levels).values)
        self._encoding: Encoding | None = None
        self._model: list[np.ndarray] = []
        self._opened: dict[int, _Shard] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}  # memory maps stay in their process

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
        """Of each scan: its path in the data set."""
        left_out = self.manifest.left_out
        held = [name for number, name in enumerate(self.manifest.names) if number not in left_out]
        return [held[row] for row in self.rows]

    def subset(self, indices: Sequence[int]) -> "PreparedScans":
        rows = self.rows[np.asarray(indices, dtype=np.int64)]
        return PreparedScans(self.folder, self.manifest, rows, self.reflectance)

    @property
    def drives(self) -> dict[str, list[int]]:  # type: ignore[override]
        place = {name: number for number, name in enumerate(self.names)}
        found = {d.name: [place[n] for n in d.scans if n in place] for d in self.manifest.drives}
        return {drive: numbers for drive, numbers in found.items() if numbers}

    def about(self) -> dict[str, Any]:
        kind = f"prepared {self.manifest.recipe.layout}"
        return {"kind": kind, "manifest": self._digest[:12], "reflectance": self.reflectance}

    def identity(self) -> dict[str, Any]:
        rows = hashlib.sha256(self.rows.astype(np.int64).tobytes()).hexdigest()
        return {"manifest": self._digest, "rows": rows, "reflectance": self.reflectance}

    @cached_property
    def _digest(self) -> str:
        return hashlib.sha256((self.folder / MANIFEST).read_bytes()).hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.folder)
        return {os.path.join(real, name) for name in self.names}

    def __getitem__(self, index: int) -> np.ndarray:
        """Range in metres and, where wanted, reflectance: (2 or 1, H, W) float32."""
        return self._looked_up(index, self._metres)

    def encoded(self, index: int, encoding: Encoding) -> Tensor:
        """`encoding.encode` of a scan, bit for bit, (C, H, W), where `encoding` is of this source's sensor.

        Where a channel depends on its own code alone there are no more values than codes: encoded once, looked up
        from then on.
        """
        if encoding.format.channels != 1 or encoding.reflectance != self.reflectance:
            return encoding.encode(torch.from_numpy(self[index]))
        if self._encoding is not encoding:
            self._encoding, self._model = encoding, _encoded_tables(encoding, self._metres)
        return torch.from_numpy(self._looked_up(index, self._model))

    def _looked_up(self, index: int, tables: Sequence[np.ndarray]) -> np.ndarray:
        row = int(self.rows[index])
        shard = int(np.searchsorted(self._ends, row, side="right"))
        path = self.folder / shard_name(shard)
        entries = self.manifest.shards
        assert entries is not None
        try:
            if shard not in self._opened:
                self._opened[shard] = _Shard(path, entries[shard], self.manifest.recipe.image_shape)
            codes = self._opened[shard].codes(row - int(self._ends[shard]) + entries[shard].scans)
        except Damaged as error:
            raise InputError(f"{path} is damaged ({error}). {AGAIN}") from None
        image = np.empty((len(tables), *self.manifest.recipe.image_shape), dtype=np.float32)
        for channel, (table, code) in enumerate(zip(tables, codes, strict=False)):
            # No index is out of bounds, and "clip" spares the check: a code has as many values as its table.
            np.take(table, code, out=image[channel], mode="clip")
        return image


def _encoded_tables(encoding: Encoding, metres: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The tables of codes in model space: encoded as an image that shows every code."""
    side = 256
    image = np.stack([metres[0].reshape(side, side), *(np.tile(table, (side, 1)) for table in metres[1:])])
    encoded = encoding.encode(torch.from_numpy(image)).numpy()
    return [encoded[0].reshape(-1).copy(), *(channel[0].copy() for channel in encoded[1:])]


class _Shard:
    """A memory-mapped shard.

    Raises:
        Damaged: its length or its head are not what was written.
    """

    def __init__(self, path: Path, entry: ShardEntry, shape: tuple[int, int]) -> None:
        with _open_shard(path, entry) as file:
            self.map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            file.seek(0)
            head = read_head(file)
        self.bytes = entry.bytes
        tensors = json.loads(head[8:])

        def tensor(name: str, dtype: str, *size: int) -> np.ndarray:
            offset, count = len(head) + tensors[name]["data_offsets"][0], int(np.prod(size))
            return np.frombuffer(self.map, dtype, count, offset).reshape(size)

        self.crc32 = tensor("crc32", "<u4", entry.scans)
        self.images = [tensor("range", "<u2", entry.scans, *shape)]
        if "reflectance" in tensors:
            self.images.append(tensor("reflectance", "u1", entry.scans, *shape))

    def codes(self, row: int) -> list[np.ndarray]:
        """Codes of range and, where there is any, of reflectance, (H, W) each.

        Raises:
            Damaged: they are not what was written.
        """
        # Reading behind the end of a file that was cut meanwhile kills the process.
        if self.map.size() != self.bytes:
            raise Damaged(f"it has {self.map.size()} bytes, not {self.bytes}")
        codes = [image[row] for image in self.images]
        if scan_crc(codes) != self.crc32[row]:
            raise Damaged(f"the checksum of scan {row} in it differs")
        return codes


def scan_crc(codes: Sequence[np.ndarray]) -> int:
    """CRC-32 of one scan: its codes of range, then those of reflectance."""
    crc = 0
    for code in codes:
        crc = zlib.crc32(np.ascontiguousarray(code).data, crc)
    return crc
