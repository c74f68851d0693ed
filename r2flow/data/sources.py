"""Sources of numbered range images in metres: scan files, the simulator, memory."""

import copy
import hashlib
import json
import logging
import math
import os
import shlex
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
from r2flow.base.errors import InputError, check, warn_odd
from r2flow.base.files import cache_folder
from r2flow.base.progress import track
from r2flow.data.reading import Reading, leaving_out, read_image, read_points_image
from r2flow.lidar.estimation import hangs
from r2flow.lidar.labels import common_classes, labels_beside
from r2flow.lidar.matching import Doubt, differing, in_words, is_unclear, other_sensor
from r2flow.lidar.scan_files import Points, read_points, scan_ending
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.lidar.turns import SEVERAL, turns
from r2flow.store import MANIFEST, Damaged, Store, checksum, manifest_of

log = logging.getLogger(__name__)

Read = TypeVar("Read")

WORTH_KEEPING = 32  # simulated scans: fewer are simulated again
LOOKED_AT = 3  # number of scans whose beams are compared with the sensor's


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

    def about(self) -> dict[str, Any]:
        """Metadata to report with metrics of the scans, as plain values without paths."""
        return {}

    def identity(self) -> dict[str, Any] | None:
        """All that determines the images, as a cache key; None if unknown, so that nothing is
        cached.
        """
        return None

    def places(self) -> set[str]:
        """Paths of the scans' files: two sources with a common path share scans."""
        return set()


def made_here(root: str | Path) -> bool:
    """Whether r2flow wrote the samples or simulated scans in a folder, in all folders in it, or
    next to a file.
    """
    given = Path(root).expanduser()
    folder = given.parent if given.is_file() else given
    if not folder.is_dir() or manifest_of(folder):
        return folder.is_dir()
    below = [
        path
        for path in folder.glob("[!.]*")  # not a disk's .Trash-1000, nor its lost+found
        if scan_ending(path.name) or (path.is_dir() and os.access(path, os.X_OK))
    ]
    return bool(below) and all(map(manifest_of, below))


def readable(paths: Sequence[str | Path], columns: Sequence[str] | None) -> Iterator[Points]:
    """The points of the files that hold points."""
    for path in paths:
        with suppress(InputError):
            yield read_points(path, columns)


def mismatch_of(paths: Sequence[str | Path], reading: Reading, ours: bool) -> Doubt | None:
    """The mismatch of a few scan files and a sensor (`other_sensor`); warns instead of one due to
    their frame.

    Files of `ours`, that r2flow wrote, store their sensor; other range images have no beams.
    Unreadable files are reported when they are read as scans.
    """
    if ours:
        sensor = reading.sensor
        for folder in sorted({os.path.dirname(path) for path in paths}):
            stored = Reading.stored(folder)
            theirs = stored.sensor if stored else sensor
            known = theirs.name in SENSORS
            if known and theirs.name == sensor.name and theirs.shape[0] >= sensor.shape[0]:
                continue  # rows of rows are nearly the rows of the sensor
            if not theirs.resized(*sensor.shape).same_image(sensor):
                name = theirs.name if known else None
                return Doubt(f"{MANIFEST} names {theirs}", name, sure=known)
        return None
    chosen = [paths[number] for number in spread(len(paths), LOOKED_AT)]
    scans = {path: scan for path in chosen for scan in readable([path], reading.columns)}
    mismatch = other_sensor([*scans.values()], reading.sensor) if scans else None
    if not scans or (mismatch and mismatch.hopeless):
        return mismatch
    unclear = warn_of_frame(scans)
    return None if unclear and not (mismatch and mismatch.sure) else mismatch


def warn_of_frame(scans: Mapping[Any, Points], alike: bool = False) -> bool:
    """Warn, once per folder, of scans (by path) not in one sensor's own frame; whether they are
    not.

    Warns of files of several turns, too. With `alike`, scans of two sensors are an InputError.
    """
    points = [*scans.values()]
    path = Path(next(iter(scans)))
    if any(turns(scan) > SEVERAL for scan in points):
        warn_odd(path, "a file holds several turns of the sensor; a scan is one: split it")
    if hangs(points):
        warn_odd(
            path,
            "the ground lies above the sensor: if it hangs upside down, negate y and z of the "
            "points; models expect z upwards",
        )
    if pair := differing(points):
        seen = " and ".join(f"{[*scans][n]} ({in_words(beams)})" for n, beams in pair)
        check(not alike, f"{seen} are of two sensors: give the scans of each by themselves.")
        warn_odd(path, f"read as scans of one sensor, but {seen} are of two: read them apart")
        return True
    unclear = is_unclear(points)
    if unclear:
        warn_odd(
            path,
            "its beams are not clear: give scans of one sensor, in its own frame, not a vehicle's",
        )
    return unclear


def warn_of_other_sensor(
    paths: Sequence[str | Path], reading: Reading, root: str | Path, ours: bool | None = None
) -> None:
    """Warn if scan files do not match a sensor (`mismatch_of`), and name the sensor that matches.

    `ours`: whether r2flow wrote them; None: look (`made_here`).
    """
    sensor = reading.sensor
    mismatch = mismatch_of(paths, reading, made_here(root) if ours is None else ours)
    if mismatch is None or mismatch.finer:
        return
    seen, name, hopeless = mismatch[:3]
    check(not (hopeless and reading.within_limits), f"{root}: {seen}.")
    folder = shlex.quote(str(root))
    advice = f"; give the right one, or estimate it: r2flow sensor {folder} --out mine.yaml"
    if name is not None and name != sensor.name:
        advice = (
            f"; they fit '{name}': sensor={name} in training, --sensor {name} in verbs that have it"
        )
    log.warning(
        "%s: read as scans of sensor '%s', which sees %+.1f to %+.1f degrees, but %s%s",
        root, sensor.name, *sensor.row_edges[[0, -1]], seen, "" if hopeless else advice,
    )  # fmt: skip


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
        below = os.path.join(self.root, "")
        return [str(path).removeprefix(below) for path in self.paths]

    def subset(self, indices: Sequence[int]) -> "ScanFiles":
        paths = [self.paths[i] for i in indices]
        return ScanFiles(paths, self.reading, self.root, described=self.described)

    def about(self) -> dict[str, Any]:
        return {
            **self.described,
            "files": self._digest[:12],
            "reflectance": bool(self.reading.reflectance),
        }

    def identity(self) -> dict[str, Any]:
        return {"files": self._digest, **self.reading.described()}

    @cached_property
    def _digest(self) -> str:
        return self._hashed(times=True)

    @property
    def contents(self) -> str:  # type: ignore[override]
        return self._hashed(times=False)

    def _hashed(self, times: bool) -> str:
        """Hash of all names and sizes, with `times` also of the times of change, and of the
        contents of some files.
        """
        stats: list[Any] = []
        hashes = []
        paths = [*self.paths]
        if self.reading.labels:
            stats += self.reading.label_ids.ids
            paths += [found for path in paths if (found := labels_beside(path))]
        for path in paths:
            with suppress(OSError):  # reported when the scan is read
                stat = os.stat(path)
                name = str(path).removeprefix(os.path.join(self.root, ""))
                stats.append((name, stat.st_size, *[stat.st_mtime_ns] * times))
        # Hash some contents, too: unpacked archives can have equal names, sizes and times.
        for i in spread(len(paths), 8):
            with suppress(OSError):
                if os.path.isfile(paths[i]):  # a pipe would block, a device never end
                    with open(paths[i], "rb") as file:
                        hashes.append(hashlib.file_digest(file, "sha256").hexdigest())
        return hashlib.sha256(json.dumps([stats, hashes]).encode()).hexdigest()

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

    def about(self) -> dict[str, Any]:
        return {
            "kind": "simulated",
            "seed": self.seed,
            "scenes": len(self),
            "reflectance": self.reflectance,
            "labels": self.labels,
        }

    def identity(self) -> dict[str, Any]:
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
