"""Transformer layers, and modules that keep angles and conditions in float32."""

import math
from collections.abc import Callable, Sequence
from typing import Self, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.base.registry import Size

_Layer = TypeVar("_Layer", bound=nn.Module)

_BAND = 1024  # tokens


def at_least_float32(x: Tensor) -> Tensor:
    """x in float32, or in its dtype if wider."""
    # By promote_types, torch 2.6 cannot read a .pt2 back.
    return x if x.dtype == torch.float64 else x.float()


class ExactBuffers(nn.Module):
    """A module whose direct buffers move between devices but never change dtype.

    They hold rays, frequencies and derived values: at harmonic 128, rounding an azimuth to bfloat16
    rotates it by a radian. Autocast does not change buffers; this class protects them from
    `.half()` and similar methods.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        before = dict(self._buffers)
        super()._apply(fn, recurse)
        for name, buffer in before.items():
            moved = self._buffers[name]
            if moved.dtype != buffer.dtype:  # type: ignore[union-attr]
                self._buffers[name] = buffer.to(moved.device)  # type: ignore[union-attr]
        return self


def _without_autocast(x: Tensor) -> torch.autocast:
    device = "cpu" if x.is_meta else x.device.type  # the meta device has no autocast
    return torch.autocast(device, enabled=False)


class ExactLinear(nn.Linear):
    """A linear layer computed in float32 even under autocast, for conditions."""

    def forward(self, x: Tensor) -> Tensor:
        weight = at_least_float32(self.weight)
        bias = self.bias if self.bias is None else self.bias.to(weight.dtype)
        with _without_autocast(x):
            return F.linear(x.to(weight.dtype), weight, bias)


def uncast(layer: nn.Module, x: Tensor) -> Tensor:
    """layer(x) in the dtype of its weights, even under autocast.

    For the first and last layers of a network, which process image values: rounded to bfloat16,
    with 8 bits, these are rougher than real surfaces.
    """
    with _without_autocast(x):
        return cast(Tensor, layer(x.to(next(layer.parameters()).dtype)))


def zero_initialised(layer: _Layer) -> _Layer:
    """Set the weights and bias of a layer to zero: a residual block then starts as the identity."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def rms_norm(x: Tensor, scale: Tensor) -> Tensor:
    """x / sqrt(mean_c x^2 + 1e-6) * scale over the last dimension, computed in float32."""
    wide = at_least_float32(x)
    mean_square = torch.linalg.vector_norm(wide, dim=-1, keepdim=True).square() / x.shape[-1]
    return (wide * torch.rsqrt(mean_square + 1e-6) * scale).to(x.dtype)


class RMSNorm(nn.Module):
    """`rms_norm` with a learned scale per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        return rms_norm(x, self.scale)


class AdaRMSNorm(nn.Module):
    """rms_norm(x) (1 + W c) with condition c; W is initialised to zero."""

    def __init__(self, channels: int, condition_channels: int) -> None:
        super().__init__()
        # A Sequential of one layer, because the published weights are named `proj.0`.
        self.proj = nn.Sequential(
            zero_initialised(ExactLinear(condition_channels, channels, bias=False))
        )

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Normalise x, (B, H, W, C), with a condition (B, K), or (1, K) for the whole batch."""
        return rms_norm(x, 1 + self.proj(condition)[:, None, None])


def geglu(x: Tensor) -> Tensor:
    """h gelu(g) with (h, g) the two halves of a projection, and the exact gelu (erf)."""
    h, gate = x.chunk(2, dim=-1)
    return h * F.gelu(gate)


class RandomFourierFeatures(ExactBuffers):
    """W [cos(2 pi f t), sin(2 pi f t)] with `channels` // 2 fixed frequencies f ~ N(0, 1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.freqs = nn.Buffer(torch.randn(channels // 2))
        self.linear = ExactLinear(channels // 2 * 2, channels, bias=False)

    def forward(self, t: Tensor) -> Tensor:
        """t (B,) to (B, channels)."""
        phase = at_least_float32(t)[:, None] * (2 * math.pi * self.freqs)
        return self.linear(torch.cat([phase.cos(), phase.sin()], dim=-1))


class _MappingLayer(nn.Module):
    """x + W_2 GEGLU(W_1 rms_norm(x)), with hidden width 3 C."""

    def __init__(self, channels: int, linear: type[nn.Linear], dropout: float) -> None:
        super().__init__()
        self.norm = RMSNorm(channels)
        self.gegelu = linear(channels, 6 * channels, bias=False)
        self.dropout = nn.Dropout(dropout)
        self.linear = linear(3 * channels, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.linear(self.dropout(geglu(self.gegelu(self.norm(x)))))


def mapping_network(channels: int, linear: type[nn.Linear], dropout: float) -> nn.Sequential:
    """RMSNorm, two residual GEGLU layers, RMSNorm: the mapping network of HDiT's embeddings."""
    return nn.Sequential(
        RMSNorm(channels),
        _MappingLayer(channels, linear, dropout),
        _MappingLayer(channels, linear, dropout),
        RMSNorm(channels),
    )


def wrapped(x: Tensor, left: int, right: int) -> Tensor:
    """Pad an image, (B, C, H, W), circularly by `left` and `right` columns, also by several turns.

    F.pad(mode="circular") pads by one turn at most, and its backward takes five times as long.
    """
    columns = x.shape[3]
    middle = columns - left - right
    if middle < 0:
        return x[..., torch.arange(-left, columns + right, device=x.device) % columns]
    first, inner, last = x.split((right, middle, left), dim=3)
    return torch.cat([last, first, inner, last, first], dim=3)


def unshuffle(x: Tensor, patch: Size) -> Tensor:
    """(B, H, W, p q C) to (B, H p, W q, C)."""
    return x.unflatten(3, (*patch, -1)).permute(0, 1, 3, 2, 4, 5).flatten(3, 4).flatten(1, 2)


def rows_at_once(x: Tensor) -> int:
    """Number of rows of a map (B, H, W, ...) to process at a time.

    All rows, except on a CPU without gradients: a band of about `_BAND` tokens, so that
    intermediate results stay in the cache and in mapped memory, which makes the paper's HDiT a
    fifth faster.
    """
    batch, rows, columns = x.shape[:3]
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or not x.is_cpu:
        return rows
    return min(rows, max(1, _BAND // max(batch * columns, 1)))


def in_bands(f: Callable[..., tuple[Tensor, ...]], *maps: Tensor) -> tuple[Tensor, ...]:
    """f(*maps) for maps (., H, ...) and a row-wise f, in bands of `rows_at_once` rows."""
    band = rows_at_once(maps[0])
    if band == maps[0].shape[1]:
        return f(*maps)
    parts = map(f, *(x.split(band, dim=1) for x in maps))
    return tuple(torch.cat(outputs, dim=1) for outputs in zip(*parts, strict=True))


def halved(what: str, shape: Sequence[int], times: int, least: int = 1) -> Size:
    """Rows and columns of an image after `times` halvings, at least `least`.

    Raises:
        InputError: If a size is no multiple of 2^times, or smaller than it may be.
    """
    rows, columns = shape
    unit = 2**times
    if rows % unit or columns % unit or min(shape) < least * unit:
        raise InputError(
            f"{what} halves images {times} times: rows and columns must be multiples of {unit}, "
            f"at least {least * unit}, found {rows} x {columns}."
        )
    return rows // unit, columns // unit
