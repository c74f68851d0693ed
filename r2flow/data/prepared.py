"""Prepared scans: projected once by `r2flow prepare`, then read from memory-mapped shards.

    source = open_scans("prepared/kitti_360").source
    source[0]                       range in metres and reflectance, (2, H, W)
    source.encoded(0, encoding)     the same in model space

A shard is a safetensors file of `range` uint16 (n, H, W), `reflectance` uint8 (n, H, W) where the scans have any, and
`crc32` uint32 (n,). What the codes mean is told by `r2flow.data.quantise` and by `manifest.json`.
"""

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from io import BufferedReader
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

import r2flow
from r2flow.data.layouts import Drive
from r2flow.data.quantise import RangeCodes, ReflectanceCodes
from r2flow.data.sources import ScanSource
from r2flow.data.store import MANIFEST, Damaged, difference, shard_count, shard_items
from r2flow.errors import InputError
from r2flow.files import atomic_write, read_json
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor

FORMAT = "r2flow scans 1"


# What a folder says of itself


@dataclass(frozen=True)
class ScanRecipe:
    """What prepared scans are a function of, beside the files themselves; nothing in it tells where these lie."""

    revision: int  # `preparing.PROJECTION` or the simulator's: a newer r2flow mends damaged shards of an older one
    layout: str  # of the data set, or `simulated`
    scans: int
    names: str  # SHA-256 of the names of the scans
    sensor: dict[str, Any]  # `Sensor.described`
    projection: str  # as in `r2flow.data.reading.Reading`, like the next two
    convention: str
    reflectance_scale: float
    levels: int | None  # code n of reflectance is n / levels; None where the scans have none
    ranges: dict[str, float]  # the numbers of the formula in `r2flow.data.quantise.RangeCodes`
    shard_scans: int  # scans of the data set a shard; it holds fewer where some were left out
    seed: int | None = None  # of simulated scans
    columns: tuple[str, ...] | None = None  # of files that do not name them

    def describe(self) -> dict[str, Any]:
        """All of it as plain values; `columns` only where they were named."""
        return {key: value for key, value in asdict(self).items() if key != "columns" or value is not None}

    @property
    def digest(self) -> str:
        return checksum(self.describe())

    @property
    def image_shape(self) -> tuple[int, int]:
        """(H, W)."""
        return len(self.sensor["elevations"]), self.sensor["columns"]

    @property
    def codes(self) -> list[RangeCodes | ReflectanceCodes]:
        """The codes of range and, where the scans have it, of reflectance."""
        ranges = RangeCodes(self.sensor["min_range"], self.sensor["max_range"])
        return [ranges] if self.levels is None else [ranges, ReflectanceCodes(self.levels)]

    @property
    def shards(self) -> int:
        return shard_count(self.scans, self.shard_scans)

    def numbers_of(self, shard: int) -> range:
        """The scans of the data set that a shard is made of."""
        return shard_items(shard, self.scans, self.shard_scans)


@dataclass(frozen=True)
class ShardEntry:
    """What is known of a shard that was written."""

    scans: int  # that it holds
    left_out: tuple[int, ...]  # numbers of those that could not be used
    bytes: int  # of the file
    head: int  # CRC-32 of the file up to its first tensor
    sha256: str  # of the whole file
    range_error: float  # the most that a range is off, in metres
    reflectance_error: float  # the most that a reflectance is off

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "ShardEntry":
        return cls(**{**content, "left_out": tuple(content["left_out"])})


@dataclass(frozen=True)
class Manifest:
    """Prepared scans: their recipe, the names of the data set's scans by drive, and the shards once all are there."""

    recipe: ScanRecipe
    drives: tuple[Drive, ...]
    shards: tuple[ShardEntry, ...] = ()

    @cached_property
    def left_out(self) -> frozenset[int]:
        return frozenset(number for shard in self.shards for number in shard.left_out)

    @property
    def names(self) -> list[str]:
        """Of all scans of the data set, also those that were left out."""
        return [name for drive in self.drives for name in drive.scans]


def shard_name(shard: int) -> str:
    return f"scans-{shard:06d}.safetensors"


def checksum(content: Any) -> str:
    """SHA-256 of what can be written as JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def describe_sensor(sensor: Sensor) -> dict[str, Any]:
    """What a sensor's images depend on, as JSON gives it back."""
    fields: dict[str, Any] = json.loads(json.dumps(sensor.described()))
    return fields


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Names of a drive share their beginning, which is written once."""
    drives = []
    for drive in manifest.drives:
        prefix = os.path.commonprefix(drive.scans)  # noqa: RUF071  of letters, not of folders
        drives.append({"name": drive.name, "prefix": prefix, "scans": [name[len(prefix) :] for name in drive.scans]})
    content = {
        "format": FORMAT,
        "made by": f"r2flow {r2flow.__version__}",
        "recipe": manifest.recipe.describe(),
        "left_out": [name for number, name in enumerate(manifest.names) if number in manifest.left_out],
        "shards": [asdict(shard) for shard in manifest.shards] or None,
        "drives": drives,
    }
    content["checksum"] = checksum(content)
    with atomic_write(folder / MANIFEST, "w") as file:
        json.dump(content, file, indent=1)


def read_manifest(folder: Path, finished: bool = False) -> Manifest:
    """The manifest of a folder, checked; with `finished`, of one that has all its shards.

    Raises:
        InputError: it is not there, cannot be read, is of another format, damaged, or not finished.
    """
    path = folder / MANIFEST
    damaged = InputError(f"{path} is damaged. Delete its folder and prepare the scans again.")
    try:
        content = read_json(path)
        found = content["format"]
    except FileNotFoundError:
        raise InputError(f"{folder} holds no prepared scans (no {MANIFEST}); make them: r2flow prepare.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError):
        raise damaged from None
    if found != FORMAT:
        raise InputError(f"{path} is of the format {found!r}, not {FORMAT!r}; prepare the scans again.")
    if content.pop("checksum", None) != checksum(content):
        raise damaged
    if finished and not content["shards"]:
        raise InputError(f"{folder} is not finished: the same r2flow prepare command goes on.")
    return Manifest(
        ScanRecipe(**content["recipe"]),
        tuple(Drive(d["name"], tuple(d["prefix"] + rest for rest in d["scans"])) for d in content["drives"]),
        tuple(ShardEntry.of(shard) for shard in content["shards"] or ()),
    )


# Checking


def find_prepared(folder: Path, sensor: Sensor, projection: str, convention: str) -> Manifest:
    """The manifest of a folder that `r2flow prepare` has written; of its shards only the heads are read.

    Raises:
        InputError: no prepared scans, unfinished or damaged ones, or ones of another sensor, size, projection or
            convention than the given: nothing is projected here.
    """
    manifest = read_manifest(folder, finished=True)
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
    for shard, entry in enumerate(manifest.shards):
        path = folder / shard_name(shard)
        try:
            with _opened(path, entry):
                pass
        except Damaged as error:
            raise _to_be_made_again(path, error) from None
    return manifest


def check_prepared(folder: Path, advance: Callable[[], None] = lambda: None) -> dict[Path, str]:
    """Read every byte of every shard: the damaged ones and what is wrong with them."""
    damaged = {}
    for shard, entry in enumerate(read_manifest(folder, finished=True).shards):
        path = folder / shard_name(shard)
        if damage := damage_of(path, entry):
            damaged[path] = damage
        advance()
    return damaged


def damage_of(path: Path, entry: ShardEntry) -> str | None:
    """What is wrong with a shard, of which every byte is read; None where it is what was written."""
    try:
        with _opened(path, entry) as file:
            file.seek(0)
            same = hashlib.file_digest(file, "sha256").hexdigest() == entry.sha256
    except Damaged as error:
        return str(error)
    return None if same else "its checksum differs"


def read_head(file: IO[bytes]) -> bytes:
    """A safetensors file up to its first tensor: the length of its header, and the header."""
    length = file.read(8)
    return length + file.read(min(int.from_bytes(length, "little"), 2**20))


def scan_crc(codes: Sequence[np.ndarray]) -> int:
    """CRC-32 of one scan: its codes of range, then those of reflectance."""
    crc = 0
    for code in codes:
        crc = zlib.crc32(np.ascontiguousarray(code).data, crc)
    return crc


@contextmanager
def _opened(path: Path, entry: ShardEntry) -> Iterator[BufferedReader]:
    """A shard of the right length with an unharmed head, open behind this head."""
    if not path.is_file():
        raise Damaged("it is missing, or no file")
    try:
        file = open(path, "rb")  # noqa: SIM115  closed below; only what opening it raises is meant
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    with file:
        size = os.fstat(file.fileno()).st_size
        if size != entry.bytes:
            raise Damaged(f"it has {size} bytes, not {entry.bytes}")
        if zlib.crc32(read_head(file)) != entry.head:
            raise Damaged("its head is not what was written")
        yield file


def _to_be_made_again(path: Path, error: Damaged) -> InputError:
    return InputError(f"{path} is damaged ({error}). The same r2flow prepare command makes it again.")


# Reading


class PreparedScans(ScanSource):
    """Scans of shards as a source, `rows` being their numbers among all that the shards hold.

    Every scan that is read is compared with its checksum.
    """

    def __init__(self, folder: Path, manifest: Manifest, rows: np.ndarray, reflectance: bool = True) -> None:
        self.folder, self.manifest, self.rows, self.reflectance = folder, manifest, rows, reflectance
        self._ends = np.cumsum([entry.scans for entry in manifest.shards])
        if reflectance and manifest.recipe.levels is None:
            raise InputError(
                f"{folder} holds scans without reflectance. Set encoding.reflectance=false for range alone."
            )
        self._values = [codes.values for codes in manifest.recipe.codes[: 1 + reflectance]]
        self._encoding: Encoding | None = None
        self._model: list[np.ndarray] = []
        self._shards: dict[int, _Shard] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_shards": {}}  # memory maps stay in their process

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
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

    def files(self) -> dict[str, str | Path]:
        return {MANIFEST: self.folder / MANIFEST}  # which holds the checksums of all shards

    def places(self) -> set[str]:
        real = os.path.realpath(self.folder)
        return {os.path.join(real, name) for name in self.names} | super().places()

    def simulated_scenes(self) -> dict[int, Sequence[int]]:
        recipe = self.manifest.recipe
        if recipe.seed is None:
            return {}
        return {recipe.seed: [int(name.rpartition(" ")[2]) for name in self.names]}

    def __getitem__(self, index: int) -> np.ndarray:
        return self._looked_up(index, self._values)

    def encoded(self, index: int, encoding: Encoding) -> Tensor:
        """`encoding.encode` of a scan, bit for bit, (C, H, W), where `encoding` is of this source's sensor.

        Where a channel depends on its own code alone there are no more values than codes: encoded once, looked up
        from then on.
        """
        if encoding.format.channels != 1 or encoding.reflectance != self.reflectance:
            return super().encoded(index, encoding)
        if self._encoding is not encoding:
            # The tables of codes, encoded as an image that shows every code.
            ranges, *values = self._values
            image = np.stack([ranges.reshape(256, 256), *(np.tile(table, (256, 1)) for table in values)])
            first, *others = encoding.encode(torch.from_numpy(image)).numpy()
            self._encoding, self._model = encoding, [first.ravel().copy(), *(one[0].copy() for one in others)]
        return torch.from_numpy(self._looked_up(index, self._model))

    def _looked_up(self, index: int, tables: Sequence[np.ndarray]) -> np.ndarray:
        row, shape = int(self.rows[index]), self.manifest.recipe.image_shape
        shard = int(np.searchsorted(self._ends, row, side="right"))
        path, entry = self.folder / shard_name(shard), self.manifest.shards[shard]
        try:
            if shard not in self._shards:
                self._shards[shard] = _Shard(path, entry)
            codes = self._shards[shard].codes(row - int(self._ends[shard]) + entry.scans)
        except Damaged as error:
            raise _to_be_made_again(path, error) from None
        image = np.empty((len(tables), *shape), dtype=np.float32)
        for channel, (table, code) in enumerate(zip(tables, codes, strict=False)):
            # No index is out of bounds, and "clip" spares the check: a code has as many values as its table.
            np.take(table, code, out=image[channel], mode="clip")
        return image


class _Shard:
    """A memory-mapped shard; raises `Damaged` where it is not what was written."""

    def __init__(self, path: Path, entry: ShardEntry) -> None:
        with _opened(path, entry):
            self.file = open(path, "rb")  # noqa: SIM115  its length is looked at before each scan
        self.bytes, tensors = entry.bytes, safe_open(path, framework="numpy")
        self.crc32, there = tensors.get_tensor("crc32"), set(tensors.keys())
        self.images = [tensors.get_slice(name) for name in ("range", "reflectance") if name in there]

    def codes(self, row: int) -> list[np.ndarray]:
        """Codes of range and, where there is any, of reflectance, (H, W) each."""
        # Reading behind the end of a file that was cut meanwhile kills the process.
        size = os.fstat(self.file.fileno()).st_size
        if size != self.bytes:
            raise Damaged(f"it has {size} bytes, not {self.bytes}")
        codes: list[np.ndarray] = [image[row : row + 1][0] for image in self.images]
        if scan_crc(codes) != self.crc32[row]:
            raise Damaged(f"the checksum of scan {row} in it differs")
        return codes
