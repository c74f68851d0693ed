"""Adaptive discriminator augmentation (ADA) on a ring (Karras et al. 2020, "Training generative adversarial networks
with limited data", section 3 and appendix B).

All that the discriminator sees, real or generated, is changed at random, each transformation with probability p. p
follows how sure the discriminator is of real images.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.processes import summed
from r2flow.registry import Natural, NonNegative, Portion, did_you_mean

# Low-pass filter of the wavelet sym6 (Daubechies 1992), which images are doubled and halved with.
SYM6 = (
    0.015404109327027373, 0.0034907120842174702, -0.11799011114819057, -0.048311742585633, 0.4910559419267466,
    0.787641141030194, 0.3379294217276218, -0.07263752278646252, -0.021060292512300564, 0.04472490177066578,
    0.0017677118642428036, -0.007800708325034148,
)  # fmt: skip
MARGIN = len(SYM6) // 4  # pixels computed beyond each edge, which the filter needs


class Source(Protocol):
    """Where random numbers come from, of shape (B, *shape)."""

    def uniform(self, shape: tuple[int, ...]) -> Tensor: ...

    def normal(self, shape: tuple[int, ...]) -> Tensor: ...


class Draw(NamedTuple):
    """One transformation of a batch.

    Attributes:
        value: How much, (B,), or (2, B) for rows and columns.
        chosen: Whether at all, (B,), 0 or 1.
    """

    value: Tensor
    chosen: Tensor


def _flip(source: Source) -> Tensor:
    return (source.uniform((1,))[:, 0] < 0.5).float()


def _log_normal(source: Source, octaves: float) -> Tensor:
    return torch.exp2(octaves * source.normal((1,))[:, 0])


# In the order in which they are drawn and applied: what is drawn, for a batch.
GEOMETRY: dict[str, Any] = {
    "lr_flip": _flip,
    "ud_flip": _flip,
    "int_trans": lambda source: (source.uniform((2,)).mT - 0.5) / 4,  # of the height and of the width
    "iso_scale": lambda source: _log_normal(source, 0.2),
    "frac_trans": lambda source: 0.125 * source.normal((2,)).mT,
}
COLOUR: dict[str, Any] = {
    "brightness": lambda source: 0.2 * source.normal((1,))[:, 0],
    "contrast": lambda source: _log_normal(source, 0.5),
    "luma_flip": _flip,
    "hue": lambda source: math.pi * (2 * source.uniform((1,))[:, 0] - 1),
    "saturation": lambda source: _log_normal(source, 1.0),
}
TRANSFORMATIONS = (*GEOMETRY, *COLOUR)


class AdaptiveAugment(nn.Module):
    """Random transformations of probability p, and p's rule.

    Every `every` steps p moves by (images since) / (1000 kimg), up where the mean sign of D's scores of real images is
    above `target`, else down, within [0, highest].

    Args:
        target: Mean sign of scores of real images that p aims at; None leaves p as it is.
        kimg: Thousands of images in which p goes from 0 to 1.
        initial: p at first.
        highest: Largest p.
        every: Steps between two moves.
        policy: By what each transformation's probability differs from p, as a factor; a transformation that is not
            named has 1, and 0 leaves it out. Names: `TRANSFORMATIONS`.
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
            if name not in TRANSFORMATIONS:
                known = ", ".join(TRANSFORMATIONS)
                hint = did_you_mean(name, [*TRANSFORMATIONS])
                raise InputError(f"no augmentation named {name!r}; known: {known}.{hint}")
        self.policy = {name: float((policy or {}).get(name, 1)) for name in TRANSFORMATIONS}
        # The names of the published state.
        self.register_buffer("p", torch.tensor(float(initial)))
        self.register_buffer("sign_cum", torch.zeros(1))
        self.register_buffer("n_pred_cum", torch.zeros(1))

    def count(self, real: Tensor) -> None:
        """Remember D's scores of real images, of all processes."""
        self.sign_cum += summed(real.detach().float().sign().sum())
        self.n_pred_cum += summed(torch.tensor(float(len(real)), device=real.device))

    def move(self) -> Tensor:
        """Let p follow the remembered scores, and forget them; their mean sign r_t."""
        sign = self.sign_cum / self.n_pred_cum
        if self.target is not None and self.images:
            step = torch.sign(sign - self.target) * self.n_pred_cum / self.images
            self.p.copy_((self.p + step[0]).clamp(0, self.highest))
        self.sign_cum.zero_()
        self.n_pred_cum.zero_()
        return sign

    def draw(self, source: Source) -> dict[str, Draw]:
        """The transformations of a batch, by name. How many numbers are drawn does not depend on p."""
        found, p = {}, float(self.p)
        for name, values in (GEOMETRY | COLOUR).items():
            if self.policy[name]:
                value, u = values(source), source.uniform((1,))[:, 0]
                chosen = (u < p * self.policy[name]).float()
                found[name] = Draw(value.to(self.p.device), chosen.to(self.p.device))
        return found

    def forward(self, x: Tensor, draws: Mapping[str, Draw]) -> Tensor:
        """x (B, C, H, W) transformed, differentiable twice, in float32 at least."""
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(torch.promote_types(x.dtype, torch.float32))
            x = transformed(x, affine(draws, x.shape[-2], x.shape[-1]))
            return coloured(x, colour(draws).to(x))


def affine(draws: Mapping[str, Draw], height: int, width: int) -> Tensor:
    """The maps of pixels about the image's middle, (B, 3, 3), columns before rows, applied one after the other.

    They keep the axes: flips, shifts of an eighth of the image at most, in whole pixels, a scale of the rows (a
    scale of the columns would open the ring), and normal shifts.
    """
    batch = len(next(iter(draws.values())).chosen) if draws else 1
    found = _identity(batch, 3, draws)
    for name in GEOMETRY:
        if name not in draws:
            continue
        value, chosen = draws[name]
        own = _identity(batch, 3, draws)
        if name == "lr_flip":
            own[:, 0, 0] = 1 - 2 * value
        elif name == "ud_flip":
            own[:, 1, 1] = 1 - 2 * value
        elif name == "iso_scale":
            own[:, 1, 1] = value
        else:
            shift = value * torch.tensor([[height], [width]], device=value.device)
            own[:, :2, 2] = (shift.round() if name == "int_trans" else shift).flip(0).mT
        found = _where(chosen, own) @ found
    return found


def colour(draws: Mapping[str, Draw]) -> Tensor:
    """The maps of (r, g, b, 1), (B, 4, 4), applied one after the other; v is the grey axis (1, 1, 1) / sqrt 3."""
    batch = len(next(iter(draws.values())).chosen) if draws else 1
    found = _identity(batch, 4, draws)
    v = torch.full((3,), 3**-0.5, device=found.device)
    grey, eye = torch.outer(v, v), torch.eye(3, device=found.device)
    cross = torch.linalg.cross(eye, v.expand(3, 3), dim=1)  # cross @ u = v x u
    for name in COLOUR:
        if name not in draws:
            continue
        value, chosen = draws[name]
        own, by = _identity(batch, 4, draws), value[:, None, None]
        if name == "brightness":
            own[:, :3, 3] = value[:, None]
        elif name == "contrast":
            own[:, :3, :3] = by * eye
        elif name == "luma_flip":
            own[:, :3, :3] = eye - 2 * by * grey
        elif name == "hue":  # Rodrigues' rotation about the grey axis
            own[:, :3, :3] = by.cos() * eye + by.sin() * cross + (1 - by.cos()) * grey
        else:
            own[:, :3, :3] = grey + by * (eye - grey)
            own[:, 3, 3] = value  # as published; nothing reads it, for saturation comes last
        found = _where(chosen, own) @ found
    return found


def transformed(x: Tensor, maps: Tensor) -> Tensor:
    """x (B, C, H, W) moved by maps that keep the axes, (B, 3, 3): circular in azimuth, mirrored at the edge rows.

    Each axis is doubled by the filter `SYM6`, read between two pixels, and halved by the filter again: all of it linear
    in x, one matrix for each axis of each image.
    """
    scale = 1 / torch.diagonal(maps, dim1=1, dim2=2)[:, :2].double()
    shift = -maps[:, :2, 2].double() * scale
    columns = resampling(x.shape[3], scale[:, 0], shift[:, 0], "circular")
    rows = resampling(x.shape[2], scale[:, 1], shift[:, 1], "reflect")
    return rows[:, None].to(x) @ x @ columns[:, None].mT.to(x)


@torch.no_grad()
def resampling(size: int, scale: Tensor, shift: Tensor, edge: str) -> Tensor:
    """Weights of all pixels of a line in each pixel of the line read at scale n + shift, (B, size, size).

    Args:
        size: Pixels of the line; n counts them from its middle.
        scale: (B,), float64, as is `shift`.
        edge: What is beyond the ends: "circular" or "reflect".
    """
    device = scale.device
    taps = torch.tensor(SYM6, device=device)
    lines = F.pad(torch.eye(size, device=device)[:, None], (size - 1, size - 1), mode=edge)
    doubled = F.conv_transpose1d(lines, taps[None, None], stride=2, padding=len(SYM6) // 2 - 1)[:, 0].T  # (there, size)
    there, here = len(doubled), 2 * (size + 2 * MARGIN)
    pixel = (torch.arange(here, device=device, dtype=torch.float64) + 1 - here / 2) / 2
    place = 2 * (scale[:, None] * pixel + shift[:, None]) - 1 + there / 2
    first = place.floor().long()
    share = (place - first).float()[..., None]
    read = _row(doubled, first) * (1 - share) + _row(doubled, first + 1) * share
    halved = [tap * read[:, 1 + m : 1 + m + 2 * size : 2] for m, tap in enumerate(SYM6)]
    return sum(halved[1:], halved[0])


def _row(lines: Tensor, index: Tensor) -> Tensor:
    """Rows of `lines`, 0 beyond the ends."""
    held = (index >= 0) & (index < len(lines))
    return lines[index.clamp(0, len(lines) - 1)] * held[..., None].to(lines)


def coloured(x: Tensor, maps: Tensor) -> Tensor:
    """x with colour maps (B, 4, 4) applied: their mean gain and offset for one channel; more than one stay as they are.

    The published code also leaves two channels, range and reflectance, as they are.
    """
    if x.shape[1] != 1:
        return x
    mean = maps[:, :3].mean(1)
    return x * mean[:, :3].sum(1)[:, None, None, None] + mean[:, 3, None, None, None]


def _identity(batch: int, size: int, draws: Mapping[str, Draw]) -> Tensor:
    device = next(iter(draws.values())).chosen.device if draws else None
    return torch.eye(size, device=device).repeat(batch, 1, 1)


def _where(chosen: Tensor, maps: Tensor) -> Tensor:
    return torch.where(chosen[:, None, None] > 0, maps, torch.eye(maps.shape[-1], device=maps.device))
