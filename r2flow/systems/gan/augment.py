"""Adaptive discriminator augmentation (ADA) on a ring.

Karras et al. 2020, "Training generative adversarial networks with limited data", section 3 and
appendix B. Each transformation is applied with probability p to the discriminator's inputs, real
and generated. p adapts to the discriminator's scores of real images.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32
from r2flow.base.noise import generator
from r2flow.base.processes import sum_over_processes
from r2flow.base.registry import Natural, NonNegative, Portion

# Low-pass filter of the wavelet sym6 (Daubechies 1992), for up- and downsampling.
_SYM6 = (
    0.015404109327027373, 0.0034907120842174702, -0.11799011114819057, -0.048311742585633,
    0.4910559419267466, 0.787641141030194, 0.3379294217276218, -0.07263752278646252,
    -0.021060292512300564, 0.04472490177066578, 0.0017677118642428036, -0.007800708325034148,
)  # fmt: skip
_MARGIN = len(_SYM6) // 4  # pixels beyond each edge that the filter needs


class BatchDraws:
    """Random numbers per image for one part of a step: a function of (seed, image number, part)."""

    def __init__(self, seed: int, batch: Mapping[str, Tensor], part: int) -> None:
        self.streams = [generator(seed, "training", k, part) for k in batch["k"].tolist()]

    def uniform(self, *shape: int) -> Tensor:
        """Uniform in [0, 1), (B, *shape), on the CPU."""
        return torch.tensor(np.stack([rng.random(shape, "float32") for rng in self.streams]))

    def normal(self, *shape: int) -> Tensor:
        """Standard normal, (B, *shape), on the CPU."""
        draws = [rng.standard_normal(shape, "float32") for rng in self.streams]
        return torch.tensor(np.stack(draws))


_Magnitudes = Mapping[str, Tensor]
"""Of each transformation, (B,), or (2, B) for rows and columns; its identity if it is left out."""


class _Transformation(NamedTuple):
    """How magnitudes are drawn for a batch, and that of the identity."""

    draw: Callable[[BatchDraws], Tensor]
    identity: float = 0.0


_FLIP = _Transformation(lambda source: (source.uniform() < 0.5).float())

# In the order of drawing and application; shifts are relative to the size. The published hue and
# saturation do not affect images of one or two channels.
TRANSFORMATIONS = {
    "lr_flip": _FLIP,
    "ud_flip": _FLIP,
    "int_trans": _Transformation(lambda source: (source.uniform(2).mT - 0.5) / 4),
    "iso_scale": _Transformation(lambda source: torch.exp2(0.2 * source.normal()), 1.0),
    "frac_trans": _Transformation(lambda source: 0.125 * source.normal(2).mT),
    "brightness": _Transformation(lambda source: 0.2 * source.normal()),
    "contrast": _Transformation(lambda source: torch.exp2(0.5 * source.normal()), 1.0),
    "luma_flip": _FLIP,
}


class AdaptiveAugment(nn.Module):
    """Random transformations with an adaptive probability p.

    Every `every` steps p changes by (images since) / (1000 kimg), up if the mean sign of D's scores
    of real images is above `target`, else down, within [0, highest].

    Args:
        target: Target mean sign of scores of real images; None: constant p.
        kimg: Thousands of images in which p can rise from 0 to 1.
        initial: Initial p.
        highest: Maximum p.
        every: Steps between updates of p.
    """

    def __init__(
        self,
        target: Portion | None = 0.6,
        kimg: NonNegative = 500,
        initial: Portion = 0.0,
        highest: Portion = 0.9,
        every: Natural = 4,
    ) -> None:
        super().__init__()
        self.target = target
        self.images = 1000 * kimg
        self.highest = highest
        self.every = every
        # Named as in published checkpoints.
        self.p = nn.Buffer(torch.tensor(float(initial)))
        self.sign_cum = nn.Buffer(torch.zeros(1))
        self.n_pred_cum = nn.Buffer(torch.zeros(1))

    def count(self, real: Tensor) -> None:
        """Accumulate D's scores of real images over all processes."""
        self.sign_cum.add_(sum_over_processes(real.detach().float().sign().sum()))
        self.n_pred_cum.add_(sum_over_processes(torch.tensor(float(len(real)), device=real.device)))

    def move(self) -> Tensor:
        """Update p by the accumulated scores, reset them, and return their mean sign r_t."""
        sign = self.sign_cum / self.n_pred_cum
        if self.target is not None and self.images:
            step = torch.sign(sign - self.target) * self.n_pred_cum / self.images
            self.p.copy_((self.p + step[0]).clamp(0, self.highest))
        self.sign_cum.zero_()
        self.n_pred_cum.zero_()
        return sign

    def draw(self, source: BatchDraws) -> _Magnitudes:
        """Draw a batch's transformations; the number of draws does not depend on p."""
        p = float(self.p)
        magnitudes = {}
        for name, transformation in TRANSFORMATIONS.items():
            value = transformation.draw(source)
            magnitudes[name] = torch.where(source.uniform() < p, value, transformation.identity)
        return magnitudes

    def forward(self, x: Tensor, by: _Magnitudes) -> Tensor:
        """Transform x (B, C, H, W) in at least float32; twice differentiable."""
        with torch.autocast(x.device.type, enabled=False):
            maps = (part.to(x.device) for part in affine(by, *x.shape[2:]))
            return _coloured(transformed(at_least_float32(x), *maps), by)


def affine(by: _Magnitudes, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Scale and shift of pixels about the image centre, (2, B) each, rows before columns.

    Only rows are scaled, since a scale of columns would open the ring.
    """
    rows = by["iso_scale"]
    zoom = torch.stack([rows, torch.ones_like(rows)])
    flips = torch.stack([by["ud_flip"], by["lr_flip"]])
    size = torch.tensor([[height], [width]], device=rows.device)
    shift = zoom * (by["int_trans"] * size).round() + by["frac_trans"] * size
    return zoom * (1 - 2 * flips), shift


def transformed(x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Scale and shift x (B, C, H, W) by the result of `affine`.

    x is circular in azimuth and reflected at the edge rows. Each axis is upsampled by the filter
    `_SYM6`, interpolated linearly, and downsampled by the filter: one matrix per axis and image.
    """
    inverse = 1 / scale.double()
    offset = -shift * inverse
    rows = _resampling(x.shape[2], inverse[0], offset[0], "reflect").to(x)
    return rows @ x @ _resampling(x.shape[3], inverse[1], offset[1], "circular").to(x).mT


@torch.no_grad()
def _resampling(size: int, scale: Tensor, shift: Tensor, edge: str) -> Tensor:
    """Matrix that resamples a line of `size` pixels at scale n + shift, n from its centre.

    Scale and shift are (B,), float64; `edge` pads "circular" or "reflect"; (B, 1, size, size).
    """
    device = scale.device
    taps = torch.tensor(_SYM6, device=device)
    lines = F.pad(torch.eye(size, device=device)[:, None], (size - 1, size - 1), mode=edge)
    padding = len(_SYM6) // 2 - 1
    doubled = F.conv_transpose1d(lines, taps[None, None], stride=2, padding=padding)[:, 0].T
    outputs = 2 * (size + 2 * _MARGIN)
    pixel = (torch.arange(outputs, device=device, dtype=torch.float64) + 1 - outputs / 2) / 2
    place = 2 * (scale[:, None] * pixel + shift[:, None]) - 1 + len(doubled) / 2
    first = place.floor().long()
    share = (place - first).float()[..., None]
    values = _row(doubled, first) * (1 - share) + _row(doubled, first + 1) * share
    halved = torch.zeros((), device=device)
    for m, tap in enumerate(_SYM6, start=1):
        halved = halved + tap * values[:, m : m + 2 * size : 2]
    return halved[:, None]


def _row(lines: Tensor, index: Tensor) -> Tensor:
    """Rows of `lines`; 0 beyond the ends."""
    nearest = index.clamp(0, len(lines) - 1)
    return lines[nearest] * (index == nearest)[..., None].to(lines)


def _coloured(x: Tensor, by: _Magnitudes) -> Tensor:
    """Change the values of one channel; two are left alone, as in the published code."""
    if x.shape[1] != 1:
        return x
    values = torch.stack([by["brightness"], by["contrast"], by["luma_flip"]])
    brightness, contrast, flip = values.to(x)[..., None, None, None]
    return (x + brightness) * contrast * (1 - 2 * flip)
