"""Samples of the published codes of R2Flow and R2DM: tensors in .pth files.

R2Flow's are dictionaries, R2DM's the same tensors stacked, (5, H, W):

    {"depth": (1, H, W) in metres, "xyz": (3, H, W) in metres, "reflectance": (1, H, W) in [0, 1]}

Without a trained reflectance, that of the published code is (0, H, W).
"""

from pathlib import Path
from zipfile import ZipFile

import numpy as np
from numpy import ndarray

from r2flow.base.errors import InputError
from r2flow.lidar.scan_files.cloud import Cloud

_CHANNELS = {"depth": (1,), "xyz": (3,), "reflectance": (0, 1)}


def _read(path: Path) -> dict[str, ndarray]:
    """The three tensors of a sample, (channels, H, W) each; only tensors are unpickled."""
    import torch  # slow

    size = path.stat().st_size
    with ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > size:
            raise InputError("it is compressed, which torch.save does not do. Is it damaged?")
        if damaged := archive.testzip():  # torch does not compare checksums
            raise InputError(f"its part {damaged} is damaged; fetch or write it again.")
    stored = torch.load(path, map_location="cpu", weights_only=True)
    if isinstance(stored, torch.Tensor) and stored.shape[:1] == (5,):  # R2DM's
        stored = dict(zip(_CHANNELS, stored.split([1, 3, 1]), strict=True))
    sample: dict[str, torch.Tensor] = {}
    for name, channels in _CHANNELS.items():
        tensor = stored.get(name) if isinstance(stored, dict) else None
        if not isinstance(tensor, torch.Tensor):
            raise InputError(
                "it is no sample of the published R2Flow or R2DM code, which holds the tensors "
                f"{', '.join(_CHANNELS)}. Is it a file of weights?"
            )
        shape = tuple(tensor.shape)
        image = tuple(sample.get("depth", tensor).shape[1:])
        if len(image) != 2 or shape not in [(count, *image) for count in channels]:
            raise InputError(f"its {name} is {shape}, not ({channels[-1]}, H, W).")
        if tensor.numel() > size:  # a view of few numbers
            raise InputError(f"its {name} is larger than the file. Is it damaged?")
        sample[name] = tensor
    return {name: tensor.numpy() for name, tensor in sample.items()}


def read_image(path: Path) -> ndarray:
    """Range in metres and, where it was trained, reflectance, (2 or 1, H, W)."""
    sample = _read(path)
    return np.concatenate([sample["depth"], sample["reflectance"]])


def _read_points(path: Path) -> Cloud:
    """The points of all pixels; those of rays without return are (0, 0, 0)."""
    sample = _read(path)
    columns = [*sample["xyz"], *sample["reflectance"]]
    names = ("x", "y", "z", "reflectance")[: len(columns)]
    return Cloud(names, tuple(column.ravel() for column in columns))


READERS = {".pth": _read_points}
