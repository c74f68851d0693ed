"""Sets of scans that know nothing of scenes, measured beside generated ones: what a figure must put behind these."""

from collections.abc import Sequence

import numpy as np

from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanSource
from r2flow.metrics.controls import CONTROLS, Control

LEARNED_FROM = 200  # real scans that the mean and the shuffled pixels are made of, evenly spread over the set


class ControlScans(ScanSource):
    """The scans of a control by their numbers."""

    def __init__(self, control: Control, numbers: Sequence[int]) -> None:
        self.control, self.numbers = control, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.control[self.numbers[index]]

    @property
    def names(self) -> list[str]:
        return [f"{self.control.name} {number}" for number in self.numbers]

    def subset(self, indices: Sequence[int]) -> "ControlScans":
        return ControlScans(self.control, [self.numbers[i] for i in indices])

    def about(self) -> dict[str, object]:
        return {"kind": "control", "seed": self.control.seed, "reflectance": self.control.training.shape[1] > 1}


def control_sets(real: ScanSet, num: int) -> dict[str, ScanSet]:
    """Each control as a set of `num` scans, made of some of the real ones."""
    some = real.spread(LEARNED_FROM)
    training = np.concatenate([batch.numpy() for batch in some.batches(range(len(some)), 8)])
    return {
        name: ScanSet(name, ControlScans(Control(name, training, real.sensor), range(num)), real.sensor)
        for name in CONTROLS
    }
