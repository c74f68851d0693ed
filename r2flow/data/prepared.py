"""Prepared scans: projected once by `r2flow prepare`, then read from memory-mapped shards.

    source = open_scans("prepared/kitti_360").source
    source[0]                       range in metres and reflectance, (2, H, W)

A shard is an item of `r2flow.store`: `range` uint16 (n, H, W) and, if the scans have it, `reflectance` uint8 (n, H, W),
in the codes of `r2flow.data.quantise`.
"""

import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

from r2flow.config import at_most_three, differences
from r2flow.data.layouts import Drive
from r2flow.data.quantise import OTHER_LEVELS, Codes, find_levels, fits, range_codes, reflectance_codes
from r2flow.data.reading import Reading, lacks_reflectance, stored_reflectance
from r2flow.data.sources import ScanFiles, ScanSource, spread, warn_of_other_sensor
from r2flow.errors import InputError, check
from r2flow.lidar.scan_files import read_range_image
from r2flow.store import MANIFEST, Advance, Damaged, Store, checksum, read_manifest

log = logging.getLogger(__name__)

KIND = "scans"
CHANNELS = ("range", "reflectance")
SHARD_SCANS = 64  # 13 MB at 64 x 1024, held in memory until written
PROBED = 8  # number of scans read to determine the levels of reflectance
PROJECTION = 2  # revision; increase it when the same files give different images or codes


# Making


@dataclass(frozen=True)
class Plan:
    """The scans to prepare, by drive, and the recipe of their store."""

    recipe: Mapping[str, Any]
    drives: tuple[Drive, ...]
    source: ScanSource

    def store(self, folder: str | Path) -> Store:
        return Store(folder, KIND, self.recipe)

    @property
    def shards(self) -> range:
        return range(len(shards_of(self.recipe)))


def plan_files(
    layout: str,
    root: str | Path,
    drives: Sequence[Drive],
    reading: Reading,
    shard_scans: int = SHARD_SCANS,
) -> Plan:
    """Plan scan files in drives below a root; some scans are read to determine the levels of reflectance."""
    root = Path(root).expanduser()
    paths = [path for drive in drives for path in drive.scans]
    named = tuple(Drive(d.name, tuple(Path(os.path.relpath(p, root)).as_posix() for p in d.scans)) for d in drives)
    reading = replace(reading, on_bad_scan="error", within_limits=True)
    warn_of_other_sensor(paths, reading, root)
    levels = _reflectance_levels(paths, reading)
    reading = replace(reading, reflectance=levels is not None)
    names = [name for drive in named for name in drive.scans]
    recipe = {
        "revision": PROJECTION, "layout": layout, "scans": len(names), "names": checksum(names),
        "reading": reading.described(), "levels": levels, "shard_scans": shard_scans,
    }  # fmt: skip
    return Plan(recipe, named, ScanFiles(paths, reading, root))


def _reflectance_levels(paths: Sequence[str], reading: Reading) -> int | None:
    """Levels of reflectance; None if the scans lack reflectance."""
    if lacks_reflectance(paths, "skip", reading.columns) is not None:
        return None
    samples, scale, images = [], reading.reflectance_scale or 1.0, False
    for index in spread(len(paths), PROBED):
        with suppress(InputError):  # reported when the scan is prepared
            reflectance = stored_reflectance(paths[index], reading.columns)
            if reflectance is not None:
                is_image = read_range_image(paths[index]) is not None  # with reflectance in [0, 1]
                samples.append(reflectance / np.float32(1.0 if is_image else scale))
                images |= is_image
    values = np.concatenate(samples) if samples else np.zeros(0)
    if not values.any():
        return OTHER_LEVELS
    levels, highest = find_levels(values), float(values.max())
    if not images and highest < 0.25 and not fits(values, levels):
        log.warning(
            "reflectance goes up to %.3g of 1 alone and is kept in steps of 1/%d: --reflectance-scale %.3g spreads it",
            highest, levels, highest * scale,
        )  # fmt: skip
    return levels


def _make_shard(store: Store, source: ScanSource, skip: bool, shard: int) -> None:
    recipe, numbers, left_out, errors = store.described, shards_of(store.described)[shard], [], [0.0, 0.0]
    coders = dict(zip(CHANNELS, codes_of(recipe), strict=False))
    shape = (len(numbers), *Reading.of(recipe["reading"]).sensor.shape)
    tensors = {name: np.empty(shape, coder.dtype) for name, coder in coders.items()}
    for number in numbers:
        try:
            image = source[number]
        except InputError as error:
            if not skip:
                raise
            log.warning("left out: %s", error)
            left_out.append(number)
            continue
        row = number - numbers.start - len(left_out)
        for i, (name, coder) in enumerate(coders.items()):
            codes = tensors[name][row] = coder.encode(image[i])
            errors[i] = max(errors[i], float(np.abs(coder.values[codes] - image[i]).max()))
    kept = {name: codes[: len(numbers) - len(left_out)] for name, codes in tensors.items()}
    store.write(shard, kept, {"left_out": left_out, "errors": errors, "files": _files(source, numbers)})


def _files(source: ScanSource, numbers: Sequence[int]) -> str:
    return source.subset(numbers).contents[:16]


def prepare(
    folder: str | Path,
    plan: Plan,
    on_bad_scan: str = "error",
    workers: int = 1,
    checked: Advance = lambda shard: None,
    made: Advance = lambda shard: None,
) -> list[dict[str, Any]]:
    """Check the shards of a folder, and make missing or damaged shards; `on_bad_scan="skip"` leaves out unusable scans.

    The headers of the shards have the numbers of the scans left out, maximum errors of range and reflectance, and a
    digest of the files (`ScanFiles.contents`): shards of files that have changed since are refused.
    `checked` and `made` are called with each shard.
    """
    store = plan.store(folder)
    if not store.check() or store.missing(plan.shards):
        store.begin(drives=[[drive.name, drive.scans] for drive in plan.drives])
    parts = shards_of(plan.recipe)

    def look(shard: int) -> None:
        file = store.files(shard)[0]
        check(
            not file.exists() or store.head(shard).get("files") == _files(plan.source, parts[shard]),
            f"{file} holds scans of other files. Give another folder by {store.option}, or remove it to make it again.",
        )
        checked(shard)

    store.mend(plan.shards, look)
    work = partial(_make_shard, store, plan.source, on_bad_scan == "skip")
    store.make(store.missing(plan.shards), work, workers, made)
    notes = [store.head(shard) for shard in plan.shards]
    if sum(len(note["left_out"]) for note in notes) == plan.recipe["scans"]:
        raise InputError(f"all {plan.recipe['scans']} scans were left out as unusable; remove {store.folder}.")
    return notes


def shards_of(recipe: Mapping[str, Any]) -> list[range]:
    """The numbers of each shard's scans."""
    scans, size = range(recipe["scans"]), recipe["shard_scans"]
    return [scans[first : first + size] for first in scans[::size]]


def codes_of(recipe: Mapping[str, Any]) -> list[Codes]:
    """The codes of range and, if the scans have it, of reflectance."""
    sensor, levels = recipe["reading"]["sensor"], recipe["levels"]
    ranges = range_codes(sensor["min_range"], sensor["max_range"])
    return [ranges] if levels is None else [ranges, reflectance_codes(levels)]


# Reading


def read_prepared(folder: Path) -> tuple[dict[str, Any], list[Drive]]:
    """The recipe of prepared scans, and their names by drive."""
    try:
        content = read_manifest(folder, KIND)
    except FileNotFoundError:
        raise InputError(f"{folder} holds no prepared scans (no {MANIFEST}); make them: r2flow prepare.") from None
    return content["recipe"], [Drive(name, tuple(scans)) for name, scans in content["drives"]]


def refuse_other_images(folder: Path, recipe: Mapping[str, Any], reading: Reading) -> None:
    """Refuse prepared scans of another sensor, size, projection or convention, as they cannot be projected again."""
    # Images do not depend on these fields; the order of the lasers determines the rows in unfolding only.
    irrelevant = {"name", "height"} if reading.projection == "unfolding" else {"name", "height", "firing"}
    images = []
    for fields in (recipe["reading"], reading.described()):
        sensor = {key: value for key, value in fields["sensor"].items() if key not in irrelevant}
        images.append({**sensor, "projection": fields["projection"], "convention": fields["convention"]})
    if differing := [*differences(*images).values()]:
        stored = Reading.of(recipe["reading"])
        raise InputError(
            f"{folder} was prepared for other images (sensor {stored.sensor.name}, "
            f"{stored.sensor.shape[0]}x{stored.sensor.shape[1]}, {stored.projection}, {stored.convention}): "
            f"{at_most_three(differing)}. Give the run the same, or prepare the scans for it."
        )


class PreparedScans(ScanSource):
    """A source of the prepared scans of these numbers in the data set, without those left out in preparation."""

    def __init__(self, folder: Path, numbers: Sequence[int], reflectance: bool) -> None:
        self.folder, self.reflectance = folder, reflectance
        self.recipe, self._drives = read_prepared(folder)
        self.store, entries = Store(folder, KIND, self.recipe), dict[int, tuple[int, int, int]]()
        if reflectance and self.recipe["levels"] is None:
            raise InputError(f"{folder} holds scans without reflectance. Set encoding.reflectance=false.")
        for shard, numbers_of_shard in enumerate(shards_of(self.recipe)):
            try:
                left_out = set(self.store.head(shard)["left_out"])
            except FileNotFoundError:
                raise InputError(f"{folder} is not finished: the same r2flow prepare command resumes.") from None
            except Damaged as error:
                raise self._damaged(shard, error) from None
            rows = [number for number in numbers_of_shard if number not in left_out]
            entries |= {number: (number, shard, row) for row, number in enumerate(rows)}
        #: Rows of (number in the data set, shard, row of the shard).
        self.rows = np.array([entries[n] for n in numbers if n in entries], dtype=np.int64).reshape(-1, 3)
        self._values = [codes.values for codes in codes_of(self.recipe)[: 1 + reflectance]]
        self._shards: dict[int, list[Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_shards": {}}  # memory maps are not pickled

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def _names(self) -> list[str]:
        return [name for drive in self._drives for name in drive.scans]

    @property
    def names(self) -> list[str]:
        return [self._names[number] for number in self.rows[:, 0]]

    def subset(self, indices: Sequence[int]) -> "PreparedScans":
        part = object.__new__(PreparedScans)
        part.__dict__ = {**self.__getstate__(), "rows": self.rows[np.asarray(indices, dtype=np.int64)]}
        return part

    @property
    def drives(self) -> dict[str, list[int]]:  # type: ignore[override]
        place = {name: index for index, name in enumerate(self.names)}
        drives = {d.name: [place[n] for n in d.scans if n in place] for d in self._drives}
        return {drive: numbers for drive, numbers in drives.items() if numbers}

    def about(self) -> dict[str, Any]:
        kind = f"prepared {self.recipe['layout']}"
        return {"kind": kind, "recipe": self.store.digest[:12], "reflectance": self.reflectance}

    def identity(self) -> dict[str, Any]:
        rows = hashlib.sha256(np.ascontiguousarray(self.rows).tobytes()).hexdigest()
        return {"recipe": self.contents, "rows": rows, "reflectance": self.reflectance}

    @cached_property
    def contents(self) -> str:  # type: ignore[override]
        """Hash of the headers of all shards, which contain their checksums."""
        digest = hashlib.sha256(self.store.digest.encode())
        for shard in np.unique(self.rows[:, 1]):
            with open(self.store.files(int(shard))[0], "rb") as file:
                digest.update(file.read(int.from_bytes(file.read(8), "little")))
        return digest.hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.folder)
        return {os.path.join(real, name) for name in self.names}

    def __getitem__(self, index: int) -> np.ndarray:
        _, shard, row = map(int, self.rows[index])
        try:
            if shard not in self._shards:
                self.store.head(shard)  # checks the file's length and recipe
                file = safe_open(self.store.files(shard)[0], framework="numpy")
                self._shards[shard] = [file.get_slice(name) for name in CHANNELS[: len(self._values)]]
        except (Damaged, OSError) as error:
            raise self._damaged(shard, error) from None
        codes = [image[row : row + 1][0] for image in self._shards[shard]]
        # No index is out of bounds; mode="clip" only skips the bounds check.
        return np.stack([np.take(values, code, mode="clip") for values, code in zip(self._values, codes, strict=True)])

    def _damaged(self, shard: int, error: Exception) -> InputError:
        path = self.store.files(shard)[0]
        return InputError(f"{path} is damaged ({error}). The same r2flow prepare command makes it again.")
