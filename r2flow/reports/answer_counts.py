"""What was taken of scans of points, and added to scans, in lines of the terminal."""

from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

from r2flow.data.partial import PartialScan
from r2flow.lidar.added import unknown_fields
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import COMMON
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.scan_files import WRITTEN
from r2flow.lidar.sensors import Sensor
from r2flow.model.completion import Completed


@dataclass
class Counts:
    """What was taken of scans of points, and added to scans."""

    rays: ndarray = field(default_factory=lambda: np.zeros(len(Ray), int))  # of each state
    outside: int = 0  # points
    added: int = 0
    classes: ndarray = field(default_factory=lambda: np.zeros(len(COMMON) + 1, int))  # returns
    unknown: dict[str, None] = field(default_factory=dict)  # fields that added points lack
    beside: bool = False  # whether fields lie in files beside those of the points

    def add(self, scan: PartialScan, given: Partial, completed: Completed) -> None:
        if not completed.evaluations.any():
            print(
                f"{scan.name}: every ray of the image is measured, so nothing is added; see "
                "--size, --from, --fill-gaps and --mask"
            )
        returned = completed.images[:, 0].numpy() > 0
        self.added += int((returned & (given.state != Ray.RETURN)).sum())
        if completed.images.shape[1] > 2:
            classes = completed.images[:, 2].numpy()[returned].astype(int)
            self.classes += np.bincount(classes, minlength=len(self.classes))
        if not scan.image:
            self.rays += np.bincount(given.state.ravel(), minlength=len(Ray))
        if given.points and given.points.cloud:
            cloud = given.points.cloud
            self.outside += given.points.dropped
            self.unknown |= dict.fromkeys(unknown_fields(cloud))
            self.beside |= not cloud.named and scan.ending in WRITTEN


def print_counts(sensor: Sensor, counts: Counts) -> None:
    """Print what was taken of points."""
    rays = counts.rays
    share = rays[Ray.EMPTY] / max(rays[Ray.EMPTY] + rays[Ray.RETURN], 1)
    if share > 0.5:  # 31 % at most of real scans
        print(
            f"{share:.0%} of the measured rays have no return: for thinned scans give --fill-gaps"
        )
    if of_class := counts.classes[1:].sum():
        shares = zip(COMMON, counts.classes[1:] / of_class, strict=True)
        ordered = sorted(shares, key=lambda named: -named[1])
        print(f"classes: {', '.join(f'{name} {part:.0%}' for name, part in ordered if part)}")
    if counts.unknown:
        print(f"NaN or 0 for added points: {', '.join(counts.unknown)[:200]}")
    if counts.beside:
        print("which points are measured, and their rows: in NAME.fields.npz beside the points")
    if rays.any():
        rows, columns = sensor.shape
        print(
            f"used: the nearest point in each pixel of {rows}x{columns}; {counts.outside:,} "
            f"outside {sensor.min_range:g}-{sensor.max_range:g} m left out"
        )
