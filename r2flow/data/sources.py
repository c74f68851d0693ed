"""Sources of numbered range images in metres: scan files, the simulator, memory."""

import copy
import hashlib
import logging
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2flow import simulator
from r2flow.base.errors import InputError
from r2flow.base.files import cache_folder
from r2flow.base.progress import track
from r2flow.base.registry import Config
from r2flow.data.reading import Reading, leaving_out, read_image, read_points_image
from r2flow.lidar.labels import common_classes, labels_beside
from r2flow.lidar.sensors import Sensor
from r2flow.store import Damaged, Store, checksum

log = logging.getLogger(__name__)

Read = TypeVar("Read")

WORTH_KEEPING = 32  # simulated scans: fewer are simulated again


class ScanSource(ABC):
    """Numbered range images, (2 or 1, H, W) float32: range in metres and reflectance in [0, 1], 0
    where missing.

    Subclasses must implement the four abstract methods; the others are optional.
    """

    doing = "reading"  #: what reading does, for progress bars
    slow = False  #: whether reading an image is slow, so that images are kept in memory if they fit
    #: whether a network draws the images on access: only in this process, each image once if
    #: possible
    drawn = False
    #: numbers of the scans of each recording, by its name, if known
    drives: Mapping[str, Sequence[int]] = {}
    contents = ""  #: digest of what is cheaply known of the scans, equal for a copy of the data set

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, index: int) -> np.ndarray: ...

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Names of the scans, independent of the data set's path."""

    @abstractmethod
    def subset(self, indices: Sequence[int]) -> "ScanSource":
        """A source of some of the scans, which never reads the others."""

    def locate(self, index: int) -> tuple[int, int]:
        """The part of a mixture that a scan is from, and the scan's number in that part."""
        return 0, index

    def batch(self, indices: Sequence[int]) -> Tensor:
        """Several scans at once, (B, 2 or 1, H, W)."""
        return torch.from_numpy(np.stack([self[index] for index in indices]))

    def read_all(self, what: str, shape: tuple[int, ...]) -> np.ndarray:
        """All images, which must have the shape; `what` they are, for the progress bar."""
        images = np.empty((len(self), *shape), np.float32)
        for number in track(range(len(images)), f"{self.doing} {what}", least=16):
            image = self[number]
            if image.shape != shape:  # of one channel, it would fill both
                raise InputError(f"{self.names[number]}: an image of {shape}, found {image.shape}.")
            images[number] = image
        return images

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """An image, and the measured x, y, z of its pixels' points in metres, (3, H, W) float32, 0
        where missing.
        """
        raise InputError(
            f"{self.names[index]} holds only ranges, not the measured coordinates of its points."
        )

    def about(self) -> Config:
        """Metadata to report with metrics of the scans, as plain values without paths."""
        return {}

    def identity(self) -> Config | None:
        """All that determines the images, as a cache key; None if unknown, so that nothing is
        cached.
        """
        return None

    def places(self) -> set[str]:
        """Paths of the scans' files: two sources with a common path share scans."""
        return set()


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
        return list(map(self._name, self.paths))

    def _name(self, path: str | Path) -> str:
        return str(path).removeprefix(os.path.join(self.root, ""))

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
        stats = [(*named, stat.st_mtime_ns, stat.st_ctime_ns) for *named, stat in self._stats()]
        return checksum(stats)

    @property
    def contents(self) -> str:  # type: ignore[override]
        """Hash of names and sizes, and of the contents of some files: unpacked archives can have
        equal names and sizes.
        """
        hashes = []
        files = self._files()
        for path in [files[number] for number in spread(len(files), 8)]:
            with suppress(OSError):
                if os.path.isfile(path):  # a pipe would block, a device never end
                    with open(path, "rb") as file:
                        hashes.append(hashlib.file_digest(file, "sha256").hexdigest())
        return checksum([*(named for *named, _ in self._stats()), *hashes])

    def _files(self) -> list[str | Path]:
        """The scans' files, and with labels theirs."""
        found = map(labels_beside, self.paths) if self.reading.labels else ()
        return [*self.paths, *filter(None, found)]

    def _stats(self) -> Iterator[tuple[Any, ...]]:
        """Name and size of each file, with labels also the list of their ids; and its `stat`."""
        ids = self.reading.label_ids.ids if self.reading.labels else None
        for path in self._files():
            with suppress(OSError):  # reported when the scan is read
                stat = os.stat(path)
                yield self._name(path), stat.st_size, ids, stat

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
                log.warning("left out: %s", error)
        raise InputError(
            f"all {len(self.paths)} scans were left out as unusable; see the warnings above."
        )


class MadeScans(ScanSource):
    """Scans made on access, by their numbers; `word` begins their names."""

    word: str
    numbers: Sequence[int]

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def names(self) -> list[str]:
        return [f"{self.word} {number}" for number in self.numbers]

    def subset(self, indices: Sequence[int]) -> Self:
        part = copy.copy(self)
        part.numbers = [self.numbers[i] for i in indices]
        return part


@dataclass(eq=False)
class SimulatedScans(MadeScans):
    """Simulated scenes of one seed."""

    slow = True
    word = "scene"
    doing = "simulating"

    sensor: Sensor
    seed: int
    numbers: Sequence[int]
    reflectance: bool
    labels: bool = False  # whether images end with the common class of each ray

    def about(self) -> Config:
        return {
            "kind": "simulated",
            "seed": self.seed,
            "scenes": len(self),
            "reflectance": self.reflectance,
            "labels": self.labels,
        }

    def identity(self) -> Config:
        return {
            **self.about(),
            "numbers": checksum([*self.numbers])[:16],
            "simulator": simulator.REVISION,
            "sensor": self.sensor.described(),
        }

    def read_all(self, what: str, shape: tuple[int, ...]) -> np.ndarray:
        """All images; many are kept in the user's cache, so that they are simulated once."""
        if len(self) < WORTH_KEEPING:
            return super().read_all(what, shape)
        identity = self.identity()
        folder = cache_folder("R2FLOW_CACHE")
        store = Store(folder, f"simulated-{checksum(identity)[:16]}", identity)
        try:
            return store.read(0)[0]["images"]
        except (FileNotFoundError, Damaged):
            images = super().read_all(what, shape)
        with suppress(OSError):  # a full disk, a home that is read-only
            store.write(0, {"images": images})
            log.info("the simulated scans are kept in %s (%.0f MB)", folder, images.nbytes / 1e6)
        return images

    @property
    def contents(self) -> str:  # type: ignore[override]
        # its revisions draw different scans of the same name
        return f"simulator {simulator.REVISION}"

    def __getitem__(self, index: int) -> np.ndarray:
        scan = simulator.simulate(self.sensor, self.seed, self.numbers[index])
        image = scan.image[: 1 + self.reflectance]
        return np.concatenate([image, common_classes(scan.labels)[None]]) if self.labels else image


class InMemory(ScanSource):
    """Named images in memory, (N, 2 or 1, H, W)."""

    names: Sequence[str] = ()  # set for each instance; the base class has a property

    def __init__(self, images: np.ndarray, names: Sequence[str]) -> None:
        self.images = images
        self.names = names

    def subset(self, indices: Sequence[int]) -> "InMemory":
        return InMemory(self.images[list(indices)], [self.names[i] for i in indices])

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.images[index]


def drives_within(
    drives: Mapping[str, Sequence[Any]], chosen: Sequence[Any]
) -> dict[str, list[int]]:
    """The places of the chosen scans of each drive that has any, by the names or numbers of all."""
    place = {scan: index for index, scan in enumerate(chosen)}
    within = {name: [place[n] for n in scans if n in place] for name, scans in drives.items()}
    return {name: places for name, places in within.items() if places}


def spread(count: int, most: int) -> list[int]:
    """At most `most` numbers of range(count), evenly spread and in order."""
    most = min(most, count)
    return [math.floor((i + 0.5) * count / most) for i in range(most)]


def holdout_block(count: int, share: float, starts: Sequence[int] = ()) -> tuple[range, range]:
    """(training, validation) numbers; the validation scans are one contiguous block, about the last
    `share`.

    Frames are not chosen at random, because neighbouring frames of a drive are near-duplicates.
    Whole drives, which begin at the numbers `starts`, are held out if their size is within half of
    the share; otherwise the exact share is.
    """
    held = min(math.ceil(count * share), count - 1)
    whole = [
        count - start for start in starts if start > 0 and abs(count - start - held) <= held / 2
    ]
    held = min(whole, key=lambda size: abs(size - held), default=held)
    return range(count - held), range(count - held, count)
