"""Prepared scans: projected once by `r2flow prepare`, then read from memory-mapped shards.

    source = open_scans("prepared/kitti_360").source
    source[0]                       range in metres and reflectance, (2, H, W)

A shard is an item of `r2flow.store`: `range` uint16 (n, H, W) and, if the scans have it,
`reflectance` uint8 (n, H, W), in the codes of `r2flow.data.quantise`; if any scan has a file
of labels, `label` uint8 (n, H, W), the common class, 0 for none.
"""

import copy
import hashlib
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from safetensors import safe_open

from r2flow.base.config import at_most_three, differences
from r2flow.base.errors import InputError
from r2flow.base.files import reading_errors
from r2flow.base.registry import Config, Options
from r2flow.data.layouts import Drive
from r2flow.data.quantise import Codes, range_codes, reflectance_codes
from r2flow.data.reading import Reading
from r2flow.data.sources import ScanSource, drives_within
from r2flow.store import MANIFEST, Damaged, Store, checksum

_KIND = "scans"


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
        recipe: Options,
        drives: list[Drive],
        source: ScanSource | None = None,
    ) -> None:
        super().__init__(folder, _KIND, recipe)
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


def stored_scans(folder: Path, manifest: Options) -> PreparedStore:
    """The prepared scans in a folder, by its manifest."""
    if manifest.get("format") != f"r2flow {_KIND}":
        raise InputError(
            f"{folder} holds no prepared scans (see its {MANIFEST}); make them: r2flow prepare."
        )
    drives = [Drive(name, tuple(scans)) for name, scans in manifest["drives"]]
    return PreparedStore(folder, manifest["recipe"], drives)


def refuse_other_images(store: PreparedStore, reading: Reading) -> None:
    """Refuse prepared scans of another sensor, size, projection or convention, as they cannot be
    projected again.
    """
    # Images do not depend on these fields; the order of the lasers determines the rows in unfolding
    # only.
    irrelevant = {"sensor.name", "sensor.height"}
    if reading.projection != "unfolding":
        irrelevant.add("sensor.firing")
    found = differences(store.described["reading"], reading.described())
    differing = [
        text
        for key, text in found.items()
        if key.startswith(("sensor.", "projection", "convention")) and key not in irrelevant
    ]
    if differing:
        stored = store.reading
        raise InputError(
            f"{store.folder} was prepared for other images (sensor {stored.sensor}, "
            f"{stored.projection}, {stored.convention}): "
            f"{at_most_three(differing)}. Give the run the same, or prepare the scans for it."
        )


_LACKING = {
    "reflectance": "reflectance. Set encoding.reflectance=false.",
    "label": "labels. Prepare points that have files of labels beside them.",
}


def _left_out(store: PreparedStore, shard: int) -> set[int]:
    """The numbers of the scans that were left out of a shard, which must be there."""
    try:
        return set(store.head(shard)["left_out"])
    except FileNotFoundError:
        raise InputError(
            f"{store.folder} is not finished: the same r2flow prepare command resumes."
        ) from None
    except (Damaged, KeyError) as error:
        raise InputError(
            f"{store.file(shard)} is damaged ({error}). The same r2flow prepare makes it again."
        ) from None


class PreparedScans(ScanSource):
    """A source of the prepared scans of these numbers in the data set, without those left out in
    preparation.
    """

    def __init__(
        self, store: PreparedStore, numbers: Sequence[int], reflectance: bool, labels: bool = False
    ) -> None:
        self.store = store
        self.reflectance = reflectance
        self.channels = ["range", *["reflectance"] * reflectance, *["label"] * labels]
        for name in self.channels:
            if name not in store.codes:
                raise InputError(f"{store.folder} holds scans without {_LACKING[name]}")
        places: dict[int, tuple[int, int]] = {}
        for shard, numbers_of_shard in enumerate(store.parts):
            left_out = _left_out(store, shard)
            kept = [number for number in numbers_of_shard if number not in left_out]
            places |= {number: (shard, row) for row, number in enumerate(kept)}
        rows = [(number, *places[number]) for number in numbers if number in places]
        #: Rows of (number in the data set, shard, row of the shard).
        self.rows = np.array(rows, dtype=np.int64).reshape(-1, 3)
        self._shards: dict[int, Config] = {}

    def __getstate__(self) -> Config:
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

    def about(self) -> Config:
        kind = f"prepared {self.store.described['layout']}"
        return {"kind": kind, "recipe": self.store.digest[:12], "reflectance": self.reflectance}

    def identity(self) -> Config:
        rows = checksum(self.rows.tolist())
        return {"recipe": self.contents, "rows": rows, "channels": self.channels}

    @cached_property
    def contents(self) -> str:  # type: ignore[override]
        """Hash of the headers of all shards, which contain their checksums."""
        digest = hashlib.sha256(self.store.digest.encode())
        for shard in np.unique(self.rows[:, 1]):
            with open(self.store.file(int(shard)), "rb") as file:
                digest.update(file.read(int.from_bytes(file.read(8), "little")))
        return digest.hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.store.folder)
        return {os.path.join(real, name) for name in self.names}

    def __getitem__(self, index: int) -> np.ndarray:
        _, shard, row = map(int, self.rows[index])
        if shard not in self._shards:
            path = self.store.file(shard)
            with reading_errors(path):  # damaged since it was opened
                file = safe_open(path, framework="numpy")
                self._shards[shard] = {name: file.get_slice(name) for name in self.channels}
        channels = []
        for name, stored in self._shards[shard].items():
            code = stored[row : row + 1][0]
            # No index is out of bounds; mode="clip" only skips the bounds check.
            channels.append(np.take(self.store.codes[name].values, code, mode="clip"))
        return np.stack(channels)
