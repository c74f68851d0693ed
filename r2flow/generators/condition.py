"""What is known of scans, as generators take it."""

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators.base import IMAGE, KNOWN, Condition
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray
from r2flow.lidar.space import ModelSpace


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """What is known of scans, as generators take it: `image` and `known`, each (B, C, H, W) in model space.

    `known` is 1 where a value was measured; elsewhere `image` has a guess (`r2flow.lidar.interpolation.interpolated`),
    and 0 where nothing at all was measured.

    Args:
        images: Range in metres and, where known, reflectance, (B, 2 or 1, H, W); 0 without a return. Of a scan without
            reflectance, that of its returns is not known; that of an empty ray is.
        state: `r2flow.lidar.known.Ray` of each ray, (B, H, W).

    Raises:
        InputError: images or states of another shape, or a ray that contradicts its state.
    """
    _, h, w = space.shape
    if images.ndim != 4 or images.shape[1] not in (1, 2) or tuple(images.shape[2:]) != (h, w):
        raise InputError(f"the images to complete must be (B, 2 or 1, {h}, {w}), found {tuple(images.shape)}.")
    if state.shape != images[:, 0].shape:
        raise InputError(f"the states of the rays must be {tuple(images[:, 0].shape)}, found {tuple(state.shape)}.")
    returned, seen = images[:, 0] > 0, state != Ray.UNKNOWN
    if bool((seen & (state != torch.where(returned, int(Ray.RETURN), int(Ray.EMPTY)))).any()):
        raise InputError("the state of a measured ray is Ray.RETURN where its range is above 0 and Ray.EMPTY where it "
                         "is 0, and of another ray Ray.UNKNOWN.")  # fmt: skip
    encoding = space.encoding
    silent = encoding.reflectance and images.shape[1] == 1
    guesses = np.stack([interpolated(x, m) for x, m in zip(images.cpu().numpy(), seen.cpu().numpy(), strict=True)])
    filled = torch.where(seen[:, None], images, torch.from_numpy(guesses).to(images))
    image = encoding.encode(torch.cat([filled, torch.zeros_like(filled)], 1) if silent else filled)
    known = seen[:, None].expand_as(image).to(image)
    if silent:
        known[:, -1] *= ~returned
    return {IMAGE: image * seen.flatten(1).any(1)[:, None, None, None], KNOWN: known}
