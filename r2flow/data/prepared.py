"""Prepared scans: projected once by `r2flow prepare`, then read from memory-mapped shards.

    source = open_scans("prepared/kitti_360").source
    source[0]                       range in metres and reflectance, (2, H, W)

A shard is an item of `r2flow.store`: `range` uint16 (n, H, W) and, if the scans have it,
`reflectance` uint8 (n, H, W), in the codes of `r2flow.data.quantise`; if any scan has a file
of labels, `label` uint8 (n, H, W), the common class, 0 for none.
"""

import copy
import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

from r2flow.base.config import at_most_three, differences
from r2flow.base.errors import InputError, check
from r2flow.base.files import reading_errors
from r2flow.base.progress import Bar, track
from r2flow.data.layouts import Drive
from r2flow.data.quantise import OTHER_LEVELS, Codes, find_levels, range_codes, reflectance_codes
from r2flow.data.reading import Reading, labelled, lacks_reflectance, read_image
from r2flow.data.sources import (
    ScanFiles,
    ScanSource,
    drives_within,
    spread,
    warn_of_other_sensor,
)
from r2flow.store import MANIFEST, Damaged, Store, checksum, read_manifest

log = logging.getLogger(__name__)

KIND = "scans"
PROJECTION = 4  # revision; increase it when the same files give different images or codes


class PreparedStore(Store):
    """A folder of prepared scans.

    Attributes:
        drives: The names of the scans by drive.
        source: The scans to prepare; None of a folder that is only read.
        reading: How the scans became images.
        parts: The numbers of each shard's scans.
        codes: The codes of range and, if the scans have them, of reflectance and labels, by the
            name of their tensor.
    """

    def __init__(
        self,
        folder: str | Path,
        recipe: Mapping[str, Any],
        drives: list[Drive],
        source: ScanSource | None = None,
    ) -> None:
        super().__init__(folder, KIND, recipe)
        self.drives = drives
        self.source = source
        self.reading = Reading.of(recipe["reading"])
        scans = range(recipe["scans"])
        levels = recipe["levels"]
        sensor = self.reading.sensor
        self.parts = [
            scans[first : first + recipe["shard_scans"]]
            for first in scans[:: recipe["shard_scans"]]
        ]
        self.codes = {"range": range_codes(sensor.min_range, sensor.max_range)}
        if levels is not None:
            self.codes["reflectance"] = reflectance_codes(levels)
        if self.reading.labels:
            self.codes["label"] = Codes([0, 255], [0, 255], np.uint8)
        self.shards = range(len(self.parts))

    @cached_property
    def names(self) -> list[str]:
        return [name for drive in self.drives for name in drive.scans]

    def sources_of(self, shard: int) -> str:
        """Digest of the files of a shard's scans (`ScanFiles.contents`)."""
        assert self.source is not None
        return self.source.subset(self.parts[shard]).contents[:16]


def plan_files(
    folder: str | Path,
    layout: str,
    root: Path,
    drives: Sequence[Drive],
    reading: Reading,
    shard_scans: int = 64,  # 13 MB at 64 x 1024, held in memory until written
) -> PreparedStore:
    """The store in `folder` of scan files in drives below a root; reads some scans for the levels
    of reflectance.
    """
    paths = [path for drive in drives for path in drive.scans]
    named = [
        Drive(d.name, tuple(Path(os.path.relpath(p, root)).as_posix() for p in d.scans))
        for d in drives
    ]
    reading = replace(reading, on_bad_scan="error", within_limits=True)
    warn_of_other_sensor(paths, reading, root)
    levels = _reflectance_levels(paths, reading)
    reading = replace(reading, reflectance=levels is not None, labels=labelled(paths) > 0)
    names = [name for drive in named for name in drive.scans]
    recipe = {
        "revision": PROJECTION, "layout": layout, "scans": len(names), "names": checksum(names),
        "reading": reading.described(), "levels": levels, "shard_scans": shard_scans,
    }  # fmt: skip
    return PreparedStore(folder, recipe, named, ScanFiles(paths, reading, root))


def _reflectance_levels(paths: Sequence[str], reading: Reading) -> int | None:
    if lacks_reflectance(paths, "skip", reading.columns) is not None:
        return None
    samples = []
    for index in spread(len(paths), 8):  # enough to see every level
        with suppress(InputError):  # reported when the scan is prepared
            samples.append(read_image(Path(paths[index]), replace(reading, reflectance=True))[1])
    values = np.concatenate(samples) if samples else np.zeros(0)
    return find_levels(values) if values.any() else OTHER_LEVELS


def _make_shard(store: PreparedStore, skip: bool, shard: int) -> None:
    assert store.source is not None
    left_out: list[int] = []
    images: list[np.ndarray] = []
    for number in store.parts[shard]:
        try:
            images.append(store.source[number])
        except InputError as error:
            if not skip:
                raise
            log.warning("left out: %s", error)
            left_out.append(number)
    shape = len(images), len(store.codes), *store.reading.sensor.shape
    channels = np.reshape(images, shape).swapaxes(0, 1)
    tensors = {
        name: coder.encode(channel)
        for channel, (name, coder) in zip(channels, store.codes.items(), strict=True)
    }
    store.write(shard, tensors, {"left_out": left_out, "files": store.sources_of(shard)})


def prepare(
    store: PreparedStore, on_bad_scan: str = "error", workers: int = 1
) -> tuple[int, list[int]]:
    """Check the shards of a folder, and make missing or damaged shards; `on_bad_scan="skip"` leaves
    out unusable scans.

    The headers of the shards have the numbers of the scans left out and a digest of the files:
    shards of files that have changed since are refused. The result is the number of scans left out,
    and the shards that were made.
    """
    if not store.check() or store.missing(store.shards):  # else the folder may be read-only
        store.begin(drives=[[drive.name, drive.scans] for drive in store.drives])
    for shard in track(store.shards, "checking", "shards"):
        store.mend(shard)
        file = store.files(shard)[0]
        check(
            not file.exists() or store.head(shard).get("files") == store.sources_of(shard),
            f"{file} holds scans of other files. Give another folder by {store.option}, or remove "
            "it to make it again.",
        )
    missing = store.missing(store.shards)
    with Bar("preparing", len(missing), "shards") as bar:
        store.make(
            missing,
            partial(_make_shard, store, on_bad_scan == "skip"),
            workers,
            lambda shard: bar(),
        )
    left_out = sum(len(store.head(shard)["left_out"]) for shard in store.shards)
    if left_out == len(store.names):
        for shard in store.shards:  # so that the folder takes another recipe
            store.files(shard)[0].unlink(missing_ok=True)
        raise InputError(f"all {left_out} scans were left out as unusable.")
    return left_out, missing


def read_prepared(folder: Path) -> PreparedStore:
    """The prepared scans in a folder, by its manifest."""
    try:
        content = read_manifest(folder, KIND)
    except FileNotFoundError:
        raise InputError(
            f"{folder} holds no prepared scans (no {MANIFEST}); make them: r2flow prepare."
        ) from None
    return PreparedStore(
        folder, content["recipe"], [Drive(name, tuple(scans)) for name, scans in content["drives"]]
    )


def refuse_other_images(store: PreparedStore, reading: Reading) -> None:
    """Refuse prepared scans of another sensor, size, projection or convention, as they cannot be
    projected again.
    """
    # Images do not depend on these fields; the order of the lasers determines the rows in unfolding
    # only.
    irrelevant = {"name", "height"}
    if reading.projection != "unfolding":
        irrelevant.add("firing")
    images = []
    for fields in (store.described["reading"], reading.described()):
        image = {**fields["sensor"], **{key: fields[key] for key in ("projection", "convention")}}
        images.append({key: value for key, value in image.items() if key not in irrelevant})
    if differing := [*differences(*images).values()]:
        stored = store.reading
        raise InputError(
            f"{store.folder} was prepared for other images (sensor {stored.sensor}, "
            f"{stored.projection}, {stored.convention}): "
            f"{at_most_three(differing)}. Give the run the same, or prepare the scans for it."
        )


class PreparedScans(ScanSource):
    """A source of the prepared scans of these numbers in the data set, without those left out in
    preparation.
    """

    def __init__(
        self,
        store: PreparedStore,
        numbers: Sequence[int],
        reflectance: bool,
        labels: bool = False,
    ) -> None:
        self.store = store
        self.reflectance = reflectance
        self.channels = ["range", *["reflectance"] * reflectance, *["label"] * labels]
        if reflectance and "reflectance" not in store.codes:
            raise InputError(
                f"{store.folder} holds scans without reflectance. Set encoding.reflectance=false."
            )
        if labels and "label" not in store.codes:
            raise InputError(
                f"{store.folder} holds scans without labels. Prepare points that have files of "
                "labels beside them."
            )
        places: dict[int, tuple[int, int]] = {}
        for shard, numbers_of_shard in enumerate(store.parts):
            try:
                left_out = set(store.head(shard)["left_out"])
            except FileNotFoundError:
                raise InputError(
                    f"{store.folder} is not finished: the same r2flow prepare command resumes."
                ) from None
            except (Damaged, KeyError) as error:
                path = store.files(shard)[0]
                raise InputError(
                    f"{path} is damaged ({error}). The same r2flow prepare makes it again."
                ) from None
            kept = [number for number in numbers_of_shard if number not in left_out]
            places |= {number: (shard, row) for row, number in enumerate(kept)}
        rows = [(number, *places[number]) for number in numbers if number in places]
        #: Rows of (number in the data set, shard, row of the shard).
        self.rows = np.array(rows, dtype=np.int64).reshape(-1, 3)
        self._shards: dict[int, dict[str, Any]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_shards": {}}  # memory maps are not pickled

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def names(self) -> list[str]:
        return [self.store.names[number] for number in self.rows[:, 0]]

    def subset(self, indices: Sequence[int]) -> "PreparedScans":
        part = copy.copy(self)
        part.rows = self.rows[np.asarray(indices, dtype=np.int64)]
        return part

    @property
    def drives(self) -> dict[str, list[int]]:  # type: ignore[override]
        return drives_within({drive.name: drive.scans for drive in self.store.drives}, self.names)

    def about(self) -> dict[str, Any]:
        kind = f"prepared {self.store.described['layout']}"
        return {"kind": kind, "recipe": self.store.digest[:12], "reflectance": self.reflectance}

    def identity(self) -> dict[str, Any]:
        rows = checksum(self.rows.tolist())
        return {"recipe": self.contents, "rows": rows, "channels": self.channels}

    @cached_property
    def contents(self) -> str:  # type: ignore[override]
        """Hash of the headers of all shards, which contain their checksums."""
        digest = hashlib.sha256(self.store.digest.encode())
        for shard in np.unique(self.rows[:, 1]):
            with open(self.store.files(int(shard))[0], "rb") as file:
                digest.update(file.read(int.from_bytes(file.read(8), "little")))
        return digest.hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.store.folder)
        return {os.path.join(real, name) for name in self.names}

    def __getitem__(self, index: int) -> np.ndarray:
        _, shard, row = map(int, self.rows[index])
        if shard not in self._shards:
            path = self.store.files(shard)[0]
            with reading_errors(path):  # damaged since it was opened
                file = safe_open(path, framework="numpy")
                self._shards[shard] = {name: file.get_slice(name) for name in self.channels}
        channels = []
        for name, stored in self._shards[shard].items():
            code = stored[row : row + 1][0]
            # No index is out of bounds; mode="clip" only skips the bounds check.
            channels.append(np.take(self.store.codes[name].values, code, mode="clip"))
        return np.stack(channels)
