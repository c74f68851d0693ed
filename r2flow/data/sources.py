"""Range images in metres, by number: from scan files, from the simulator, from memory."""

import hashlib
import json
import logging
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2flow.data.reading import Reading, read_image, read_points_image
from r2flow.errors import InputError
from r2flow.lidar.beams import other_sensor
from r2flow.lidar.scan_files import read_points, read_range_image
from r2flow.lidar.sensors import Sensor
from r2flow.store import MANIFEST

log = logging.getLogger(__name__)

Read = TypeVar("Read")

LOOKED_AT = 3  # scans of a set, whose beams are compared with the sensor's


class ScanSource(ABC):
    """Numbered range images, (2 or 1, H, W) float32: range in metres and reflectance of [0, 1], 0 where missing.

    A source of your own needs the four abstract methods; the others say what it can do besides.

    Attributes:
        slow: Whether an image takes long to get, so that those that fit are kept in memory.
        drawn: Whether a network draws the images when they are asked for: in this process alone, and no image twice
            where once will do.
        measured: Whether the points that the pixels stand for are known: of range images, prepared shards, samples and
            simulated scans they are not.
        drives: Numbers of the scans of each recording, by its name, where recordings are known.
    """

    slow = False
    drawn = False
    measured = False
    drives: Mapping[str, Sequence[int]] = {}

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, index: int) -> np.ndarray: ...

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """What each scan is called, wherever the data set lies."""

    @abstractmethod
    def subset(self, indices: Sequence[int]) -> "ScanSource":
        """Some of the scans as a source of their own, which never reaches for the others."""

    def batch(self, indices: Sequence[int]) -> Tensor:
        """Several scans at once, (B, 2 or 1, H, W)."""
        return torch.from_numpy(np.stack([self[index] for index in indices]))

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """An image, and the measured x, y, z of each pixel's point in metres, (3, H, W) float32, 0 where missing."""
        raise InputError(f"{self.names[index]} holds ranges alone, not the measured coordinates of its points.")

    def about(self) -> dict[str, Any]:
        """What a reader of a figure must know of the scans, as plain values; no path is among them."""
        return {}

    def identity(self) -> dict[str, Any] | None:
        """All that decides what the images are; None where nobody knows, and nothing of them is worth keeping."""
        return None

    def places(self) -> set[str]:
        """Where the files of the scans lie: two sources with a common place share scans."""
        return set()


def made_here(root: str | Path) -> bool:
    """Whether a folder, or one in it, holds samples or simulated scans of r2flow, or the folder of a file does."""
    folder = Path(root).expanduser()
    if folder.is_file():
        folder = folder.parent
    if not folder.is_dir():
        return False
    with os.scandir(folder) as entries:  # which knows a folder without asking the disk about each file
        places = [folder, *(Path(entry.path) for entry in entries if entry.is_dir())]
    return any((place / MANIFEST).is_file() for place in places)


def warn_of_other_sensor(paths: Sequence[str | Path], reading: Reading, root: str | Path) -> None:
    """Say in one line that scan files do not look like a sensor's, and which sensor they fit (`other_sensor`).

    For bare scan files alone: what r2flow wrote says its sensor, and range images have no beams. Files that cannot be
    read are reported when their turn comes.
    """
    if made_here(root):
        return
    scans, sensor = [], reading.sensor
    for number in spread(len(paths), LOOKED_AT):
        with suppress(InputError):
            scans.append(read_points(paths[number], reading.columns))
    found = other_sensor(scans, sensor) if scans else None
    if found is None:
        return
    seen, name, hopeless = found
    if hopeless and reading.within_limits:
        raise InputError(f"{root}: {seen}.")
    edges = sensor.row_edges
    advice = f"give the right one, or estimate it: r2flow sensor {root} --out mine.yaml"
    if name is not None and name != sensor.name:
        advice = f"they fit '{name}': sensor={name} in training, --sensor {name} in verbs"
    log.warning(
        "%s: the scans do not look like those of sensor '%s', which sees %+.1f to %+.1f degrees: %s; %s",
        root, sensor.name, edges[0], edges[-1], seen, advice,
    )  # fmt: skip


class ScanFiles(ScanSource):
    """Scan files of any format and range images, side by side, each read when it is asked for.

    With `on_bad_scan="skip"` a file that cannot be used is left out with a warning: the next usable file of this source
    takes its place, the same one in every process.

    A scan is named by its path below the data set's `root`.
    """

    slow = True

    def __init__(
        self,
        paths: Sequence[str | Path],
        reading: Reading,
        root: str | Path = "",
        drives: Mapping[str, Sequence[int]] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.paths, self.reading, self.root = list(paths), reading, root
        self.drives, self.described = drives or {}, about or {}
        self.bad: set[int] = set()

    @cached_property
    def measured(self) -> bool:  # type: ignore[override]
        arrays = (path for path in self.paths if str(path).lower().endswith((".npy", ".npz")))
        return next((read_range_image(path) is None for path in arrays), True)

    @property
    def names(self) -> list[str]:
        below = os.path.join(self.root, "")
        return [str(path).removeprefix(below) for path in self.paths]

    def subset(self, indices: Sequence[int]) -> "ScanFiles":
        return ScanFiles([self.paths[i] for i in indices], self.reading, self.root, about=self.described)

    def about(self) -> dict[str, Any]:
        return {**self.described, "files": self._digest[:12], "reflectance": bool(self.reading.reflectance)}

    def identity(self) -> dict[str, Any]:
        return {"files": self._digest, **asdict(self.reading), "sensor": self.reading.sensor.described()}

    @cached_property
    def _digest(self) -> str:
        found = [(name, os.stat(path)) for name, path in zip(self.names, self.paths, strict=True)]
        stats = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in found]
        # Some contents, too: unpacked archives have equal names, sizes and times.
        some = []
        for i in spread(len(self.paths), 8):
            if os.path.isfile(self.paths[i]):  # a pipe would hang, a device never end
                with open(self.paths[i], "rb") as file:
                    some.append(hashlib.file_digest(file, "sha256").hexdigest())
        return hashlib.sha256(json.dumps([stats, some]).encode()).hexdigest()

    def places(self) -> set[str]:
        real = os.path.realpath(self.root)  # once for all of them: on a network disk it takes its time
        return {os.path.join(real, name) for name in self.names}

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return self._first_usable(index, lambda path: read_image(path, self.reading))

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self._first_usable(index, lambda path: read_points_image(path, self.reading))

    def _first_usable(self, index: int, read: Callable[[Path], Read]) -> Read:
        """What is read of a file, or with `on_bad_scan="skip"` of the first usable one from there on."""
        if self.reading.on_bad_scan != "skip":
            return read(Path(self.paths[index]))
        for candidate in (*range(index, len(self)), *range(index)):
            if candidate in self.bad:
                continue
            try:
                return read(Path(self.paths[candidate]))
            except InputError as error:
                self.bad.add(candidate)
                log.warning("left out: %s", error)
        raise InputError(f"all {len(self.paths)} scans were left out as unusable; see the warnings above.")


class SimulatedScans(ScanSource):
    """Scenes of the simulator under one seed, by their numbers."""

    slow = True

    def __init__(self, sensor: Sensor, seed: int, scenes: Sequence[int], reflectance: bool = True) -> None:
        self.sensor, self.seed, self.scenes, self.reflectance = sensor, seed, scenes, reflectance

    @property
    def names(self) -> list[str]:
        return [f"scene {scene}" for scene in self.scenes]

    def subset(self, indices: Sequence[int]) -> "SimulatedScans":
        return SimulatedScans(self.sensor, self.seed, [self.scenes[i] for i in indices], self.reflectance)

    def about(self) -> dict[str, Any]:
        return {"kind": "simulated", "seed": self.seed, "scenes": len(self), "reflectance": self.reflectance}

    def identity(self) -> dict[str, Any]:
        from r2flow import simulator

        numbers = hashlib.sha256(np.asarray(self.scenes, dtype=np.int64).tobytes()).hexdigest()[:16]
        return {**self.about(), "numbers": numbers, "simulator": simulator.REVISION, "sensor": self.sensor.described()}

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> np.ndarray:
        from r2flow.simulator import simulate

        return simulate(self.sensor, self.seed, self.scenes[index]).image[: 1 + self.reflectance]


class InMemory(ScanSource):
    """Images in memory, (N, 2 or 1, H, W), and their names."""

    def __init__(self, images: np.ndarray, names: Sequence[str]) -> None:
        self.images, self._names = images, names

    @property
    def names(self) -> Sequence[str]:
        return self._names

    def subset(self, indices: Sequence[int]) -> "InMemory":
        return InMemory(self.images[list(indices)], [self.names[i] for i in indices])

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.images[index]


def spread(count: int, most: int) -> list[int]:
    """At most `most` numbers of range(count), evenly spread and in order."""
    if count <= most:
        return list(range(count))
    return [math.floor((i + 0.5) * count / most) for i in range(most)]


def holdout_block(count: int, share: float, starts: Sequence[int] = ()) -> tuple[range, range]:
    """(training, validation) numbers: about the last `share` of the scans, in one contiguous block.

    Never a random choice of frames: neighbours in a drive are near-duplicates of each other. Where whole drives, which
    begin at the numbers `starts`, come within half of the share at the end, they are held out, so that no scan has a
    neighbour on the other side; else exactly the share is.
    """
    held = min(math.ceil(count * share), count - 1)
    whole = [count - start for start in starts if start > 0 and abs(count - start - held) <= held / 2]
    held = min(whole, key=lambda one: abs(one - held), default=held) if held else 0
    return range(count - held), range(count - held, count)
