"""A flow conditioned on the rays that are known."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from typing import Any, Self, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones import Backbone
from r2flow.backbones.base import open_rings
from r2flow.backbones.convolutions import RingConv2d, zero_convolution
from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.generators.base import (
    IMAGE,
    KNOWN,
    LOGIT,
    SIGMA,
    Condition,
    Generated,
    parts_of,
)
from r2flow.generators.flow import RectifiedFlow
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Ray
from r2flow.lidar.region import Region
from r2flow.lidar.space import ModelSpace

LAST = 1e-5  # of the time: where a known ray's velocity stops to grow


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


class Trust(nn.Module):
    """How far the guess of a condition holds, value by value: 3 x 3 convolutions on the condition.

    Args:
        channels: C of the image.
        width: Of the hidden layers.
    """

    FINEST = 1e-3  # of sigma in model space, 0.2 % of a range on the paper's logarithmic scale
    BROAD = 0.5  # standard deviation in model space of what is no guess

    def __init__(self, channels: int, width: int = 24) -> None:
        super().__init__()
        sizes = [2 * channels, width, width, width]
        self.layers = nn.ModuleList([RingConv2d(before, after, ring=True) for before, after in pairwise(sizes)])
        self.answer = zero_convolution(RingConv2d(width, 2 * channels, ring=True))

    def forward(self, told: Tensor) -> tuple[Tensor, Tensor]:
        """`image` and `known`, (B, 2 C, H, W), to logit p and sigma, (B, C, H, W) each."""
        h = told
        for layer in self.layers:
            h = F.silu(layer(h))
        logit, spread = self.answer(h).float().chunk(2, dim=1)
        return logit, (spread - 4).exp() + self.FINEST


class ConditionalFlow(RectifiedFlow):
    """v(t, x | y) of a network that also sees what is known, y: one model for any mask, none and all included.

    A known value has the exact velocity of its straight line, (y - x) / (1 - t), and arrives as it was given. Elsewhere
    x_1 is, with probability p, near the guess g of the condition, N(g, sigma^2), and else what the network says: by
    Bayes' rule for x_t, whose variance is V_s = (t s)^2 + (1 - t)^2 about t g or 0,

        v = r [g + (x - t g) (t sigma^2 - (1 - t)) / V_sigma] + (1 - r) network(t, x, y),
        logit r = logit p + log N(x; t g, V_sigma) - log N(x; 0, V_b),    b = 0.5,

    with p and sigma by `Trust`. The condition is that of `condition_of`; None draws a scan by the network alone.
    """

    told = True

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        self.condition_channels = 2 * space.shape[0]
        super().__init__(space, backbone)
        self.trust = Trust(space.shape[0])

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        image, known = parts_of(condition, x)
        v: Tensor = self.backbone(t, torch.cat([x, image, known], dim=1))
        if condition is None:
            return v
        condition = self._trusted(condition, x)
        logit, sigma = condition[LOGIT], condition[SIGMA]
        t = expand_time(torch.as_tensor(t, device=x.device, dtype=torch.float32), x)
        left, off = 1 - t, x - t * image
        narrow, broad = ((t * std).square() + left.square() for std in (sigma, Trust.BROAD))
        near = logit - (narrow.log() - broad.log() + off.square() / narrow - x.square() / broad) / 2
        about = image + off * (t * sigma.square() - left) / narrow
        given = known.flatten(1).any(1)[:, None, None, None]
        mixed = v + near.sigmoid() * given * (about - v)
        return torch.where(known > 0, (image - x) / left.clamp(min=LAST), mixed).to(v)

    def forward(self, noise: Tensor, condition: Condition | None = None, **how: Any) -> Generated:
        if condition is None:
            return super().forward(noise, **how)
        weight = next(self.parameters())
        with torch.no_grad():
            condition = self._trusted({name: value.to(weight) for name, value in condition.items()}, noise.to(weight))
        made = super().forward(noise, condition, **how)
        image, known = parts_of(condition, made.x)
        return replace(made, x=torch.where(known > 0, image, made.x))

    def _trusted(self, condition: Condition, like: Tensor) -> Condition:
        """The condition with the answer of `Trust`, which does not change from step to step."""
        if LOGIT in condition:
            return condition
        logit, sigma = self.trust(torch.cat(parts_of(condition, like), dim=1))
        return {**condition, LOGIT: logit, SIGMA: sigma}

    def part(self, region: Region) -> Self:
        part = super().part(region)
        if part is not self:
            part.trust = deepcopy(self.trust, {id(weight): weight for weight in self.trust.parameters()})
            if region.width < region.shape[1]:
                open_rings(part.trust)
        return part

    def untold(self) -> RectifiedFlow:
        flow = RectifiedFlow.__new__(RectifiedFlow)
        nn.Module.__init__(flow)
        flow.space, flow.noise_shape = self.space, self.noise_shape
        flow.run_by(self.sampler, self.few, self.fixed)
        flow.backbone = cast(Backbone, _Untold(self.backbone, self.condition_channels))
        return flow.train(self.training)


class _Untold(nn.Module):
    """v(t, x) of a network with further input channels, which are 0."""

    second_time = False

    def __init__(self, backbone: Backbone, channels: int) -> None:
        super().__init__()
        self.backbone, self.channels = backbone, channels
        self.in_channels, self.coords, self.unit = backbone.in_channels - channels, backbone.coords, backbone.unit

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        unknown = x.new_zeros(x.shape[0], self.channels, x.shape[2], x.shape[3])
        v: Tensor = self.backbone(t, torch.cat([x, unknown], dim=1))
        return v
