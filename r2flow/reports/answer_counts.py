"""What was taken of scans of points, and added to scans, in lines of the terminal."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy import ndarray

from r2flow.generators import TransferFlow
from r2flow.lidar.added import unknown_fields
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import COMMON, labels_beside
from r2flow.lidar.scan_files import WRITTEN
from r2flow.lidar.sensors import SENSORS, Sensor
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.answer_rays import Answered

LITTLE = 0.01  # new points a pixel; why there are fewer is told


def more_rows(sensor: Sensor, own: bool, image: bool = False) -> str:
    """Options by which answers get rows between the beams of scans of this sensor, `own`: which is
    not the model's.
    """
    rows, columns = sensor.shape
    name = sensor.name if sensor.name in SENSORS else "FILE (r2flow sensor SCANS --out FILE)"
    source = f"--from {name} " if image else ""
    return f"{source}{f'--to {name} ' if own else ''}--size {2 * rows}x{columns}"


def and_more(names: Sequence[object]) -> str:
    """The first of some names, and the number of others."""
    return f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else str(names[0])


@dataclass
class Counts:
    """What was taken of scans of points, and added to scans."""

    rays: ndarray = field(default_factory=lambda: np.zeros(len(Ray), int))  # of each state
    outside: int = 0  # points
    added: int = 0
    little: list[str] = field(default_factory=list)  # names of scans with next to no new points
    open: float = 0.0  # largest share of unmeasured rays of these
    classes: ndarray = field(default_factory=lambda: np.zeros(1 + len(COMMON), int))  # pixels
    given: int = 0  # of these with a class that stands beside the scan
    labels: list[str] = field(default_factory=list)  # the files of these
    unknown: dict[str, None] = field(default_factory=dict)  # fields that added points lack
    beside: bool = False  # whether fields lie in files beside those of the points

    def add(self, answered: Answered) -> None:
        scan, known = answered.scan, answered.known
        images = answered.completed.images.numpy()
        returned = images[:, 0] > 0
        if images.shape[1] > 2:
            found = images[:, 2][returned].astype(int)
            self.classes += np.bincount(found, minlength=len(self.classes))
        file = scan.path and labels_beside(scan.path)
        if file and known.points and (given := known.image[2:].any(0)).any():
            self.given += int((returned & given).sum())
            self.labels.append(file.name)
        new = int((returned & (known.state != Ray.RETURN)).sum())
        self.added += new
        if new < LITTLE * returned.size:
            self.little.append(scan.name)
            self.open = max(self.open, (known.state == Ray.UNKNOWN).mean())
        if not scan.image:
            self.rays += np.bincount(known.state.ravel(), minlength=len(Ray))
        if known.points and known.points.cloud:
            cloud = known.points.cloud
            self.outside += known.points.dropped
            self.unknown |= dict.fromkeys(unknown_fields(cloud))
            self.beside |= cloud.names is None and scan.ending in WRITTEN

    def lines(self, model: Checkpoint) -> list[str]:
        """What was taken of points, and why little was added."""
        sensor = model.sensor
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
        if self.little:
            lines.append(self._why_little(model))
        if (total := self.classes.sum()) > 0:
            named = zip(self.classes / total, ["no class", *COMMON], strict=True)
            largest = sorted(named, reverse=True)
            told = ", ".join(f"{name} {share:.0%}" for share, name in largest if share >= 0.005)
            lines.append(f"classes of the pixels with a return: {told}")
        if self.labels:
            lines.append(
                f"{self.given / total:.0%} of these classes are those of {and_more(self.labels)}; "
                "--hide label finds them anew"
            )
        return lines

    def _why_little(self, model: Checkpoint) -> str:
        rows, columns = model.sensor.shape
        if self.open < 0.1:
            why = f"the scan fills all {rows}x{columns} rays; "
            if isinstance(model.generator, TransferFlow):
                finer = more_rows(model.sensor, model.chosen, not self.rays.any())
                why += f"{finer} has rows between them, "
            why += "--mask rows:4 hides some to compare"
        else:
            why = (
                "the unmeasured rays are in whole sectors, beyond the beams, return nothing or "
                "exceed --max-error"
            )
        return f"{and_more(self.little)}: hardly a new point, as {why}"
