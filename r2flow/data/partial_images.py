"""Range images and maps of labels in .npy files as partially measured images."""

from pathlib import Path

import numpy as np
import torch

from r2flow.base.errors import InputError, check, naming
from r2flow.lidar.encoding import FAR, wrong_with
from r2flow.lidar.known import Ray
from r2flow.lidar.labels import LabelList, common_classes
from r2flow.lidar.other_sensors import Partial, image_through
from r2flow.lidar.scan_files import read_numbers, read_range_image
from r2flow.lidar.sensors import Sensor

FROM = "--from, in Python by sensor"


def is_image(path: Path) -> bool:
    """Whether an array is a range image, or a map of labels, of integers."""
    array = read_numbers(path)
    return array.ndim == 3 or (array.ndim == 2 and array.dtype.kind in "iu")


def read_partial(
    path: Path, source: Sensor | None, target: Sensor, ids: LabelList | None
) -> Partial:
    """A range image of floats, (2 or 1, H, W), of a sensor, or with `ids` a map of labels, as a
    partially measured image of another one; InputError: it is neither.
    """
    stored = read_numbers(path)
    if stored.ndim == 2:
        if ids is None:
            raise InputError(f"{path} is a map of labels: give a model with labels, -c labels.")
        return _of_labels(path, stored, ids, target)
    image = read_range_image(path)
    if image is None:
        found = f"{stored.dtype} {stored.shape}"
        raise InputError(f"{path} must be a range image of floats (2 or 1, H, W), found {found}.")
    # what is not finite says nothing of its ray
    known = np.where(np.isfinite(stored), image, stored).astype(np.float32)
    wrong = wrong_with(torch.from_numpy(known), max(FAR, target.max_range))
    check(not wrong, f"{path}: {wrong}; --mask FILE.npy names what was not measured.")
    r = image[0]
    within = (r >= target.min_range) & (r <= target.max_range)
    limits = f"{target.min_range:g}-{target.max_range:g} m"
    words = f"{path}: none of its ranges lies within {limits}. Are they in m?"
    check(within.any() or not r.any(), words)
    rows, columns = r.shape
    if source is not None and rows == source.shape[0]:
        return image_through(image, source.resized(columns=columns), target)
    if source is None and r.shape == target.shape:
        return image_through(image, target, target)
    model = "x".join(map(str, target.shape))
    found = f" ({source.name} has {source.shape[0]})" if source else ""
    raise InputError(
        f"{path} is a range image of {rows}x{columns}, those of the model are {model}: name its "
        f"sensor of {rows} rows by {FROM}{found}, or --size {rows}x{columns} alone with densify."
    )


def _of_labels(path: Path, found: np.ndarray, ids: LabelList, target: Sensor) -> Partial:
    """A map of labels, ids of a list, (H, W), of rays that were not measured."""
    if found.shape != target.shape:
        size, model = ("x".join(map(str, shape)) for shape in (found.shape, target.shape))
        raise InputError(f"{path} is a map of labels of {size}, those of the model are {model}.")
    image = np.zeros((3, *target.shape), np.float32)
    with naming(path):
        image[2] = common_classes(ids.semantic(found))
    if not image.any():
        raise InputError(f"{path} has no label: 0 is a ray whose class is not known.")
    return Partial(image, np.full(target.shape, Ray.UNKNOWN, np.uint8))
