"""Adaptive discriminator augmentation (ADA) on a ring (Karras et al. 2020, "Training generative adversarial networks
with limited data", section 3 and appendix B).

Each transformation is applied with probability p to the discriminator's inputs, real and generated. p adapts to the
discriminator's scores of real images.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32
from r2flow.noise import generator
from r2flow.processes import summed
from r2flow.registry import Natural, NonNegative, Portion, Registry

# Low-pass filter of the wavelet sym6 (Daubechies 1992), for up- and downsampling.
SYM6 = (
    0.015404109327027373, 0.0034907120842174702, -0.11799011114819057, -0.048311742585633, 0.4910559419267466,
    0.787641141030194, 0.3379294217276218, -0.07263752278646252, -0.021060292512300564, 0.04472490177066578,
    0.0017677118642428036, -0.007800708325034148,
)  # fmt: skip
MARGIN = len(SYM6) // 4  # pixels beyond each edge that the filter needs


class BatchDraws:
    """Random numbers per image for one part of a step, on the CPU: a function of (seed, image number, part)."""

    def __init__(self, seed: int, batch: Mapping[str, Tensor], part: int) -> None:
        self.streams = [generator(seed, "training", k, part) for k in batch["k"].tolist()]

    def uniform(self, shape: tuple[int, ...]) -> Tensor:
        """Uniform in [0, 1), (B, *shape)."""
        return torch.stack([torch.from_numpy(rng.random(shape, dtype="float32")) for rng in self.streams])

    def normal(self, shape: tuple[int, ...]) -> Tensor:
        """Standard normal, (B, *shape)."""
        return torch.stack([torch.from_numpy(rng.standard_normal(shape, dtype="float32")) for rng in self.streams])


Draw = tuple[Tensor, Tensor]
"""A transformation of a batch: its magnitude, (B,) or (2, B) for rows and columns, and whether it applies, (B,) 0/1."""


def _flip(source: BatchDraws) -> Tensor:
    return (source.uniform((1,))[:, 0] < 0.5).float()


# Magnitudes for a batch, in the order of drawing and application.
GEOMETRY: dict[str, Callable[[BatchDraws], Tensor]] = {
    "lr_flip": _flip,
    "ud_flip": _flip,
    "int_trans": lambda source: (source.uniform((2,)).mT - 0.5) / 4,  # relative to height and width
    "iso_scale": lambda source: torch.exp2(0.2 * source.normal((1,))[:, 0]),
    "frac_trans": lambda source: 0.125 * source.normal((2,)).mT,
}
# The published hue and saturation do not affect images of one or two channels.
COLOUR: dict[str, Callable[[BatchDraws], Tensor]] = {
    "brightness": lambda source: 0.2 * source.normal((1,))[:, 0],
    "contrast": lambda source: torch.exp2(0.5 * source.normal((1,))[:, 0]),
    "luma_flip": _flip,
}
TRANSFORMATIONS = Registry("augmentation", **GEOMETRY, **COLOUR)


class AdaptiveAugment(nn.Module):
    """Random transformations with an adaptive probability p.

    Every `every` steps p changes by (images since) / (1000 kimg), up if the mean sign of D's scores of real images is
    above `target`, else down, within [0, highest].

    Args:
        target: Target mean sign of scores of real images; None: constant p.
        kimg: Thousands of images in which p can rise from 0 to 1.
        initial: Initial p.
        highest: Maximum p.
        every: Steps between updates of p.
        policy: Factor on p for each transformation in `TRANSFORMATIONS`; default 1; 0: disabled.
    """

    p: Tensor
    sign_cum: Tensor
    n_pred_cum: Tensor

    def __init__(
        self,
        target: Portion | None = 0.6,
        kimg: NonNegative = 500,
        initial: Portion = 0.0,
        highest: Portion = 0.9,
        every: Natural = 4,
        policy: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.target, self.images, self.highest, self.every = target, 1000 * kimg, highest, every
        for name in policy or {}:
            TRANSFORMATIONS[name]
        self.policy = {name: float((policy or {}).get(name, 1)) for name in TRANSFORMATIONS}
        # Named as in published checkpoints.
        self.register_buffer("p", torch.tensor(float(initial)))
        self.register_buffer("sign_cum", torch.zeros(1))
        self.register_buffer("n_pred_cum", torch.zeros(1))

    def count(self, real: Tensor) -> None:
        """Accumulate D's scores of real images over all processes."""
        self.sign_cum += summed(real.detach().float().sign().sum())
        self.n_pred_cum += summed(torch.tensor(float(len(real)), device=real.device))

    def move(self) -> Tensor:
        """Update p by the accumulated scores, reset them, and return their mean sign r_t."""
        sign = self.sign_cum / self.n_pred_cum
        if self.target is not None and self.images:
            step = torch.sign(sign - self.target) * self.n_pred_cum / self.images
            self.p.copy_((self.p + step[0]).clamp(0, self.highest))
        self.sign_cum.zero_()
        self.n_pred_cum.zero_()
        return sign

    def draw(self, source: BatchDraws) -> dict[str, Draw]:
        """Draw a batch's transformations by name, on the CPU; the number of draws does not depend on p."""
        draws, p = {}, float(self.p)
        for name, values in TRANSFORMATIONS.items():
            value, u = values(source), source.uniform((1,))[:, 0]
            draws[name] = value, (u < p * self.policy[name]).float()
        return draws

    def forward(self, x: Tensor, draws: Mapping[str, Draw]) -> Tensor:
        """Transform x (B, C, H, W) in at least float32; twice differentiable."""
        with torch.autocast(x.device.type, enabled=False):
            scale, shift = (part.to(x.device) for part in affine(draws, x.shape[-2], x.shape[-1]))
            return coloured(transformed(at_least_float32(x), scale, shift), draws)


def affine(draws: Mapping[str, Draw], height: int, width: int) -> tuple[Tensor, Tensor]:
    """Scale and shift of pixels about the image centre by all of `GEOMETRY`, (2, B) each, rows before columns.

    Only rows are scaled, since a scale of columns would open the ring.
    """
    one = torch.ones_like(draws["lr_flip"][1])
    scale, shift = torch.stack([one, one]), torch.stack([0 * one, 0 * one])
    size = torch.tensor([[height], [width]], device=one.device)
    for name in GEOMETRY:
        value, chosen = draws[name]
        factor, offset = torch.ones_like(scale), torch.zeros_like(shift)
        if name == "lr_flip":
            factor[1] = 1 - 2 * value
        elif name == "ud_flip":
            factor[0] = 1 - 2 * value
        elif name == "iso_scale":
            factor[0] = value
        else:
            offset = (value * size).round() if name == "int_trans" else value * size
        scale = torch.where(chosen > 0, factor * scale, scale)
        shift = torch.where(chosen > 0, factor * shift + offset, shift)
    return scale, shift


def transformed(x: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """Scale and shift x (B, C, H, W) by the result of `affine`: circular in azimuth, reflected at the edge rows.

    Each axis is upsampled by the filter `SYM6`, interpolated linearly, and downsampled by the filter: one matrix per
    axis and image.
    """
    inverse = 1 / scale.double()
    rows, columns = (
        resampling(size, inverse[axis], -shift[axis] * inverse[axis], edge)[:, None].to(x)
        for axis, (size, edge) in enumerate(zip(x.shape[2:], ("reflect", "circular"), strict=True))
    )
    return rows @ x @ columns.mT


@torch.no_grad()
def resampling(size: int, scale: Tensor, shift: Tensor, edge: str) -> Tensor:
    """Matrix that resamples a line of `size` pixels at scale n + shift, n from its centre, (B, size, size).

    Scale and shift are (B,), float64; `edge` pads "circular" or "reflect".
    """
    device = scale.device
    taps = torch.tensor(SYM6, device=device)
    lines = F.pad(torch.eye(size, device=device)[:, None], (size - 1, size - 1), mode=edge)
    doubled = F.conv_transpose1d(lines, taps[None, None], stride=2, padding=len(SYM6) // 2 - 1)[:, 0].T
    inputs, outputs = len(doubled), 2 * (size + 2 * MARGIN)
    pixel = (torch.arange(outputs, device=device, dtype=torch.float64) + 1 - outputs / 2) / 2
    place = 2 * (scale[:, None] * pixel + shift[:, None]) - 1 + inputs / 2
    first = place.floor().long()
    share = (place - first).float()[..., None]
    values = _row(doubled, first) * (1 - share) + _row(doubled, first + 1) * share
    halved = [tap * values[:, 1 + m : 1 + m + 2 * size : 2] for m, tap in enumerate(SYM6)]
    return sum(halved[1:], halved[0])


def _row(lines: Tensor, index: Tensor) -> Tensor:
    """Rows of `lines`; 0 beyond the ends."""
    inside = (index >= 0) & (index < len(lines))
    return lines[index.clamp(0, len(lines) - 1)] * inside[..., None].to(lines)


def coloured(x: Tensor, draws: Mapping[str, Draw]) -> Tensor:
    """Apply all of `COLOUR` to x of one channel; images of two channels are unchanged, as in the published code."""
    if x.shape[1] != 1:
        return x
    for name in COLOUR:
        value, chosen = (tensor[:, None, None, None].to(x.device) for tensor in draws[name])
        changed = x + value if name == "brightness" else x * (value if name == "contrast" else 1 - 2 * value)
        x = torch.where(chosen > 0, changed, x)
    return x
