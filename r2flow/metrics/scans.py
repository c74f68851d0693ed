"""Batches of scans for metrics: checked, masked, with derived representations."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError, check
from r2flow.lidar.encoding import wrong_with
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import Rays, Sensor
from r2flow.metrics.birds_eye import birds_eye_histogram

# Range limits of returns in metres, for both sets and all metrics, as in the published evaluation.
MASK = (0.5, 63.0)


class Scans:
    """Range images of one sensor, masked to MASK[0] < r < MASK[1], with lazily derived representations.

    Args:
        images: Range in metres and optionally reflectance in [0, 1], (B, 2 or 1, H, W); 0 where missing.
        rays: Position of a pixel's ray, and so its point, in its bin: as in `Sensor.rays`.
        xyz: Measured points of the pixels, (B, 3, H, W) in metres; `rays` is then unused.
        names: Names of the scans in messages; default: index in the batch.
    """

    def __init__(
        self,
        images: Tensor,
        sensor: Sensor,
        rays: Rays = "centre",
        xyz: Tensor | None = None,
        names: Sequence[object] | None = None,
    ) -> None:
        (h, w), found = sensor.shape, tuple(images.shape)
        fits = found[1:] in ((1, h, w), (2, h, w))
        check(fits, f"images of {sensor.name} have the shape (B, 2 or 1, {h}, {w}), not {found}.")
        images = images.float()
        for number, image in enumerate(images):
            if wrong := wrong_with(image):
                raise InputError(f"scan {number if names is None else names[number]}: {wrong}.")
        self.rays, self._measured = rays, xyz
        r = images[:, :1]
        self.images = torch.where((r > MASK[0]) & (r < MASK[1]), images, torch.zeros_like(images))
        self.sensor = sensor
        self.features: dict[Any, Tensor] = {}  # of networks, by network; the counts of the panel

    def __len__(self) -> int:
        return len(self.images)

    @property
    def has_reflectance(self) -> bool:
        return self.images.shape[1] > 1

    @cached_property
    def returned(self) -> Tensor:
        """Pixels with a return, (B, 1, H, W), bool."""
        return self.images[:, :1] > 0

    @cached_property
    def xyz(self) -> Tensor:
        """Points of all pixels in metres, (B, 3, H, W); the origin without a return."""
        if self._measured is not None:
            return self._measured.to(self.images) * self.returned
        if self.rays == "reference":
            return on_bin_corners(self.images[:, :1], self.sensor)
        return unproject(self.images[:, :1], self.sensor.rays(self.rays).to(self.images.device))

    @cached_property
    def points(self) -> list[Tensor]:
        """Points of each scan's returns in metres, B tensors of (N_i, 3), row by row; N_i may be 0."""
        return [xyz.flatten(1).T[kept.flatten()] for xyz, kept in zip(self.xyz, self.returned, strict=True)]

    @cached_property
    def birds_eye(self) -> np.ndarray:
        """Bird's-eye histogram of each scan, (B, 100, 100), float64: see `birds_eye_histogram`."""
        return np.stack([birds_eye_histogram(points.cpu().numpy()) for points in self.points])


def on_bin_corners(r: Tensor, sensor: Sensor) -> Tensor:
    """Points (B, 3, H, W) at ranges (B, 1, H, W) on the rays through the upper left corners of the bins.

    Four of these columns lie on the axes, where cells of the bird's-eye view meet and the last bit of float32 decides;
    the computation therefore follows the order of the published code, degrees first.
    """
    degrees = np.meshgrid(sensor.row_edges[:-1], 180 - 360 * np.arange(sensor.columns) / sensor.columns, indexing="ij")
    e, a = (torch.from_numpy(angle).float().deg2rad().to(r.device) for angle in degrees)
    return torch.cat([r * e.cos() * a.cos(), r * e.cos() * a.sin(), r * e.sin()], 1)
