"""Batches of scans for metrics: checked, masked, with derived representations."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.lidar.encoding import wrong_with
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import Rays, Sensor

# Range limits of returns in metres, for both sets and all metrics, as in the published evaluation.
MASK = (0.5, 63.0)

# Bird's-eye histograms: bins per side over +-80 m, returns of 3 m < r < 70 m.
BINS = 100
EXTENT = 80
NEAR = 3
FAR = 70


class Scans:
    """Range images of one sensor, masked to MASK[0] < r < MASK[1], with lazily derived data.

    Args:
        images: Range in metres and optionally reflectance in [0, 1], (B, 2 or 1, H, W); 0 where
            missing.
        rays: Position of a pixel's ray, and so its point, in its bin: as in `Sensor.rays`.
        xyz: Measured points of the pixels, (B, 3, H, W) in metres; `rays` is then unused.
        names: Names of the scans in messages; default: index in the batch.

    Raises:
        InputError: The images have another shape, or values that no scan has.
    """

    def __init__(
        self,
        images: Tensor,
        sensor: Sensor,
        rays: Rays = "centre",
        xyz: Tensor | None = None,
        names: Sequence[object] | None = None,
    ) -> None:
        shape = images.shape
        if shape[2:] != sensor.shape or shape[1] not in (1, 2):
            wanted = f"(B, 2 or 1, {sensor.shape[0]}, {sensor.shape[1]})"
            raise InputError(f"images of {sensor.name} have the shape {wanted}, not {(*shape,)}.")
        images = images.float()
        for name, image in zip(names or range(len(images)), images, strict=True):
            if wrong := wrong_with(image):
                raise InputError(f"scan {name}: {wrong}.")
        r = images[:, :1]
        self.images = torch.where((r > MASK[0]) & (r < MASK[1]), images, 0.0)
        self.sensor = sensor
        self.features: dict[Any, Tensor] = {}  # of networks, by network; the counts of the panel
        self._rays = rays
        self._measured = xyz

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
    def nonempty(self) -> Tensor:
        """Scans with a return, (B,), bool."""
        return self.returned.flatten(1).any(1)

    def nan_where_empty(self, rows: Tensor) -> Tensor:
        """Rows (B, D) with NaN for scans without returns."""
        return torch.where(self.nonempty[:, None].to(rows.device), rows, torch.nan)

    @cached_property
    def xyz(self) -> Tensor:
        """Points of all pixels in metres, (B, 3, H, W); the origin without a return."""
        if self._measured is not None:
            return self._measured.to(self.images) * self.returned
        if self._rays == "reference":
            return _on_bin_corners(self.images[:, :1], self.sensor)
        return unproject(self.images[:, :1], self.sensor.rays(self._rays).to(self.images.device))

    @cached_property
    def points(self) -> list[Tensor]:
        """Points of each scan's returns in metres, B tensors of (N_i, 3), row by row."""
        return [xyz[:, kept[0]].T for xyz, kept in zip(self.xyz, self.returned, strict=True)]

    @cached_property
    def birds_eye(self) -> ndarray:
        """Bird's-eye histogram of each scan, (B, 100, 100), float64: see `_birds_eye_histogram`."""
        return np.stack([_birds_eye_histogram(points.cpu().numpy()) for points in self.points])


def _birds_eye_histogram(xyz: ndarray) -> ndarray:
    """Histogram of points (N, 3) in the horizontal plane: 100 x 100 bins over +-80 m, (100, 100).

    Points with 3 m < r < 70 m are counted. Uses torch's function in float32, as published: its edge
    between the middle bins lies at -1.2e-6 m, which decides the bin of points on rays along the
    axes.
    """
    points = torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32))
    r = points.norm(dim=1)
    inside = points[(r > NEAR) & (r < FAR), :2]
    ends = [-float(EXTENT), float(EXTENT)] * 2
    return torch.histogramdd(inside, bins=[BINS, BINS], range=ends).hist.double().numpy()


def _on_bin_corners(r: Tensor, sensor: Sensor) -> Tensor:
    """Points (B, 3, H, W) at ranges (B, 1, H, W) on rays through the bins' upper left corners.

    Four of these columns lie on the axes, where cells of the bird's-eye view meet and the last bit
    of float32 decides; the computation therefore follows the published code, degrees first.
    """
    e = torch.from_numpy(sensor.row_edges[:-1, None]).float().deg2rad().to(r.device)
    turn = np.arange(sensor.columns) / sensor.columns
    a = torch.from_numpy(180 - 360 * turn).float().deg2rad().to(r.device)
    return torch.cat([r * e.cos() * a.cos(), r * e.cos() * a.sin(), r * e.sin()], 1)
