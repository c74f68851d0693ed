"""Scan files and range images on the disk as images of one sensor."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r2flow.data.sources import read_scan
from r2flow.errors import InputError
from r2flow.lidar.projection import Convention, Projection, project
from r2flow.lidar.scan_files import SCAN_ENDINGS, NoPointsError, read_points
from r2flow.lidar.sensors import Sensor


@dataclass(frozen=True)
class Reading:
    """How scans of any kind become images of one sensor.

    Attributes:
        sensor: Its rays and its size.
        reflectance_scale: The value in the files that means full reflectance.
        reflectance: Whether it is read where it is there; False spares a scale that nobody asks for.
    """

    sensor: Sensor
    projection: Projection = "spherical"
    convention: Convention = "centre"
    reflectance_scale: float = 1.0
    reflectance: bool = True

    def identity(self) -> dict[str, Any]:
        """All of it, as plain values."""
        return asdict(self)


class FolderScans:
    """Scan files of any known format and range images, side by side, each read when it is asked for.

    A scan without a single return in the sensor's view is an empty image: a generator that makes such scans is judged
    by them. A file that cannot be read stops the evaluation.
    """

    def __init__(self, root: Path, paths: Sequence[Path], reading: Reading) -> None:
        self.root, self.paths, self.reading = root, list(paths), reading

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> list[str]:
        return [str(path.relative_to(self.root)) for path in self.paths]

    def subset(self, indices: Sequence[int]) -> "FolderScans":
        return FolderScans(self.root, [self.paths[i] for i in indices], self.reading)

    def __getitem__(self, index: int) -> np.ndarray:
        path, reading = self.paths[index], self.reading
        channels = 1 + reading.reflectance
        image = range_image(path, reading.sensor)
        if image is None:
            return self._projected(path)
        if len(image) < channels:
            raise InputError(f"{path} has no reflectance, which other scans of its set have; measure range alone.")
        return image[:channels]

    def _projected(self, path: Path) -> np.ndarray:
        reading = self.reading
        how = reading.sensor, reading.projection, reading.convention
        try:
            return read_scan(path, *how, reading.reflectance, reading.reflectance_scale)
        except NoPointsError:
            pass
        except InputError:
            points = read_points(path)  # raises again what is wrong with the file
            if project(points.xyz, None, *how, points.ring)[0].any():
                raise
        return np.zeros((1 + reading.reflectance, *reading.sensor.shape), np.float32)


def range_image(path: Path, sensor: Sensor | None = None) -> np.ndarray | None:
    """The range image in a .npy of shape (2 or 1, H, W), what is not finite as 0; None where the file is another.

    Raises:
        InputError: one of another size than the sensor's.
    """
    if path.suffix.lower() != ".npy":
        return None
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError):
        return None  # the reader of points explains what is wrong with it
    if array.ndim != 3 or array.shape[0] not in (1, 2) or array.dtype.kind != "f":
        return None
    if sensor is not None and array.shape[1:] != sensor.shape:
        found, wanted = ("x".join(map(str, shape)) for shape in (array.shape[1:], sensor.shape))
        raise InputError(f"{path} is a range image of {found}, the sensor's is {wanted}; give --size {found}.")
    return np.nan_to_num(array.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def scan_paths(root: Path) -> list[Path]:
    """The scans below a folder, in order; of one that lies there in several formats, its range image or the first.

    Raises:
        InputError: no folder is there, or none with scans.
    """
    if not root.is_dir():
        raise InputError(f"{root} is not a folder. Give a folder of scans, LAYOUT:FOLDER, simulated:SEED or a run.")
    found = sorted(p for p in root.rglob("*") if p.name.lower().endswith(tuple(SCAN_ENDINGS)))
    one_of_each = {p.with_suffix(""): p for p in sorted(found, key=lambda p: p.suffix == ".npy")}
    if not one_of_each:
        raise InputError(f"{root} holds no scan; known endings: {', '.join(sorted(SCAN_ENDINGS))}.")
    return sorted(one_of_each.values())


def has_reflectance(paths: Sequence[Path]) -> bool:
    """Judged by the first scan that has a return; 0 throughout is none: a KITTI .bin has a column for it anyway."""
    for path in paths[:100]:
        image = range_image(path)
        if image is None:
            try:
                found = read_points(path).reflectance
            except NoPointsError:
                continue
            return found is not None and bool(found.any())
        if image[0].any():
            return len(image) > 1 and bool(image[1].any())
    return False
