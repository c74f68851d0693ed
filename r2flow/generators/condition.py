"""Conditions: partial scans as input of a generator."""

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators.base import IMAGE, KNOWN, Condition
from r2flow.lidar.encoding import ModelSpace
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """Condition of partial scans: `image` and `known`, each (B, C, H, W) in model space.

    `known` is 1 for measured values. Elsewhere `image` is interpolated (`r2flow.lidar.interpolation.interpolated`), or
    0 if the scan has no measured ray.

    Args:
        images: Range in metres and optionally reflectance, (B, 2 or 1, H, W); 0 without a return. Without the
            reflectance channel, the reflectance of returns is unknown, that of empty rays is known.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W).
    """
    _, h, w = space.shape
    sizes, states = tuple(images.shape), tuple(state.shape)
    if len(sizes) != 4 or sizes[1] not in (1, 2) or sizes[2:] != (h, w) or states != (sizes[0], h, w):
        raise InputError(
            f"the images to complete must be (B, 2 or 1, {h}, {w}) and the states of the rays (B, {h}, {w}), found "
            f"{sizes} and {states}."
        )
    returned, measured = images[:, 0] > 0, state != Ray.UNKNOWN
    if bool((measured & (state != torch.where(returned, int(Ray.RETURN), int(Ray.EMPTY)))).any()):
        raise InputError("a ray's state must be Ray.RETURN for a range above 0, Ray.EMPTY for a measured range of 0, "
                         "and Ray.UNKNOWN for a ray that was not measured.")  # fmt: skip
    encoding = space.encoding
    without_reflectance = encoding.reflectance and images.shape[1] == 1
    guesses = np.stack([interpolated(x, m) for x, m in zip(images.cpu().numpy(), measured.cpu().numpy(), strict=True)])
    filled = torch.where(measured[:, None], images, torch.from_numpy(guesses).to(images))
    image = encoding.encode(torch.cat([filled, torch.zeros_like(filled)], 1) if without_reflectance else filled)
    known = measured[:, None].expand_as(image).to(image)
    if without_reflectance:
        known[:, -1] *= ~returned
    return {IMAGE: image * measured.flatten(1).any(1)[:, None, None, None], KNOWN: known}
