"""Resumable folders of simulated scans."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError
from r2flow.base.files import atomic_write
from r2flow.base.registry import Registry
from r2flow.lidar.projection import image_to_points, write_scan
from r2flow.lidar.sensors import Sensor
from r2flow.simulator import REVISION, simulate
from r2flow.store import FileStore

_KIND = "simulated"
# npy is the range image itself.
_FORMATS = Registry("format", bin=".bin", pcd=".pcd", ply=".ply", npy=".npy")


class SimulatedFolder(FileStore):
    """The scans of a folder; scan i is a function of sensor, seed and i only.

    Args:
        formats: Endings of the files of a scan, from `_FORMATS`.
        labels: Whether each scan has a SemanticKITTI .label file, a uint32 per point in the order
            of the points.
    """

    def __init__(
        self,
        folder: str | Path,
        sensor: Sensor,
        seed: int,
        formats: Sequence[str] = ("bin",),
        labels: bool = False,
    ) -> None:
        reading = {"sensor": sensor.described(), "reflectance_scale": 1.0}
        endings = [*formats, *(["label"] if labels else [])]
        super().__init__(
            folder, _KIND, {"simulator": REVISION, "seed": seed, "reading": reading}, endings
        )
        self.sensor = sensor
        self.seed = seed
        self.formats = formats
        self.labels = labels
        for name in formats:
            _FORMATS[name]
        if labels and tuple(formats) == ("npy",):
            raise InputError(
                "labels are those of points, and .npy is a range image without points; "
                "add another format, such as bin."
            )

    def simulate(self, item: int) -> None:
        scan = simulate(self.sensor, self.seed, item)
        rays = self.sensor.rays()
        name = f"{item:06d}"
        write_scan(scan.image, rays, self.folder, name, self.formats)
        if self.labels:
            # In the order of the points; ids are exact in float32.
            _, labels = image_to_points(
                np.stack([scan.image[0], scan.labels.astype(np.float32)]), rays
            )
            with atomic_write(self.folder / f"{name}.label") as file:
                file.write(labels.astype("<u4").tobytes())
