"""A network for large images: an inner network for downsampled images, and convolutions at full resolution."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Unpack

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone, CommonOptions, integers, precondition
from r2flow.backbones.convolutions import RingConv2d
from r2flow.backbones.detail import Detail, DetailBlock
from r2flow.backbones.encodings import mean_rays
from r2flow.backbones.hdit import time_embedding
from r2flow.backbones.layers import ExactLinear, zero_initialised
from r2flow.errors import InputError, check
from r2flow.registry import Bound, Positive

ANY_SIZE = 2, 256, 1024  # shape of rays, to build a network and read its unit


class Pyramid(Backbone):
    """An inner network for the image's block means, and a convolutional path for the residual.

    P takes means of n = p x q pixels, U repeats them. Means of x_t = t x_1 + (1 - t) x_0 have less noise than its
    pixels: with w = t sqrt(n) + 1 - t,

        y = sqrt(n) / w P x_t = t' P x_1 + (1 - t') e,    t' = t sqrt(n) / w,    e ~ N(0, 1),

    is a state of a flow of small images, at a later time. The inner network gives its velocity v'(t', y), and thereby
    the velocity of the means, P v = (sqrt(n) - 1) / sqrt(n) y + v' / w. For the residual h = x_t - U P x_t, the best
    linear estimate of the velocity is skip(t) h (`precondition`), and a convolutional path F corrects it:

        v(t, x_t) = U P v + skip(t) h + out(t) F(t, h, y, y + (1 - t') v')

    F is initially zero: the means of the samples are then samples of the inner network, and the residual is noise.
    With a second time, the inner network gives the mean velocity u'(y, t', s'), with s' from s as t' from t. The same
    formula holds: P x_s = w_s / sqrt(n) y_s and s' - t' = sqrt(n) (s - t) / (w_s w), so that
    P u = (P x_s - P x_t) / (s - t) = (sqrt(n) - 1) / sqrt(n) y + u' / w.

    Args:
        inner: Name and options of the inner network.
        factor: Rows p and columns q of a block mean.
        coarse: Blocks and channels of the path at the resolution of the means.
        detail: Blocks and channels of the path at full resolution.
        time_channels: Width of the path's time embedding.
        below_std: Standard deviation of x_1 - U P x_1 in model space, times sqrt(n / (n - 1)), as the mean of n values
            takes a degree of freedom.
        ring: Whether the columns are a full turn.
    """

    takes_second_time = True

    def __init__(
        self,
        rays: Tensor,
        inner: Mapping[str, Any],
        factor: Sequence[int] = (2, 4),
        coarse: Sequence[int] = (3, 64),
        detail: Sequence[int] = (2, 16),
        time_channels: Annotated[int, Bound("of at least 2", lambda n: n >= 2)] = 64,
        below_std: Positive = 0.23,
        ring: bool = True,
        **common: Unpack[CommonOptions],
    ) -> None:
        from r2flow.backbones import build_backbone

        if common.get("data_std") is not None:
            raise InputError("a pyramid has below_std, and its inner network data_std: leave backbone.data_std out.")
        rows, columns = integers("factor", factor, 2)
        check(rows * columns > 1, "backbone.factor must be of more than one pixel, such as [2, 4]; found [1, 1].")
        channels = common.get("in_channels", 2)
        out_channels = common.get("out_channels") or channels
        whole = rays.shape[-2] % rows == 0 and rays.shape[-1] % columns == 0
        coarse_rays = mean_rays(rays[None], (rows, columns))[0] if whole else rays.new_zeros(ANY_SIZE)
        try:
            small = build_backbone(inner, coarse_rays, channels, out_channels)
        except InputError as error:
            try:
                small = build_backbone(inner, rays.new_zeros(ANY_SIZE), channels, out_channels)
            except InputError:  # the size is not the cause
                raise error from None
        super().__init__(rays, (rows * small.unit[0], columns * small.unit[1]), **common)
        self.factor, self.below_std, self.inner = (rows, columns), below_std, small
        blocks, width = integers("coarse", coarse, 2)
        self.timestep_pe = time_embedding(time_channels, dropout=0.0)
        self.entrance = RingConv2d(channels + self.out_channels, width, ring)
        self.coarse = nn.ModuleList([DetailBlock(width, time_channels, ring) for _ in range(blocks)])
        ends = channels + self.out_channels, self.out_channels
        count, wide = integers("detail", detail, 2)
        self.detail = Detail(count, wide, ends, width, self.factor, time_channels, ring)
        if self.second_time:  # last, so that a seed gives the same other weights with one time
            last = zero_initialised(ExactLinear(time_channels, time_channels, bias=False))
            self.interval_embedding = time_embedding(time_channels, dropout=0.0).append(last)
            self.inner = build_backbone(inner, coarse_rays, channels, out_channels, second_time=True)
            self.inner.load_state_dict({**self.inner.state_dict(), **small.state_dict()})

    # Not `velocity`, which gets x in the dtype of the weights: means and residual need the exact x.
    def _evaluated(self, t: Tensor, x: Tensor, s: Tensor | None) -> Tensor:
        image, rest = x[:, : self.out_channels], x[:, self.out_channels :]
        means = self._means(x)
        below = image - self._spread(means[:, : self.out_channels])
        root = (self.factor[0] * self.factor[1]) ** 0.5
        w = t * root + 1 - t
        later, wide = t * root / w, w[:, None, None, None]
        inner_s = () if s is None else (s * root / (s * root + 1 - s),)
        y = torch.cat([root / wide * means[:, : self.out_channels], means[:, self.out_channels :]], dim=1)
        state = y[:, : self.out_channels]
        velocity = self.inner(later, y, *inner_s)
        estimate = state + (1 - later)[:, None, None, None] * velocity
        into, skip, out = precondition(t, self.below_std)
        # In the order of the means: image, condition, estimate.
        pixels = torch.cat([into * below, rest, self._spread(estimate)], dim=1)
        path = self._path(t, s, pixels, torch.cat([y, estimate], dim=1)).to(x.dtype)
        return self._spread((root - 1) / root * state + velocity / wide) + skip * below + out * path

    def _path(self, t: Tensor, s: Tensor | None, pixels: Tensor, means: Tensor) -> Tensor:
        dtype = self.entrance.weight.dtype
        condition = self.condition(self.timestep_pe, t, s)
        h = self.entrance(means.to(dtype))
        for block in self.coarse:
            h = block(h, condition)
        return self.detail(pixels.to(dtype), h.permute(0, 2, 3, 1), condition)

    def _means(self, x: Tensor) -> Tensor:
        return x.unflatten(3, (-1, self.factor[1])).unflatten(2, (-1, self.factor[0])).mean((3, 5))

    def _spread(self, x: Tensor) -> Tensor:
        return F.interpolate(x, scale_factor=self.factor, mode="nearest")

    def second_time_names(self) -> frozenset[str]:
        return super().second_time_names() | {f"inner.{name}" for name in self.inner.second_time_names()}

    @property
    def learns_directions(self) -> bool:  # type: ignore[override]
        return self.inner.learns_directions
