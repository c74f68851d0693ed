"""A batch of scans as every metric sees it: masked, in the representation that it asks for."""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.birds_eye import BINS, birds_eye_histogram

# Metres between which the published evaluation keeps returns, on both sides and before every metric.
MASK = (0.5, 63.0)


class Scans:
    """Range images of one sensor, masked to MASK[0] < r < MASK[1], and what is derived from them when it is asked for.

    Args:
        images: Range in metres and, where known, reflectance of [0, 1], (B, 2 or 1, H, W); 0 where missing.
        sensor: The sensor of the images.

    Raises:
        InputError: images of another size than the sensor's.
    """

    def __init__(self, images: Tensor, sensor: Sensor) -> None:
        if images.ndim != 4 or images.shape[1] not in (1, 2) or tuple(images.shape[2:]) != sensor.shape:
            h, w = sensor.shape
            raise InputError(
                f"range images of sensor '{sensor.name}' have the shape (B, 2 or 1, {h}, {w}), "
                f"found {tuple(images.shape)}."
            )
        images = images.float()
        r = images[:, :1]
        self.images = torch.where((r > MASK[0]) & (r < MASK[1]), images, torch.zeros_like(images))
        self.sensor = sensor

    def __len__(self) -> int:
        return len(self.images)

    @property
    def has_reflectance(self) -> bool:
        return self.images.shape[1] > 1

    @property
    def reflectance(self) -> Tensor:
        """Reflectance of every pixel, (B, 1, H, W); 0 where missing.

        Raises:
            InputError: the scans have none.
        """
        if not self.has_reflectance:
            raise InputError("these scans have no reflectance; use features of range alone, as handcrafted_range.")
        return self.images[:, 1:]

    @cached_property
    def returned(self) -> Tensor:
        """Pixels with a return, (B, 1, H, W), bool."""
        return self.images[:, :1] > 0

    @cached_property
    def xyz(self) -> Tensor:
        """Points in metres of every pixel, (B, 3, H, W); the origin where there is no return."""
        return unproject(self.images[:, :1], self.sensor.rays().to(self.images.device))

    @cached_property
    def points(self) -> list[Tensor]:
        """The returns of each scan in metres, B tensors of (N_i, 3), row after row; N_i may be 0."""
        return [xyz.flatten(1).T[kept.flatten()] for xyz, kept in zip(self.xyz, self.returned, strict=True)]

    @cached_property
    def birds_eye(self) -> np.ndarray:
        """Counts from above of each scan, (B, 100, 100), float64: see `birds_eye_histogram`."""
        counts = np.zeros((len(self), BINS, BINS))
        for i, points in enumerate(self.points):
            counts[i] = birds_eye_histogram(points.cpu().numpy())
        return counts
