"""Sources of numbered range images in metres."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.progress import track
from r2flow.base.registry import Config


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
    unsolved = 0  #: scans so far that a network's solver has not solved to the tolerance
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
class InMemory(ScanSource):
    """Named images in memory, (N, 2 or 1, H, W)."""

    images: np.ndarray
    names: Sequence[str] = ()  # a default, since the base class has an abstract property

    def subset(self, indices: Sequence[int]) -> "InMemory":
        return InMemory(self.images[list(indices)], [self.names[i] for i in indices])

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.images[index]


def drives_within(drives: Mapping[str, Sequence[Any]], kept: Sequence[Any]) -> dict[str, list[int]]:
    """The places of the kept scans of each drive that has any, by the names or numbers of all."""
    place = {scan: index for index, scan in enumerate(kept)}
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
