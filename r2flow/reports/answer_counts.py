"""What was taken of scans of points, and added to scans, in lines of the terminal."""

from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

from r2flow.lidar.added import unknown_fields
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import COMMON
from r2flow.lidar.scan_files import WRITTEN
from r2flow.lidar.sensors import Sensor
from r2flow.reports.answer_rays import Answered


@dataclass
class Counts:
    """What was taken of scans of points, and added to scans."""

    rays: ndarray = field(default_factory=lambda: np.zeros(len(Ray), int))  # of each state
    outside: int = 0  # points
    added: int = 0
    classes: ndarray = field(default_factory=lambda: np.zeros(1 + len(COMMON), int))  # pixels
    unknown: dict[str, None] = field(default_factory=dict)  # fields that added points lack
    beside: bool = False  # whether fields lie in files beside those of the points

    def add(self, answered: Answered) -> None:
        scan, known = answered.scan, answered.known
        if not answered.completed.evaluations.any():
            print(
                f"{scan.name}: every ray of the image is measured, so nothing is added; see "
                "--size, --from, --fill-gaps and --mask"
            )
        images = answered.completed.images.numpy()
        returned = images[:, 0] > 0
        if images.shape[1] > 2:
            found = images[:, 2][returned].astype(int)
            self.classes += np.bincount(found, minlength=len(self.classes))
        self.added += int((returned & (known.state != Ray.RETURN)).sum())
        if not scan.image:
            self.rays += np.bincount(known.state.ravel(), minlength=len(Ray))
        if known.points and known.points.cloud:
            cloud = known.points.cloud
            self.outside += known.points.dropped
            self.unknown |= dict.fromkeys(unknown_fields(cloud))
            self.beside |= cloud.names is None and scan.ending in WRITTEN

    def lines(self, sensor: Sensor) -> list[str]:
        """What was taken of points."""
        lines = []
        share = self.rays[Ray.EMPTY] / max(self.rays[Ray.EMPTY] + self.rays[Ray.RETURN], 1)
        if share > 0.5:  # 31 % at most of real scans
            lines.append(
                f"{share:.0%} of the measured rays have no return: for thinned scans give "
                "--fill-gaps"
            )
        if self.unknown:
            lines.append(f"NaN or 0 for added points: {', '.join(self.unknown)[:200]}")
        if self.beside:
            lines.append(
                "which points are measured, and their rows: in NAME.fields.npz beside the points"
            )
        if self.rays.any():
            rows, columns = sensor.shape
            lines.append(
                f"used: the nearest point in each pixel of {rows}x{columns}; {self.outside:,} "
                f"outside {sensor.min_range:g}-{sensor.max_range:g} m left out"
            )
        if (total := self.classes.sum()) > 0:
            named = zip(self.classes / total, ["no class", *COMMON], strict=True)
            largest = sorted(named, reverse=True)
            told = ", ".join(f"{name} {share:.0%}" for share, name in largest if share >= 0.005)
            lines.append(f"classes of the pixels with a return: {told}")
        return lines
