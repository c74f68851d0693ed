"""Scans and range images from disk, ready to be drawn."""

import logging
from pathlib import Path

import numpy as np
from torch import Tensor

from r2flow.data.sources import read_labelled_scan, read_scan, spread
from r2flow.errors import InputError
from r2flow.lidar.scan_files import SCAN_ENDINGS, read_points
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
    found = sorted(p for p in path.rglob("*") if p.name.lower().endswith(tuple(SCAN_ENDINGS)))
    # A sample is written in several formats: one of each is enough, and its range image is the exact one.
    one_of_each = {p.with_suffix(""): p for p in sorted(found, key=lambda p: p.suffix == ".npy")}
    chosen = sorted(one_of_each.values())
    if not chosen:
        raise InputError(f"{path} holds no scan; known endings: {', '.join(sorted(SCAN_ENDINGS))}.")
    return [chosen[index] for index in spread(len(chosen), most)]


def project_file(
    path: Path, sensor: Sensor, projection: str, convention: str, reflectance_scale: float = 1.0
) -> np.ndarray:
    """A scan as (2, H, W), range in metres and reflectance, which is 0 throughout where the file has none."""
    with_reflectance = read_points(path).reflectance is not None
    image = read_scan(path, sensor, projection, convention, with_reflectance, reflectance_scale)  # type: ignore[arg-type]
    return image if with_reflectance else np.concatenate([image, np.zeros_like(image)])


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


def range_image(path: Path) -> np.ndarray | None:
    if path.suffix.lower() != ".npy" or not path.is_file():
        return None
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError):
        return None  # read_points explains what is wrong with it
    if array.ndim == 3 and array.shape[0] in (1, 2) and array.dtype.kind == "f":
        return np.nan_to_num(array.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return None
