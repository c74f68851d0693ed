"""A set of scans for commands and reports: numbered range images with their metadata."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from r2flow.base.noise import generator
from r2flow.base.registry import Options
from r2flow.base.signals import blocking_signals, init_loader_worker
from r2flow.data.sources import ScanSource, drives_within, spread
from r2flow.lidar.sensors import Sensor


@dataclass(eq=False)
class ScanSet:
    """Scans of a sensor. `about`, `identity`, `drives` are as in `ScanSource`."""

    label: str  # the user's name for them
    source: ScanSource
    sensor: Sensor
    subset: str | None = None  # which of them, if not all
    drives: Mapping[str, Sequence[int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.subset is None:
            self.drives = self.source.drives

    @cached_property
    def about(self) -> Options:
        about = self.source.about()
        return about if self.subset is None else {**about, "part": self.subset}

    @cached_property
    def identity(self) -> Options | None:
        return self.source.identity()

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: int | slice) -> Tensor:
        """One image, (2 or 1, H, W), or those of a slice, (n, 2 or 1, H, W)."""
        if isinstance(key, slice):
            return self.source.batch(range(len(self))[key])
        return self.source.batch([range(len(self))[key]])[0]

    def part(self, numbers: Sequence[int], name: str) -> "ScanSet":
        """Some of the scans, in the given order; `name` describes the selection."""
        drives = drives_within(self.drives, numbers)
        return ScanSet(self.label, self.source.subset(numbers), self.sensor, name, drives)

    def limited(self, most: int | None) -> "ScanSet":
        """At most `most` scans, by `fixed_choice`."""
        if most is None or most >= len(self):
            return self
        numbers = fixed_choice(len(self), most)
        return self.part(numbers, f"{most} of {len(self)}, fixed shuffle, seed 0")

    def spread(self, most: int) -> "ScanSet":
        """At most `most` scans, evenly spread over all."""
        if most >= len(self):
            return self
        return self.part(spread(len(self), most), f"{most} of {len(self)}, evenly spread")

    def batches(
        self, numbers: Sequence[int], batch_size: int, workers: int = 0, with_points: bool = False
    ) -> Iterator[Any]:
        """Batches of these scans in order, read by `workers` further processes: images, (B, 2 or 1,
        H, W), or pairs of images and the measured points of the pixels, (B, 3, H, W)
        (`ScanSource.with_points`).
        """
        read = partial(_with_points, self.source) if with_points else self.source.batch
        chunks: Any = [
            list(numbers[i : i + batch_size]) for i in range(0, len(numbers), batch_size)
        ]
        # Processes take seconds to start; samples are drawn in the process of the network.
        workers = 0 if self.source.drawn or len(chunks) < 8 else workers
        loader = DataLoader(
            chunks, None, collate_fn=read, num_workers=workers, worker_init_fn=init_loader_worker
        )
        # the end of a process would be an error here
        with blocking_signals() if workers else nullcontext():
            return iter(loader)


def _with_points(source: ScanSource, numbers: list[int]) -> list[Tensor]:
    return default_collate([source.with_points(number) for number in numbers])


def fixed_choice(count: int, most: int) -> list[int]:
    """`most` of `count` numbers, the first of a fixed shuffle (Philox, seed 0), sorted."""
    return sorted(generator(0, "shuffle", 0).permutation(count)[:most].tolist())
