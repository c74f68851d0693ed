"""What all velocity estimators share: images of one shape, seen along rays that they keep."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from r2flow.backbones.layers import ExactBuffers, at_least_float32
from r2flow.errors import InputError


class Backbone(ExactBuffers):
    """A field v(t, x) on images (B, C, H, W).

    A subclass calls `follow_rays` when it is built, and again whenever `coords` is loaded: what it derives from
    the rays there goes into buffers of fixed size outside the state_dict, always in float32.

    `model.compile(dynamic=True)` makes it one graph without breaks: one for batches of two and more and one for a
    single image, for each of gradients on or off and autocast on or off; then no further one.

    Args:
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        in_channels: Channels C of the image.
        patch: Rows and columns of what the backbone takes for one unit at full resolution.
        levels: Resolutions it works at, each half the one before.

    Raises:
        InputError: rays of another shape, or H or W not a multiple of patch x 2^(levels - 1).
    """

    coords: Tensor

    def __init__(self, rays: Tensor, in_channels: int, patch: tuple[int, int], levels: int) -> None:
        super().__init__()
        self._check_shape(rays, patch, levels)
        self.in_channels = in_channels
        # on the device that parameters are made on, which `with torch.device(...)` may have set
        device = torch.get_default_device() if rays.device.type == "cpu" else rays.device
        self.register_buffer("coords", rays[None].to(device, torch.float32, copy=True))
        self.register_load_state_dict_post_hook(_follow_loaded_rays)

    def forward(self, t: Tensor | float, x: Tensor) -> Tensor:
        """Velocity (B, C, H, W), in x's type, at times t, a scalar or (B,), of x (B, C, H, W)."""
        expected = self.in_channels, *self.coords.shape[2:]
        if x.shape[1:] != expected:
            raise InputError(f"this backbone was built for images of {expected}, found {tuple(x.shape[1:])}.")
        return self.velocity(_times(t, x), x.to(next(self.parameters()).dtype)).to(x.dtype)

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        """The field for t of shape (B,), or (1,) for the whole batch, in float32 or better."""
        raise NotImplementedError

    def follow_rays(self) -> None:
        """Compute again what derives from `coords`."""
        raise NotImplementedError

    def _check_shape(self, rays: Tensor, patch: tuple[int, int], levels: int) -> None:
        if rays.ndim != 3 or rays.shape[0] != 2:
            raise InputError(f"rays must be elevation and azimuth, (2, H, W); found {tuple(rays.shape)}.")
        shrink = 2 ** (levels - 1)
        for dimension, size, unit in zip(("height", "width"), rays.shape[1:], patch, strict=True):
            multiple = unit * shrink
            if size % multiple or size == 0:
                below = size // multiple * multiple
                nearest = ", ".join(str(n) for n in (below, below + multiple) if n > 0)
                raise InputError(
                    f"{dimension} {size} cannot be used by {type(self).__name__} with {levels} levels: it must be "
                    f"a multiple of {unit} (patch) x {shrink} (halved {levels - 1} times) = {multiple}; "
                    f"nearest: {nearest}."
                )


def _follow_loaded_rays(backbone: Backbone, _keys: Any) -> None:
    backbone.follow_rays()


def _times(t: Tensor | float, x: Tensor) -> Tensor:
    t = torch.as_tensor(t, device=x.device)
    if t.ndim > 1 or t.numel() not in (1, len(x)):
        raise ValueError(f"t must be a scalar or of shape ({len(x)},), found {tuple(t.shape)}.")
    return at_least_float32(t).reshape(-1)


def integers(name: str, values: int | Sequence[int], count: int) -> tuple[int, ...]:
    """As many integers as asked for, from such a list or from one for all.

    Raises:
        InputError: another number of values, or one below 1.
    """
    found = (int(values),) * count if isinstance(values, int) else tuple(int(value) for value in values)
    if len(found) != count or min(found) < 1:
        raise InputError(f"{name} must be {count} integers of at least 1, found {list(found)}.")
    return found
