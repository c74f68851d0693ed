"""Model space: encoded images of a sensor, and decoding to metres and points."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError, check
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import Sensor, build_sensor
from r2flow.registry import check_options, construct


@dataclass(frozen=True, eq=False)
class ModelSpace:
    """Images (C, H, W) in model space: a sensor's range images, encoded."""

    sensor: Sensor
    encoding: Encoding
    rays: Tensor  # elevation and azimuth of every pixel in radians, (2, H, W), an input of networks

    def through(self, sensor: Sensor) -> "ModelSpace":
        """The model space of another sensor with the same encoding."""
        return ModelSpace(sensor, self.encoding.through(sensor), sensor.rays())

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, H, W) of an image."""
        return self.encoding.shape

    def decode(self, x: Tensor) -> Tensor:
        """Decode model space, (B, C, h, w), to metres and reflectance, (B, 2 or 1, h, w)."""
        return self.encoding.decode(x)

    def points(self, images: Tensor) -> list[np.ndarray]:
        """The returns of each range image as a point cloud, along rays through the pixels' centres.

        Args:
            images: Range in metres and, optionally, reflectance, (B, 2 or 1, H, W); 0 for dropped rays.

        Returns:
            For each image x, y, z in metres (x ahead, y left, z up) and reflectance, (N, 4) float32; N differs between
            scans. Reflectance is 0 if the images have none.
        """
        images = torch.as_tensor(images)
        if images.ndim != 4 or images.shape[1] not in (1, 2) or tuple(images.shape[2:]) != self.sensor.shape:
            h, w = self.sensor.shape
            raise InputError(
                f"range images have the shape (B, 2 or 1, {h}, {w}), found {tuple(images.shape)}; for "
                "scans of another sensor there is r2flow.lidar.projection.image_to_points."
            )
        rays = self.sensor.rays()
        clouds = (image_to_points(image, rays) for image in images.float().cpu().numpy())
        return [np.column_stack(cloud) for cloud in clouds]


def build_space(config: Mapping[str, Any]) -> ModelSpace:
    """The model space of a config with the keys `sensor` and `encoding`."""
    check({"sensor", "encoding"} <= config.keys(), "the config of a model needs 'sensor' and 'encoding'.")
    sensor = construct("sensor", build_sensor, config["sensor"])
    check_options("encoding", Encoding, config["encoding"], given=1)
    rays = sensor.rays(config["sensor"].get("rays", "centre"))
    return ModelSpace(sensor, Encoding(sensor, **config["encoding"]), rays)
