"""Evaluation protocols: the paper's and ours, by name. Results of different protocols are not comparable.

The protocols differ in the position of a pixel's point, which affects bird's-eye histograms and the networks' inputs x,
y and z, and in the choice of real scans from larger sets. Masks, histograms and features are the same.
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from r2flow.data.opening import SOURCES
from r2flow.data.sets import ScanSet, fixed_choice
from r2flow.errors import InputError
from r2flow.lidar.scan_files import scan_ending
from r2flow.lidar.sensors import Convention, Rays
from r2flow.registry import Registry

WORDS = {"measured": "as measured", "centre": "on rays through bin centres", "reference": "on rays through bin corners"}


@dataclass(frozen=True)
class Rules:
    """A protocol. A pixel's point is as measured, or on the ray through its bin's centre or corner ("reference")."""

    name: str
    real: Literal["measured"] | Rays  #: a pixel's point in real scans
    generated: Rays  #: a pixel's point in generated scans
    convention: Convention | None  #: default projection of point clouds to images; None: the model's
    choose: Callable[[ScanSet, int], Sequence[int]]  #: sorted indices of at most n scans of a set
    chosen: str  #: description of the choice

    def check(self, real: ScanSet) -> None:
        """Refuse a real set without the measured coordinates that the protocol needs: a scan of each format."""
        names = real.source.names if self.real == "measured" else []
        try:
            for number in {scan_ending(names[n]): n for n in reversed(range(len(names)))}.values():
                real.source.with_points(number)
        except InputError:
            raise InputError(
                f"{names[number]} of {real.label} lacks the measured coordinates of its points, which the protocol "
                f"'{self.name}' compares: only point files have them (KITTI's .bin). Or give --protocol r2flow."
            ) from None


def published_choice(scans: ScanSet, most: int) -> list[int]:
    """The first `most` scans of Python's `random.Random(0).shuffle`, sorted, as in the published code.

    The published evaluation lists KITTI-360's training drives before its test drives.
    """
    order = list(range(len(scans)))
    if "kitti_360" in str(scans.about.get("kind")):
        layout = SOURCES["kitti_360"]
        test = {n for drive, indices in scans.drives.items() if layout.split_of(drive) == "test" for n in indices}
        order.sort(key=lambda number: number in test)
    random.Random(0).shuffle(order)  # the permutation depends only on the length
    return sorted(order[:most])


R2FLOW = Rules(
    "r2flow", "centre", "centre", None, lambda scans, most: fixed_choice(len(scans), most), "fixed shuffle, seed 0"
)
PAPER = Rules("paper", "measured", "reference", "reference", published_choice, "Python's shuffle, seed 0")
PROTOCOLS: Registry[Rules] = Registry("protocol", r2flow=R2FLOW, paper=PAPER)
