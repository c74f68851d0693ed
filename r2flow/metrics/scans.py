"""A batch of scans as every metric sees it: checked, masked, in the representation that it asks for."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.lidar.projection import unproject
from r2flow.lidar.sensors import Convention, Sensor
from r2flow.metrics.birds_eye import BINS, birds_eye_histogram

FULL = 1 + 1e-3  # reflectance; more is another scale, not rounding
FAR = 300.0  # metres: no scan's median range

# Metres between which the published evaluation keeps returns, on both sides and before every metric.
MASK = (0.5, 63.0)


class Scans:
    """Range images of one sensor, masked to MASK[0] < r < MASK[1], and what is derived from them when it is asked for.

    Args:
        images: Range in metres and, where known, reflectance of [0, 1], (B, 2 or 1, H, W); 0 where missing.
        sensor: The sensor of the images.
        rays: Where in its bin the ray of a pixel runs, on which its point lies: as `Sensor.rays`.
        xyz: The points of the pixels where they are known, (B, 3, H, W) in metres: then `rays` are not used.
        names: What each scan is called in a message; its number in the batch if left out.

    Raises:
        InputError: images of another size than the sensor's; or values that no scan has, with the name of the first
            such scan: NaN, a range below 0 or in millimetres, a reflectance outside [0, 1].
    """

    def __init__(
        self,
        images: Tensor,
        sensor: Sensor,
        rays: Convention = "centre",
        xyz: Tensor | None = None,
        names: Sequence[object] | None = None,
    ) -> None:
        if images.ndim != 4 or images.shape[1] not in (1, 2) or tuple(images.shape[2:]) != sensor.shape:
            h, w = sensor.shape
            raise InputError(
                f"images of {sensor.name} have the shape (B, 2 or 1, {h}, {w}), not {tuple(images.shape)}."
            )
        images = images.float()
        for number, image in enumerate(images):
            if wrong := _wrong_with(image):
                raise InputError(f"scan {number if names is None else names[number]}: {wrong}.")
        self.rays, self._measured = rays, xyz
        r = images[:, :1]
        self.images = torch.where((r > MASK[0]) & (r < MASK[1]), images, torch.zeros_like(images))
        self.sensor = sensor

    @cached_property
    def features(self) -> dict[Any, Tensor]:
        """Features of networks that were computed for these scans, by network."""
        return {}

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
        """Points in metres of every pixel, (B, 3, H, W); the origin where there is no return."""
        if self._measured is not None:
            return self._measured.to(self.images) * self.returned
        if self.rays == "reference":
            return on_bin_corners(self.images[:, :1], self.sensor)
        return unproject(self.images[:, :1], self.sensor.rays(self.rays).to(self.images.device))

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


def on_bin_corners(r: Tensor, sensor: Sensor) -> Tensor:
    """Points (B, 3, H, W) on the rays through the upper left corners of the bins, of ranges (B, 1, H, W).

    Four of these columns run along the axes, where cells of the bird's-eye view meet: the last bit of float32 decides,
    and so it is computed here in the order of the published code, degrees first.
    """
    degrees = np.meshgrid(sensor.row_edges[:-1], 180 - 360 * np.arange(sensor.columns) / sensor.columns, indexing="ij")
    e, a = (torch.from_numpy(one).float().deg2rad().to(r.device) for one in degrees)
    return torch.cat([r * e.cos() * a.cos(), r * e.cos() * a.sin(), r * e.sin()], 1)


def _wrong_with(image: Tensor) -> str | None:
    """What is wrong with an image, (2 or 1, H, W), and what to do."""
    low, high = torch.stack(image.flatten(1).aminmax(dim=1)).tolist()  # NaN where a channel has one
    for name, least, most in zip(("range", "reflectance"), low, high, strict=False):
        if not math.isfinite(least) or not math.isfinite(most):
            return f"its {name} is NaN or infinite in places; 0 stands for a ray without a return"
        if least < 0:
            hint = "is it in model space ([-1, 1])? Decode it" if max(-least, most) <= 1 else "0 stands for no return"
            return f"its {name} goes down to {least:.4g}; {hint}"
    if high[0] >= FAR and (median := float(image[0][image[0] > 0].median())) >= FAR:
        return f"its median range is {median:.4g} m; are these millimetres? Give metres"
    if max(high[1:], default=0) > FULL:
        return f"its reflectance goes up to {high[1]:.4g}, not 1; divide by its full scale, often 255"
    return None
