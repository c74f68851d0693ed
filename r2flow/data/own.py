"""Scans of a torch `Dataset` of one's own."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from r2flow.base.errors import InputError
from r2flow.data.kinds import SOURCES, HowRead, SourceKind
from r2flow.data.sources import MadeScans, spread

if TYPE_CHECKING:
    from r2flow.data.described import Described

DATASET = "dataset"  # name of a data set that is given as it is
_LOOKED_AT = 8  # scans whose values identify the data set


@dataclass(eq=False)
class DatasetScans(MadeScans):
    """Items of a map-style `Dataset`: images (2 or 1, H, W), range in metres and reflectance in
    [0, 1], 0 without a return, or dicts with such an `image`.
    """

    slow = True
    word = "item"

    dataset: Any
    numbers: Sequence[int]

    def __getitem__(self, index: int) -> np.ndarray:
        item = self.dataset[self.numbers[index]]
        image = item["image"] if isinstance(item, dict) else item
        return torch.as_tensor(image, dtype=torch.float32).numpy()

    @property
    def contents(self) -> str:  # type: ignore[override]
        looked_at = [self[index].tobytes() for index in spread(len(self), _LOOKED_AT)]
        return hashlib.sha256(b"".join(looked_at)).hexdigest()


@dataclass(frozen=True)
class DatasetKind(SourceKind):
    """Scans of `make(root)`, a map-style `Dataset` (`DatasetScans`); root is None if not given.

    Its images have the size of the run's sensor.
    """

    make: Callable[[Path | None], Any]

    def open(self, scans: "Described", reading: HowRead) -> DatasetScans:
        dataset = self._made(scans)
        return DatasetScans(dataset, range(len(dataset)))

    def lacks_reflectance(self, scans: "Described", reading: HowRead) -> str | None:
        channels = len(self.open(scans, reading)[0])
        return f"the images of {scans.options.name} have one channel" if channels == 1 else None

    def _made(self, scans: "Described") -> Any:
        if scans.dataset is not None:
            return scans.dataset
        return self.make(None if scans.options.root is None else scans.options.folder)


def _not_given(root: Path | None) -> Any:
    raise InputError("give the data set itself: ScanDataModule(my_dataset, ...).")


SOURCES.add(DATASET, DatasetKind(_not_given))
