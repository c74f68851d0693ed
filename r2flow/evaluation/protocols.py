"""Evaluation protocols: the paper's and ours, by name. Results of two protocols do not compare.

The protocols differ in the position of a pixel's point, which affects bird's-eye histograms and the
networks' inputs x, y and z, and in the choice of real scans from larger sets. Masks, histograms and
features are the same.
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from r2flow.base.errors import InputError
from r2flow.base.registry import Registry
from r2flow.data.kinds import SOURCES
from r2flow.data.sets import ScanSet, fixed_choice
from r2flow.lidar.sensors import Convention, Rays

WORDS = {
    "measured": "as measured",
    "centre": "on rays through bin centres",
    "reference": "on rays through bin corners",
}


@dataclass(frozen=True)
class Rules:
    """A protocol.

    A pixel's point is as measured, or on the ray through its bin's centre or corner ("reference").
    """

    name: str
    real: Literal["measured"] | Rays  #: a pixel's point in real scans
    generated: Rays  #: a pixel's point in generated scans
    convention: Convention | None  #: default projection of points to images; None: the model's
    choose: Callable[[ScanSet, int], Sequence[int]]  #: sorted numbers of at most n scans of a set
    choice: str  #: its description

    def check(self, real: ScanSet) -> None:
        """Refuse a real set whose first scan lacks the measured coordinates that are compared."""
        if self.real != "measured":
            return
        try:
            real.source.with_points(0)
        except InputError:
            raise InputError(
                f"{real.source.names[0]} of {real.label} lacks the measured coordinates of its "
                f"points, which the protocol '{self.name}' compares: only point files have them "
                "(KITTI's .bin). Or give --protocol r2flow."
            ) from None


def _fixed_choice(scans: ScanSet, most: int) -> list[int]:
    return fixed_choice(len(scans), most)


def _published_choice(scans: ScanSet, most: int) -> list[int]:
    """The first `most` scans of Python's `random.Random(0).shuffle`, sorted, as published.

    The published evaluation lists KITTI-360's training drives before its test drives.
    """
    order = list(range(len(scans)))
    if "kitti_360" in str(scans.about.get("kind")):
        split_of = SOURCES["kitti_360"].split_of
        test: set[int] = set()
        for drive, numbers in scans.drives.items():
            if split_of(drive) == "test":
                test.update(numbers)
        order.sort(key=test.__contains__)
    random.Random(0).shuffle(order)  # the permutation depends only on the length
    return sorted(order[:most])


R2FLOW = Rules("r2flow", "centre", "centre", None, _fixed_choice, "fixed shuffle, seed 0")
PAPER = Rules(
    "paper", "measured", "reference", "reference", _published_choice, "Python's shuffle, seed 0"
)
PROTOCOLS: Registry[Rules] = Registry("protocol", r2flow=R2FLOW, paper=PAPER)
