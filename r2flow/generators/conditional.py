"""Generators that are told a part of the scan: rays that are known, and rays that were measured but are not trusted."""

from collections.abc import Mapping
from copy import deepcopy
from itertools import pairwise
from typing import Any, ClassVar, Self, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones import Backbone
from r2flow.backbones.convolutions import RingConv2d, zero_convolution
from r2flow.errors import InputError
from r2flow.flow.path import expand_time
from r2flow.generators.base import (
    DOUBTFUL,
    IMAGE,
    KNOWN,
    LOGIT,
    SIGMA,
    Condition,
    Generated,
    Generator,
    Progress,
    Sampler,
    parts_of,
)
from r2flow.generators.flow import RectifiedFlow
from r2flow.generators.flow_map import FlowMap
from r2flow.lidar.interpolation import guess
from r2flow.lidar.known import Ray
from r2flow.lidar.region import Region
from r2flow.lidar.space import ModelSpace
from r2flow.noise import Draws

LAST = 1e-5  # of the time: where a known ray's velocity stops to grow


def condition_of(space: ModelSpace, images: Tensor, state: Tensor) -> Condition:
    """What is known of scans, as generators take it: `image`, `known` and `doubtful`, each (B, C, H, W) in model space.

    `known` is 1 where a value was measured and `doubtful` where it was measured but is not trusted; where neither
    holds, `image` has a guess (`r2flow.lidar.interpolation.guess`), and 0 where nothing at all was measured.

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
    odd = state[~torch.isin(state, torch.tensor(list(map(int, Ray)), device=state.device))]
    if len(odd):
        raise InputError(f"the state of a ray must be one of r2flow.lidar.known.Ray, found {odd[0].item():g}.")
    returned, wrong = images[:, 0] > 0, (images[:, 0] > 0) & (state == Ray.EMPTY)
    if bool(wrong.any()) or bool((~returned & (state == Ray.RETURN)).any()):
        raise InputError("a ray with a return must have a range above 0, an empty one the range 0.")
    encoding = space.encoding
    silent = encoding.reflectance and images.shape[1] == 1
    seen = state != Ray.UNKNOWN
    guesses = np.stack([guess(x, m) for x, m in zip(images.cpu().numpy(), seen.cpu().numpy(), strict=True)])
    filled = torch.where(seen[:, None], images, torch.from_numpy(guesses).to(images))
    image = encoding.encode(torch.cat([filled, torch.zeros_like(filled)], 1) if silent else filled)
    image = image * seen.flatten(1).any(1)[:, None, None, None]
    said = torch.ones_like(image)
    if silent:
        said[:, -1] = (~returned).to(said)
    measured, trusted = seen[:, None] * said, (state != Ray.DOUBTFUL)[:, None]
    return {IMAGE: image, KNOWN: measured * trusted, DOUBTFUL: measured * ~trusted}


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
        sizes = [3 * channels, width, width, width]
        self.layers = nn.ModuleList([RingConv2d(before, after, ring=True) for before, after in pairwise(sizes)])
        self.answer = zero_convolution(RingConv2d(width, 2 * channels, ring=True))

    def forward(self, told: Tensor) -> tuple[Tensor, Tensor]:
        """`image`, `known` and `doubtful`, (B, 3 C, H, W), to logit p and sigma, (B, C, H, W) each."""
        h = told
        for layer in self.layers:
            h = F.silu(layer(h))
        logit, spread = self.answer(h).float().chunk(2, dim=1)
        return logit, (spread - 4).exp() + self.FINEST


class ConditionalFlow(RectifiedFlow):
    """v(t, x | y) of a network that also sees what is known, y: one model for any mask, none and all included.

    A known value has the exact velocity of its straight line, (y - x) / (1 - t), and arrives as it was given. Elsewhere
    x_1 is held to be, with probability p, near the guess g of the condition, N(g, sigma^2), and else what the network
    says: by Bayes' rule for x_t, whose variance is V_s = (t s)^2 + (1 - t)^2 about t g or 0,

        v = r [g + skip(t, sigma) (x - t g)] + (1 - r) network(t, x, y),
        logit r = logit p + log N(x; t g, V_sigma) - log N(x; 0, V_b),    b = 0.5,

    `skip` that of `r2flow.backbones.base.precondition`; p and sigma by `Trust`. So where interpolation holds, the model
    need not learn it again, and where it does not, x_t soon tells. The condition is that of `condition_of`; None draws
    a scan of which nothing is known, by the network alone.
    """

    told = True
    trusts: ClassVar[bool] = True

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        self.condition_channels = 3 * space.shape[0]
        super().__init__(space, backbone)
        if self.trusts:
            self.trust = Trust(space.shape[0])

    def velocity(self, t: Tensor, x: Tensor, condition: Condition | None = None) -> Tensor:
        parts = parts_of(condition, x)
        v: Tensor = self.backbone(t, torch.cat([x, *parts], dim=1))
        return v if condition is None else self._informed(v, t, x, t, condition)

    def _informed(self, u: Tensor, t: Tensor, x: Tensor, s: Tensor, condition: Condition) -> Tensor:
        """The mean velocity from t to s by what is known: u where that tells nothing. At s = t it is the velocity."""
        image, known, doubtful = parts_of(condition, x)
        trusted = self._trusted(condition, x)
        logit, sigma = trusted[LOGIT], trusted[SIGMA]
        t, s = (expand_time(torch.as_tensor(time, device=x.device, dtype=torch.float32), x) for time in (t, s))
        left, off = 1 - t, x - t * image
        narrow, broad = ((t * std).square() + left.square() for std in (sigma, Trust.BROAD))
        near = logit - (narrow.log() - broad.log() + off.square() / narrow - x.square() / broad) / 2
        told = (known + doubtful).flatten(1).any(1)[:, None, None, None]
        there = ((s * sigma).square() + (1 - s).square()).sqrt()
        about = image + off * ((s + t) * sigma.square() - (1 - s) - left) / (narrow.sqrt() * (there + narrow.sqrt()))
        mixed = u + near.sigmoid() * told * (about - u)
        return torch.where(known > 0, (image - x) / left.clamp(min=LAST), mixed).to(u)

    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        if condition is None:
            return super().generate(noise, sampler=sampler, draws=draws, progress=progress)
        with torch.no_grad():
            condition = self._trusted(condition, noise.to(next(self.parameters())))
        made = super().generate(noise, condition, sampler=sampler, draws=draws, progress=progress)
        image, known, _ = parts_of(condition, made.x)
        return Generated(torch.where(known > 0, image, made.x), made.evaluations, made.converged)

    def _trusted(self, condition: Condition, like: Tensor) -> Condition:
        """The condition with what `Trust` says of it, which no step changes and which is found once therefore."""
        if LOGIT in condition or not self.trusts:
            return condition
        logit, sigma = self.trust(torch.cat(parts_of(condition, like), dim=1))
        return {**condition, LOGIT: logit, SIGMA: sigma}

    def part(self, region: Region) -> Self:
        part = super().part(region)
        if self.trusts and part is not self:
            part.trust = deepcopy(self.trust, {id(weight): weight for weight in self.trust.parameters()})
            for layer in part.trust.modules():
                if isinstance(layer, RingConv2d) and region.width < region.shape[1]:
                    layer.open_ring()
        return part

    def untold(self) -> RectifiedFlow:
        kind = FlowMap if self.second_time else RectifiedFlow
        flow = kind.__new__(kind)
        nn.Module.__init__(flow)
        flow.space, flow.noise_shape, flow.sampler = self.space, self.noise_shape, self.sampler
        flow.backbone = cast(Backbone, _Untold(self.backbone, self.condition_channels))
        return flow.train(self.training)


class ConditionalMap(ConditionalFlow, FlowMap):
    """u(x, t, s | y): the flow map of a `ConditionalFlow`, so that a scan is completed by a few jumps.

    A known value is on its straight line, whose mean velocity is its velocity. About the guess the flow map of
    N(g, sigma^2) is exact, X_{t->s}(x) = s g + (V_sigma(s) / V_sigma(t))^(1/2) (x - t g), and is blended with the
    network's jump by the same r, of time t: at t = 0 it is p, and where the guess is wrong the network makes up for it.
    """

    def mean_velocity(self, t: Tensor, x: Tensor, s: Tensor, condition: Condition | None = None) -> Tensor:
        parts = parts_of(condition, x)
        u: Tensor = self.backbone(t, torch.cat([x, *parts], dim=1), s)
        return u if condition is None else self._informed(u, t, x, s, condition)


class _Untold(nn.Module):
    """v(t, x) or u(x, t, s) of a network with further input channels, of which nothing is known."""

    def __init__(self, backbone: Backbone, channels: int) -> None:
        super().__init__()
        self.backbone, self.channels, self.second_time = backbone, channels, backbone.second_time
        self.in_channels, self.coords, self.unit = backbone.in_channels - channels, backbone.coords, backbone.unit

    def forward(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        unknown = x.new_zeros(x.shape[0], self.channels, x.shape[2], x.shape[3])
        v: Tensor = self.backbone(t, torch.cat([x, unknown], dim=1), s)
        return v


class Regression(ConditionalFlow):
    """x_1 by one evaluation from what is known alone, whatever the noise: the opponent on mean errors.

    Learned by absolute error it is the median of each value; it draws nothing.
    """

    trusts = False
    has_paths = False

    def __init__(self, space: ModelSpace, backbone: Mapping[str, Any]) -> None:
        super().__init__(space, backbone)
        self.sampler = Sampler("direct", 1, fixed=True)

    def estimate(self, condition: Condition | None, like: Tensor) -> Tensor:
        """x_1, (B, C, H, W), of the shape and type of `like`."""
        image, known, doubtful = parts_of(condition, like)
        t = torch.ones(len(like), device=like.device)
        told = (known + doubtful).flatten(1).any(1)[:, None, None, None]
        begun = torch.where(told, image, -1.0)  # tokens of zeros have no finite gradient in a norm
        found: Tensor = self.backbone(t, torch.cat([begun, image, known, doubtful], dim=1))
        return torch.where(known > 0, image, found)

    @torch.no_grad()
    def generate(
        self,
        noise: Tensor,
        condition: Condition | None = None,
        *,
        sampler: Sampler | None = None,
        draws: Draws | None = None,
        progress: Progress = None,
    ) -> Generated:
        found = self.estimate(condition, noise.to(self.device))
        if progress is not None:
            progress()
        return Generated.after(found, 1)

    def check_sampler(self, sampler: Sampler) -> None:
        Generator.check_sampler(self, sampler)

    def evaluations_of(self, sampler: Sampler) -> int:
        return 1

    def in_steps(self, steps: int) -> Sampler:
        return self.sampler
