"""Scan files of any format as a source of range images, read on access."""

import hashlib
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from r2flow.base.errors import InputError
from r2flow.base.registry import Config
from r2flow.data.reading import Reading, leaving_out, read_image, read_points_image
from r2flow.data.sources import ScanSource, spread
from r2flow.lidar.labels import labels_beside
from r2flow.store import checksum

_log = logging.getLogger(__name__)

Read = TypeVar("Read")


@dataclass(eq=False)
class ScanFiles(ScanSource):
    """Scan files of any format and range images, read on access.

    With `on_bad_scan="skip"`, an unusable file is replaced by the next usable file of this source,
    with a warning; the replacement is the same in every process.

    A scan's name is its path below the data set's `root`.
    """

    slow = True

    paths: Sequence[str | Path]
    reading: Reading
    root: str | Path = ""
    drives: Mapping[str, Sequence[int]] = field(default_factory=dict)
    described: Mapping[str, Any] = field(default_factory=dict)  # part of `about`
    bad: set[int] = field(default_factory=set, init=False)

    @property
    def names(self) -> list[str]:
        return [str(path).removeprefix(self._root) for path in self.paths]

    @cached_property
    def _root(self) -> str:
        return os.path.join(self.root, "")

    def subset(self, indices: Sequence[int]) -> "ScanFiles":
        paths = [self.paths[i] for i in indices]
        return ScanFiles(paths, self.reading, self.root, described=self.described)

    def about(self) -> Config:
        return {
            **self.described,
            "files": self._digest[:12],
            "reflectance": bool(self.reading.reflectance),
        }

    def identity(self) -> Config:
        return {"files": self._digest, **self.reading.described()}

    @cached_property
    def _digest(self) -> str:
        """Hash of names, sizes and times of change; a file unpacked anew has another `ctime`."""
        return checksum(self._listed("st_mtime_ns", "st_ctime_ns"))

    @property
    def contents(self) -> str:  # type: ignore[override]
        """Hash of names and sizes, and of the contents of some files: unpacked archives can have
        equal names and sizes.
        """
        listed = self._listed()
        files = self._files()
        for path in [files[number] for number in spread(len(files), 8)]:
            with suppress(OSError):
                if os.path.isfile(path):  # a pipe would block, a device never end
                    with open(path, "rb") as file:
                        listed.append(hashlib.file_digest(file, "sha256").hexdigest())
        return checksum(listed)

    def _files(self) -> list[str | Path]:
        """The scans' files, and with labels theirs."""
        found = map(labels_beside, self.paths) if self.reading.labels else ()
        return [*self.paths, *filter(None, found)]

    def _listed(self, *times: str) -> list[Any]:
        """Name, size and `times` (fields of `os.stat`) of each file; first the ids of labels."""
        rows: list[Any] = [self.reading.label_ids.ids] if self.reading.labels else []
        for path in self._files():
            with suppress(OSError):  # reported when the scan is read
                about = os.stat(path)
                name = str(path).removeprefix(self._root)
                rows.append([name, about.st_size, *(getattr(about, time) for time in times)])
        return rows

    def places(self) -> set[str]:
        real = cache(os.path.realpath)  # slow on network disks
        parts = map(os.path.split, self.paths)
        files = (os.path.join(real(folder), name) for folder, name in parts)
        return {real(file) if os.path.islink(file) else file for file in files}

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return self._first_usable(index, lambda path: read_image(path, self.reading))

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self._first_usable(index, lambda path: read_points_image(path, self.reading))

    def _first_usable(self, index: int, read: Callable[[Path], Read]) -> Read:
        """Read a file, or with `on_bad_scan="skip"` the first usable file from this index on."""
        if self.reading.on_bad_scan != "skip":
            advised = (
                self.reading.on_bad_scan == "error" and self.described.get("kind", "file") != "file"
            )
            with leaving_out(advised):
                return read(Path(self.paths[index]))
        for candidate in chain(range(index, len(self)), range(index)):
            if candidate in self.bad:
                continue
            try:
                return read(Path(self.paths[candidate]))
            except InputError as error:
                self.bad.add(candidate)
                _log.warning("left out: %s", error)
        raise InputError(
            f"all {len(self.paths)} scans were left out as unusable; see the warnings above."
        )
