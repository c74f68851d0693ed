"""Scans and range images from disk, ready to be drawn."""

import logging
from pathlib import Path

import numpy as np
from torch import Tensor

from r2flow.data.sources import read_labelled_scan, read_scan, spread
from r2flow.errors import InputError
from r2flow.evaluation.reading import range_image, scan_paths
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import Sensor

log = logging.getLogger(__name__)


def scans_of(path: Path, most: int) -> list[Path]:
    """The file itself, or at most `most` scans of a folder, evenly spread over it.

    Raises:
        InputError: nothing is there, or a folder without scans.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    if not path.is_dir():
        return [path]
    chosen = scan_paths(path)
    return [chosen[index] for index in spread(len(chosen), most)]


def project_file(
    path: Path, sensor: Sensor, projection: str, convention: str, reflectance_scale: float = 1.0
) -> np.ndarray:
    """A scan as (2, H, W), range in metres and reflectance; (1, H, W) where the file has none."""
    with_reflectance = read_points(path).reflectance is not None
    return read_scan(path, sensor, projection, convention, with_reflectance, reflectance_scale)  # type: ignore[arg-type]


def open_view(
    path: Path, sensor: Sensor, projection: str = "spherical", reflectance_scale: float | None = None
) -> tuple[np.ndarray, Tensor]:
    """(image, rays) of a scan file, or of a range image in a .npy of shape (2 or 1, H, W).

    Without a reflectance scale, 1 is taken where the file stays below it, else 255, else its highest value: good
    enough for a picture, and for nothing else.
    """
    image = range_image(path)
    if image is not None:
        return image, sensor.resized(*image.shape[1:]).rays()
    if reflectance_scale is None:
        found = read_points(path).reflectance
        highest = 0.0 if found is None else float(np.nan_to_num(found).max(initial=0))
        reflectance_scale = 1.0 if highest <= 1 else max(highest, 255.0)
    return project_file(path, sensor, projection, "centre", reflectance_scale), sensor.rays()


def label_view(path: Path, sensor: Sensor, projection: str = "spherical") -> np.ndarray | None:
    """The classes, (H, W), that `open_view` has no place for; None, with a warning, where the scan has no labels."""
    labels = None
    if range_image(path) is None:
        _, labels = read_labelled_scan(path, sensor, projection=projection, reflectance=False)
    if labels is None:
        log.warning("%s: no .label file lies beside it", path)
    return labels
