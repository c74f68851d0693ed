"""Model space: range images encoded, [-1, 1], and decoded to metres and points."""

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import (
    Bound,
    Registry,
    construct,
    options_of,
    presets,
)
from r2flow.lidar.labels import COMMON
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.range_formats import FORMATS
from r2flow.lidar.sensors import Sensor, build_sensor

LIMIT_TOLERANCE = 1e-5  # relative, of closed range limits in decoding, for float32's rounding
_FULL = 1 + 1e-3  # maximum reflectance; larger values mean another scale
_LEAST = 0.05  # probability of a decoded label; all planes of a ray without label are -1
FAR = 300.0  # metres, above any scan's median range, unless its sensor has a larger limit


class Encoding:
    """Range images in metres to model space, [-1, 1] in every channel, and back.

    Args:
        sensor: Sensor of the images; ranges within its limits are returns.
        format: `logscale` (the paper's), `shifted_log` (LiDARGen's and LiDM's), `inverse`,
            `inverse_depth` (DUSty's), or `metric`.
        reflectance: Whether reflectance is a channel, in addition to range.
        limits: `closed`: ranges equal to the sensor's limits are returns. `open`, as in R2DM: they
            are not.
        levels: Decoded reflectance is rounded to n / levels, as the sensor reports it; None: it is
            not rounded.
        labels: Whether labels are channels, a plane for each class of `r2flow.lidar.labels.COMMON`;
            with reflectance alone.
    """

    def __init__(
        self,
        sensor: Sensor,
        format: str = "logscale",
        reflectance: bool = True,
        limits: Literal["closed", "open"] = "closed",
        levels: Annotated[float, Bound("whole and above 0", lambda n: n > 0 and n % 1 == 0)]
        | None = None,
        labels: bool = False,
    ) -> None:
        if labels and not reflectance:
            raise InputError("encoding.labels needs encoding.reflectance, and scans that have it.")
        self.sensor = sensor
        self.reflectance = reflectance
        self.labels = labels
        self.limits = limits
        self.levels = levels
        self.format = FORMATS[format](sensor)

    def described(self) -> dict[str, Any]:
        """All options but the sensor, as plain values."""
        return {
            "format": FORMATS.name_of(type(self.format)),
            "reflectance": self.reflectance,
            "limits": self.limits,
            "levels": self.levels,
            "labels": self.labels,
        }

    def through(self, sensor: Sensor) -> "Encoding":
        """The same encoding of another sensor's ranges, whose levels of reflectance are unknown."""
        other = copy(self)
        other.sensor = sensor
        other.format = type(self.format)(sensor)
        other.levels = self.levels if sensor.name == self.sensor.name else None
        return other

    @property
    def slices(self) -> dict[str, slice]:
        """The channels of model space by name: range, reflectance and label, as far as it has them.

        Those of an image in metres are as many, each of one channel.
        """
        sizes = {"range": 1, "reflectance": int(self.reflectance)}
        if self.labels:
            sizes["label"] = len(COMMON)
        ends = np.cumsum([*sizes.values()])
        return {
            name: slice(int(end) - size, int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
            if size
        }

    @property
    def channels(self) -> int:
        return [*self.slices.values()][-1].stop

    @property
    def shape(self) -> tuple[int, int, int]:
        """(C, H, W) of a scan in model space."""
        return self.channels, *self.sensor.shape

    def encode(self, image: Tensor) -> Tensor:
        """Map range in metres, reflectance in [0, 1] and common class to model space.

        Shapes are (..., 1 to 3, H, W), of the channels in `slices`, and (..., channels, H, W).
        A range outside the limits is a dropped ray, which becomes exactly -1 in both channels, or
        nearly under `shifted_log`; values are clipped to [-1, 1]. NaN stays. The plane of a ray's
        class is 1, others are -1.
        """
        x = self.encode_returns(image)
        if self.labels:
            classes = torch.arange(1, len(COMMON) + 1, device=x.device)[:, None, None]
            x = torch.cat([x, (image[..., 2:3, :, :] == classes).to(x) * 2 - 1], dim=-3)
        return x

    def encode_returns(self, image: Tensor) -> Tensor:
        """Range and reflectance alone, as `encode`, (..., 2 or 1, H, W)."""
        r = image[..., :1, :, :]
        returned = self._is_return(r)
        y = self.format.forward(torch.where(returned | r.isnan(), r, 0.0))
        if self.limits == "open":
            # 2 y - 1 rounds y below 1/2, to the least y of a return or below it: keep these.
            kept = self._is_return(self.format.inverse(y))
            rounded = self._is_return(self.format.inverse((2 * y - 1 + 1) / 2))
            y = torch.where(kept & ~rounded, y + 2**-24, y)
        if self.reflectance:
            assert image.shape[-3] > 1, "the model has a reflectance channel and the scan has none"
            y = torch.cat([y, torch.where(returned, image[..., 1:2, :, :], 0.0)], dim=-3)
        return (2 * y - 1).clamp(-1, 1)

    def decode(self, x: Tensor) -> Tensor:
        """Map (..., channels, H, W) to range in metres and reflectance, (..., 2 or 1, H, W).

        Ranges outside the limits are dropped rays, 0 in both; reflectance is clamped to [0, 1] and
        rounded to `levels`. With `labels` there follow the likeliest class and its probability.
        """
        y = (x + 1) / 2
        r = self.format.inverse(y[..., :1, :, :])
        returned = self._is_return(r)
        near = self.sensor.min_range * (1 + 1e-6)  # also the rounded points are within the limits
        image = torch.where(returned, r.clamp(near, self.sensor.max_range * (1 - 1e-6)), 0.0)
        if self.reflectance:
            reflectance = y[..., 1:2, :, :].clamp(0, 1)
            if self.levels is not None:
                reflectance = (reflectance * self.levels).round() / self.levels
            image = torch.cat([image, torch.where(returned, reflectance, 0.0)], dim=-3)
        if self.labels:
            probability, label = y[..., self.slices["label"], :, :].max(-3, keepdim=True)
            labelled = returned & (probability > _LEAST)
            label = torch.where(labelled, label + 1, 0)
            image = torch.cat(
                [image, label.to(image), torch.where(labelled, probability, 0.0)], dim=-3
            )
        return image

    def _is_return(self, r: Tensor) -> Tensor:
        slack = 0.0
        if self.limits == "closed":
            slack = max(LIMIT_TOLERANCE, torch.finfo(r.dtype).eps)
        near = self.sensor.min_range * (1 - slack)
        return (r > near) & (r < self.sensor.max_range * (1 + slack))


def wrong_with(image: Tensor, far: float = FAR) -> str | None:
    """Problem of a range image, (2 or 1, H, W), with a hint; None if it is in metres and [0, 1]."""
    for name, channel in zip(("range", "reflectance"), image, strict=False):
        least, most = (end.item() for end in channel.aminmax())  # NaN if it contains NaN
        if not math.isfinite(least - most):
            return f"its {name} is NaN or infinite in places; 0 stands for a ray without a return"
        if least < 0:
            hint = "0 stands for no return"
            if max(-least, most) <= 1:
                hint = "is it in model space ([-1, 1])? Decode it"
            return f"its {name} goes down to {least:.4g}; {hint}"
        if name == "reflectance" and most > _FULL:
            return (
                f"its reflectance goes up to {most:.4g}, not 1; divide by its full scale, often 255"
            )
        if name == "range" and most >= far and (median := channel[channel > 0].median()) >= far:
            return f"its median range is {median:.4g} m; are these millimetres? Give metres"
    return None


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

    def points(self, images: Tensor) -> list[ndarray]:
        """The returns of each range image as a point cloud, along rays through the pixels' centres.

        Args:
            images: Range in metres and, optionally, reflectance, (B, 2 or 1, H, W); 0 for dropped
                rays.

        Returns:
            For each image x, y, z in metres (x ahead, y left, z up) and reflectance, (N, 4)
            float32; N differs between scans. Reflectance is 0 if the images have none.
        """
        rays = self.sensor.rays()
        clouds = (image_to_points(image, rays) for image in images.detach().float().cpu().numpy())
        return [np.column_stack(cloud) for cloud in clouds]


def encoding_options(encoding: Encoding | str | Mapping[str, Any]) -> dict[str, Any]:
    """Complete options of an encoding, from itself, the name of a file in conf/encoding, or some of
    the options.
    """
    if isinstance(encoding, Encoding):
        return encoding.described()
    if isinstance(encoding, str):
        if encoding not in presets("encoding"):
            Registry("encoding")[encoding]  # not known
        encoding = presets("encoding")[encoding]
    return {**options_of(Encoding, given=1), **encoding}


def build_space(config: Mapping[str, Any]) -> ModelSpace:
    """The model space of a config with the keys `sensor` and `encoding`."""
    options = config["sensor"]
    sensor = construct("sensor", build_sensor, options)
    encoding = construct("encoding", Encoding, config["encoding"], sensor)
    return ModelSpace(sensor, encoding, sensor.rays(options.get("rays", "centre")))
