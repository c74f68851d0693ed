"""Under which rules two sets of scans are compared: the paper's and ours, by name; figures of two are not comparable.

They differ in where the points of a pixel lie, which decides bird's-eye histograms and all that a network sees of x, y
and z; and in which real scans are compared where there are more than are needed. The mask, the histograms and the
features are the same.
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from r2flow.data.opening import SOURCES
from r2flow.data.sets import ScanSet, fixed_choice
from r2flow.errors import InputError
from r2flow.lidar.sensors import Convention
from r2flow.registry import Registry

Points = Literal["measured"] | Convention

WORDS = {"measured": "as measured", "centre": "on rays through bin centres", "reference": "on rays through bin corners"}


@dataclass(frozen=True)
class Rules:
    """One protocol."""

    name: str
    real: Points  # where the point of a pixel lies: as measured, or on a ray through its bin's middle or upper left
    generated: Convention  # corner ("reference")
    convention: Convention | None  # how points of files become images where nobody says so; None for the model's
    choose: Callable[[ScanSet, int], Sequence[int]]  # numbers of so many scans of a set, rising
    chosen: str  # how, in words

    def describe(self) -> dict[str, Any]:
        """For a figure's protocol."""
        return {"name": self.name, "points": {"real": WORDS[self.real], "generated": WORDS[self.generated]}}

    def rays(self, real: bool) -> Convention:
        """The rays on which points lie that were not measured."""
        return self.real if real and self.real != "measured" else self.generated

    def check(self, real: ScanSet) -> None:
        """Refuse a real set without the measured coordinates that the protocol compares."""
        if self.real == "measured" and not real.source.measured:
            raise InputError(
                f"{real.label} lacks the measured coordinates of its points, which the protocol '{self.name}' compares:"
                " only files of points have them (KITTI's .bin). Or give --protocol r2flow."
            )


def published_choice(scans: ScanSet, most: int) -> list[int]:
    """`most` scans by the published draw, the first of Python's `random.Random(0).shuffle`, in rising order.

    The published evaluation has KITTI-360's training drives before its test drives.
    """
    order = list(range(len(scans)))
    if "kitti_360" in str(scans.about.get("kind")):
        known = SOURCES["kitti_360"]
        last = {n for drive, held in scans.drives.items() if known.split_of(drive) == "test" for n in held}
        order.sort(key=lambda number: number in last)
    random.Random(0).shuffle(order)  # shuffles whatever stands at each place
    return sorted(order[:most])


R2FLOW = Rules(
    "r2flow", "centre", "centre", None, lambda scans, most: fixed_choice(len(scans), most), "fixed shuffle, seed 0"
)
PAPER = Rules("paper", "measured", "reference", "reference", published_choice, "Python's shuffle, seed 0")
PROTOCOLS: Registry[Rules] = Registry("protocol", r2flow=R2FLOW, paper=PAPER)
