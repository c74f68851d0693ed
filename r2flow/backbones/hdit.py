"""HDiT: an hourglass of transformer blocks on image tokens (paper, figure 4), with rays as positions."""

import math
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, NamedTuple, Self, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.attention import BACKENDS, neighbourhood_attention
from r2flow.backbones.base import Backbone, integers
from r2flow.backbones.detail import Detail
from r2flow.backbones.encodings import ENCODINGS, RayEncoding, Rotary, position_name, rotate
from r2flow.backbones.layers import (
    AdaRMSNorm,
    ExactLinear,
    RandomFourierFeatures,
    RMSNorm,
    at_least_float32,
    geglu,
    in_bands,
    mapping_network,
    shared,
    uncast,
    unshuffle,
    zero_initialised,
)
from r2flow.errors import InputError, check
from r2flow.registry import Bound, Count, Portion


class HDiT(Backbone):
    """Hourglass transformer.

    Tokens have patch_h x patch_w pixels. Each outer level has `depths[l]` blocks of neighbourhood attention in the
    encoder and in the decoder; between levels, 2 x 2 tokens are merged and the width is doubled. The bottleneck has
    `depths[-1]` blocks of global attention. Queries and keys are rotated by the ray angles (`Rotary`). Parameters have
    the names of the published weights. Under autocast, the first and last layers keep their weights' dtype (`uncast`).

    Args:
        base_channels: Width of the outermost level, doubled at each deeper level.
        depths: Blocks of each level, the bottleneck last.
        num_heads: Heads of each level, the bottleneck last.
        time_channels: Width of the time embedding.
        position: Position embedding added to the tokens: "learnable", "fourier_features", "polar",
            "spherical_harmonics" or "none".
        window: Rows and columns of the attention window, odd.
        patch: Rows and columns of a token.
        ring: Whether the columns are a full turn.
        dropout: Dropout rate of attention outputs and feed-forward activations in training.
        attention: Backend of `neighbourhood_attention`.
        detail: Blocks and channels of a parallel convolutional path at full resolution (`Detail`), which learns smooth
            surfaces faster; None: the paper's network.
    """

    takes_second_time = True
    croppable = True
    features: Tensor  # of the tokens' rays

    def __init__(
        self,
        rays: Tensor,
        base_channels: Count = 128,
        depths: Sequence[int] = (3, 3, 3, 3),
        num_heads: Sequence[int] = (2, 4, 8, 16),
        time_channels: Annotated[int, Bound("of at least 2", lambda n: n >= 2)] = 256,
        position: str | None = "learnable",
        window: Sequence[int] = (3, 9),
        patch: Sequence[int] = (1, 4),
        ring: bool = True,
        dropout: Portion = 0.0,
        attention: str = "auto",
        detail: Sequence[int] | None = None,
        **common: Any,
    ) -> None:
        levels = max(len(depths), 1)
        depths = integers("depths", depths, levels)
        if len(num_heads) > levels:  # published configs may list more: the bottleneck takes the last
            num_heads = [*num_heads[: levels - 1], num_heads[-1]]
        heads = integers("num_heads", num_heads, levels)
        patch_h, patch_w = integers("patch", patch, 2)
        super().__init__(rays, (patch_h << (levels - 1), patch_w << (levels - 1)), **common)
        self.patch, self.levels = (patch_h, patch_w), levels
        rows, columns = rays.shape[1] // patch_h, rays.shape[2] // patch_w
        span_h, span_w = integers("window", window, 2)
        check(span_h % 2 and span_w % 2, f"the attention window must have odd sizes, found {(span_h, span_w)}.")
        _ = attention == "auto" or BACKENDS[attention]  # refuses an unknown name early
        local = Neighbourhood((span_h, span_w), ring, attention)
        widths = [base_channels * 2**level for level in range(levels)]

        def blocks(level: int) -> nn.ModuleList:
            highest = max((rows // 2) >> level, 1), max((columns // 2) >> level, 1)
            nearby = None if level == levels - 1 else local
            options = BlockOptions(widths[level], heads[level], time_channels, highest, nearby, dropout)
            return nn.ModuleList([Block(options) for _ in range(depths[level])])

        self.timestep_pe = time_embedding(time_channels, dropout)
        self.tokenizer = nn.Sequential(nn.Conv2d(self.in_channels, base_channels, self.patch, self.patch, bias=False))
        name, tokens = position_name(position, "learnable", "none"), (rows, columns)
        self.spatial_pe: LearnablePosition | nn.Sequential | None = None
        if name == "learnable":
            self.spatial_pe = LearnablePosition(tokens, base_channels)
        elif name != "none":
            features = RayFeatures(ENCODINGS[name](tokens), base_channels)
            self.spatial_pe = nn.Sequential(features, mapping_network(base_channels, nn.Linear, dropout))
        self.down_levels, self.up_levels = nn.ModuleDict(), nn.ModuleDict()
        for level in range(levels - 1):
            for side in (self.down_levels, self.up_levels):
                side[f"level_{level}"] = blocks(level)
            merged = nn.Linear(4 * widths[level], 2 * widths[level], bias=False)
            self.down_levels[f"merge_{level}"] = nn.Sequential(Shuffle(), merged)
            self.up_levels[f"expand_{level}"] = Expand(widths[level])
        self.mid_levels = blocks(levels - 1)
        pixels = zero_initialised(nn.Linear(base_channels, math.prod(self.patch) * self.out_channels, bias=False))
        self.detokenizer = nn.Sequential(RMSNorm(base_channels), pixels)
        self.detail = None
        if detail is not None:
            (count, wide), ends = integers("detail", detail, 2), (self.in_channels, self.out_channels)
            self.detail = Detail(count, wide, ends, base_channels, self.patch, time_channels, ring)
        if self.second_time:
            last = zero_initialised(ExactLinear(time_channels, time_channels, bias=False))
            self.interval_embedding = time_embedding(time_channels, dropout).append(last)
        self.follow_rays()

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.timestep_pe, t, s)
        h = uncast(self.tokenizer, x).permute(0, 2, 3, 1).contiguous()
        if isinstance(self.spatial_pe, LearnablePosition):
            h = h + self.spatial_pe.embedding.to(h.dtype)
        elif self.spatial_pe is not None:
            h = h + self.spatial_pe(self.features).to(h.dtype)
        skips, tables = [], [self.get_buffer(f"table_{level}") for level in range(self.levels)]
        for level in range(self.levels - 1):
            for block in _level(self.down_levels, level):
                h = block(h, condition, tables[level])
            skips.append(h)
            h = self.down_levels[f"merge_{level}"](h)
        for block in self._blocks(self.levels - 1):
            h = block(h, condition, tables[-1])
        for level in reversed(range(self.levels - 1)):
            h = self.up_levels[f"expand_{level}"](h, skips.pop())
            for block in _level(self.up_levels, level):
                h = block(h, condition, tables[level])
        v = unshuffle(uncast(self.detokenizer, h), self.patch).permute(0, 3, 1, 2)
        return v if self.detail is None else v + self.detail(x, h, condition)

    def follow_rays(self) -> None:
        tokens = rays = F.avg_pool2d(self.coords, self.patch)
        for level in range(self.levels):
            # Level after level in float32: harmonics amplify the rounding that the published weights were trained with.
            rays = F.avg_pool2d(rays, 2) if level else tokens
            table = _shared_rotation(level, self._blocks(level)).table(rays)
            self.register_buffer(f"table_{level}", table, persistent=False)
        if isinstance(self.spatial_pe, nn.Sequential):
            encoding = cast(RayFeatures, self.spatial_pe[0]).embedding
            self.register_buffer("features", encoding(tokens).permute(0, 2, 3, 1), persistent=False)

    @property
    def learns_directions(self) -> bool:  # type: ignore[override]
        return isinstance(self.spatial_pe, LearnablePosition)

    def cropped(self, rows: Tensor, columns: Tensor) -> Self:
        part = super().cropped(rows, columns)
        if isinstance(part.spatial_pe, LearnablePosition):
            learned = part.spatial_pe.embedding.detach()
            for dim, numbers, step in zip((1, 2), (rows, columns), self.patch, strict=True):
                learned = learned.index_select(dim, numbers[::step].to(learned.device) // step)
            part.spatial_pe.embedding = nn.Parameter(learned, requires_grad=False)
        return part

    def _blocks(self, level: int) -> list["Block"]:
        if level == self.levels - 1:
            return list(cast("Iterable[Block]", self.mid_levels))
        return [*_level(self.down_levels, level), *_level(self.up_levels, level)]


def time_embedding(channels: int, dropout: float) -> nn.Sequential:
    """t (B,) to (B, channels): random Fourier features and a mapping network."""
    return nn.Sequential(RandomFourierFeatures(channels), mapping_network(channels, dropout=dropout))


def _level(side: nn.ModuleDict, level: int) -> Iterable["Block"]:
    return cast("Iterable[Block]", side[f"level_{level}"])


def _shared_rotation(level: int, blocks: Sequence["Block"]) -> Rotary:
    """The rotation of all blocks of a level, which share a table: their loaded frequencies must be equal."""
    first, *others = (block.residual_attn.rope for block in blocks)
    for name, buffer in first.named_buffers():
        if not buffer.is_meta and any(not torch.equal(buffer, other.get_buffer(name)) for other in others):
            raise InputError(f"the blocks of hdit level {level} differ in their rotary {name}; they must not.")
    return first


class LearnablePosition(nn.Module):
    """A learned vector added to each token: the absolute position embedding of the paper."""

    def __init__(self, tokens: tuple[int, int], channels: int) -> None:
        super().__init__()
        self.embedding = nn.Parameter(nn.init.trunc_normal_(torch.empty(1, *tokens, channels), std=0.02))


class RayFeatures(nn.Module):
    """W f for fixed features f of rays, by `embedding`."""

    def __init__(self, embedding: RayEncoding, channels: int) -> None:
        super().__init__()
        self.embedding = embedding
        self.linear = ExactLinear(embedding.channels, channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        return self.linear(features).to(self.linear.weight.dtype)


class Neighbourhood(NamedTuple):
    """Options of `neighbourhood_attention`."""

    window: tuple[int, int]
    ring: bool
    backend: str


class BlockOptions(NamedTuple):
    channels: int
    heads: int
    condition_channels: int
    highest: tuple[int, int]  # harmonics of the rotation in elevation and azimuth
    neighbourhood: Neighbourhood | None  # window of attention; None: all tokens
    dropout: float


class Block(nn.Module):
    """x + attention(x), then x + feed-forward(x), both with norms that depend on the condition."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        self.residual_attn = Attention(options)
        self.residual_ffn = FeedForward(options)

    def forward(self, x: Tensor, condition: Tensor, table: Tensor) -> Tensor:
        """x (B, H, W, C), condition (B or 1, K), table of `Rotary`."""
        x = x + self.residual_attn(x, condition, table)
        (x,) = in_bands(lambda x: (x + self.residual_ffn(x, condition),), x)
        return x


class Attention(nn.Module):
    """Cosine attention: logits s (q / |q|) . (k / |k|), rotated, with a learned scale s <= 100 per head."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        channels, heads = options.channels, options.heads
        shared(channels, 4 * heads, f"{heads} heads with their rotation")
        self.heads, self.neighbourhood = heads, options.neighbourhood
        self.scale = nn.Parameter(torch.full((heads, 1), math.log(10.0)))
        self.norm = AdaRMSNorm(channels, options.condition_channels)
        self.qkv_proj = nn.Linear(channels, 3 * channels, bias=False)
        self.rope = Rotary(heads, channels // heads, options.highest)
        self.dropout = nn.Dropout(options.dropout)
        self.out_proj = zero_initialised(nn.Linear(channels, channels, bias=False))

    def forward(self, x: Tensor, condition: Tensor, table: Tensor) -> Tensor:
        q, k, v = in_bands(lambda x, table: self._project(x, condition, table), x, table)
        if self.neighbourhood is None:
            q, k, v = (part.flatten(1, 2).transpose(1, 2) for part in (q, k, v))
            out = F.scaled_dot_product_attention(q, k, v, scale=1.0).transpose(1, 2).unflatten(1, x.shape[1:3])
        else:
            out = neighbourhood_attention(q, k, v, *self.neighbourhood)
        return self.out_proj(self.dropout(out.flatten(-2)))

    def open_ring(self) -> None:
        """Shift windows inside at the left and right edges, too."""
        if self.neighbourhood is not None:
            self.neighbourhood = self.neighbourhood._replace(ring=False)

    def macs(self, inputs: tuple[Tensor, ...], output: Tensor) -> int:
        """Both products of neighbourhood attention on the map padded by half a window on both sides of the ring."""
        if self.neighbourhood is None:
            return 0
        rows, columns = self.neighbourhood.window
        batch, height, width, channels = output.shape
        padded = width + 2 * (columns // 2) if self.neighbourhood.ring else width
        return 2 * batch * height * padded * rows * columns * channels

    def _project(self, x: Tensor, condition: Tensor, table: Tensor) -> tuple[Tensor, ...]:
        """q, k and v, each (B, H, W, N, D), q and k of length sqrt(s) and rotated."""
        qkv = self.qkv_proj(self.norm(x, condition)).unflatten(-1, (3, self.heads, -1))
        qk, v = at_least_float32(qkv[..., :2, :, :]), qkv[..., 2, :, :]  # s would amplify q's and k's rounding
        scale = at_least_float32(self.scale).clamp(max=math.log(100.0)).exp().sqrt()
        qk = qk * (scale * qk.square().sum(-1, keepdim=True).clamp(min=1e-12).rsqrt())  # q / max(|q|, 1e-6)
        return *rotate(qk, table).to(v.dtype).unbind(-3), v


class FeedForward(nn.Module):
    """W_2 GEGLU(W_1 ada_rms_norm(x)), three times as wide inside."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        channels = options.channels
        self.adarms = AdaRMSNorm(channels, options.condition_channels)
        self.gegelu = nn.Linear(channels, 2 * 3 * channels, bias=False)
        self.dropout = nn.Dropout(options.dropout)
        self.linear = zero_initialised(nn.Linear(3 * channels, channels, bias=False))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return self.linear(self.dropout(geglu(self.gegelu(self.adarms(x, condition)))))


class Shuffle(nn.Module):
    """(B, 2 H, 2 W, C) to (B, H, W, 4 C)."""

    def forward(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).permute(0, 1, 3, 2, 4, 5).flatten(3)


class Expand(nn.Module):
    """A token of 2C channels becomes 2 x 2 of C, mixed with the skip: lerp(skip, x, sigmoid(alpha))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.zeros(channels))
        self.linear = nn.Linear(2 * channels, 4 * channels, bias=False)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = unshuffle(self.linear(x), (2, 2))
        return torch.lerp(skip, x.to(skip.dtype), self.alpha.sigmoid().to(skip.dtype))
