"""A network for large images: one for small images inside, convolutions at full resolution around it."""

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
from r2flow.errors import InputError
from r2flow.registry import Bound, Positive

ANY_SIZE = 2, 256, 1024  # of rays: a network is built for it to learn what its sizes are multiples of


class Pyramid(Backbone):
    """A field by a network for the image's means, and a path for what lies below them.

    P takes the mean of n = p x q pixels, U repeats it. Means of x_t = t x_1 + (1 - t) x_0 have less noise than its
    pixels: with w = t sqrt(n) + 1 - t,

        y = sqrt(n) / w P x_t = t' P x_1 + (1 - t') e,    t' = t sqrt(n) / w,    e ~ N(0, 1),

    is a state of a flow of small images, at a later time. The inner network gives its velocity v'(t', y), and with it
    that of the means, P v = (sqrt(n) - 1) / sqrt(n) y + v' / w. Of what is left, h = x_t - U P x_t, the best linear
    estimate is skip(t) h (`precondition`), and F is what a path of convolutions finds beyond it:

        v(t, x_t) = U P v + skip(t) h + out(t) F(t, h, y, y + (1 - t') v')

    F starts at zero. So the means of what the network draws are at once the images of the inner one; below them is
    noise. With a second time the inner network gives the mean velocity u'(y, t', s'), s' of s as t' of t. The formula
    stays: P x_s = w_s / sqrt(n) y_s and s' - t' = sqrt(n) (s - t) / (w_s w), so that
    P u = (P x_s - P x_t) / (s - t) = (sqrt(n) - 1) / sqrt(n) y + u' / w.

    Args:
        inner: Name and options of the inner network.
        factor: Rows p and columns q of a mean.
        coarse: Blocks and channels of the path among the means.
        detail: Blocks and channels of the path among the pixels.
        time_channels: Width of the path's time embedding.
        below_std: Standard deviation of x_1 - U P x_1 in model space, times sqrt(n / (n - 1)), for a mean of n values
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
        if rows * columns == 1:
            raise InputError("backbone.factor must be of more than one pixel, such as [2, 4]; found [1, 1].")
        channels = common.get("in_channels", 2)
        answered = common.get("out_channels") or channels
        whole = rays.shape[-2] % rows == 0 and rays.shape[-1] % columns == 0
        seen = mean_rays(rays[None], (rows, columns))[0] if whole else rays.new_zeros(ANY_SIZE)
        try:
            small = build_backbone(inner, seen, channels, answered)
        except InputError as error:
            try:
                small = build_backbone(inner, rays.new_zeros(ANY_SIZE), channels, answered)
            except InputError:  # the size is not at fault
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
        if self.second_time:  # after all else, so that a seed gives the weights of one time with it and without
            last = zero_initialised(ExactLinear(time_channels, time_channels, bias=False))
            self.interval_embedding = time_embedding(time_channels, dropout=0.0).append(last)
            self.inner = build_backbone(inner, seen, channels, answered, second_time=True)
            self.inner.load_state_dict({**self.inner.state_dict(), **small.state_dict()})

    # Not `velocity`: that is given x in the type of the weights, and means and rest are taken of the exact x.
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
        pixels = torch.cat([into * below, rest, self._spread(estimate)], dim=1)  # as the means: image, condition, more
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
    def learns_directions(self) -> bool:
        return self.inner.learns_directions
