"""HDiT: an hourglass of transformer blocks on image tokens (paper, figure 4), by ray positions."""

from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.attention import BACKENDS
from r2flow.backbones.base import Backbone
from r2flow.backbones.detail import Detail
from r2flow.backbones.encodings import ENCODINGS, RayEncoding, position_name
from r2flow.backbones.layers import (
    ExactLinear,
    RandomFourierFeatures,
    RMSNorm,
    mapping_network,
    uncast,
    unshuffle,
    zero_initialised,
)
from r2flow.backbones.transformer import Block, BlockOptions, Expand, Neighbourhood, merge
from r2flow.base.errors import InputError
from r2flow.base.registry import Bound, Count, Counts, Portion, Size

_Odd = Annotated[Count, Bound("odd", lambda n: n % 2)]


class HDiT(Backbone):
    """Hourglass transformer.

    Tokens have patch_h x patch_w pixels. Each outer level has `depths[l]` blocks of neighbourhood
    attention in the encoder and in the decoder; between levels, 2 x 2 tokens are merged and the
    width is doubled. The bottleneck has `depths[-1]` blocks of global attention. Queries and keys
    are rotated by the ray angles (`Rotary`). Parameters have the names of the published weights.
    Under autocast, the first and last layers keep their weights' dtype (`uncast`).

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
        detail: Blocks and channels of a parallel convolutional path at full resolution (`Detail`),
            which learns smooth surfaces faster; None: the paper's network.
    """

    takes_second_time = True
    features: Tensor  # of the tokens' rays

    def __init__(
        self,
        rays: Tensor,
        base_channels: Count = 128,
        depths: Counts = (3, 3, 3, 3),
        num_heads: Counts = (2, 4, 8, 16),
        time_channels: Count = 256,
        position: str | None = "learnable",
        window: tuple[_Odd, _Odd] = (3, 9),
        patch: Size = (1, 4),
        ring: bool = True,
        dropout: Portion = 0.0,
        attention: str = "auto",
        detail: Size | None = None,
        **common: Any,
    ) -> None:
        levels = len(depths)
        if len(num_heads) < levels:
            raise InputError(f"num_heads must be of {levels} levels, as depths, found {num_heads}.")
        # Published configs may list more: the bottleneck takes the last.
        heads = [*num_heads[: levels - 1], num_heads[-1]]
        patch_h, patch_w = patch
        super().__init__(rays, (patch_h << levels - 1, patch_w << levels - 1), **common)
        self.patch = (patch_h, patch_w)
        self.levels = levels
        tokens = (rays.shape[1] // patch_h, rays.shape[2] // patch_w)
        if attention != "auto":
            BACKENDS[attention]  # refuses an unknown name early
        neighbourhood = Neighbourhood(window, ring, attention)

        def blocks(level: int) -> nn.ModuleList:
            near = neighbourhood if level < levels - 1 else None
            highest = (max(tokens[0] >> level + 1, 1), max(tokens[1] >> level + 1, 1))
            width = base_channels * 2**level
            options = BlockOptions(width, heads[level], time_channels, highest, near, dropout)
            return nn.ModuleList(Block(options) for _ in range(depths[level]))

        self.timestep_pe = time_embedding(time_channels, dropout)
        self.tokenizer = nn.Sequential(
            nn.Conv2d(self.in_channels, base_channels, self.patch, self.patch, bias=False)
        )
        self.spatial_pe = _position(position, tokens, base_channels, dropout)
        self.down_levels = nn.ModuleDict()
        self.up_levels = nn.ModuleDict()
        for level in range(levels - 1):
            self.down_levels[f"level_{level}"] = blocks(level)
            self.up_levels[f"level_{level}"] = blocks(level)
            self.down_levels[f"merge_{level}"] = merge(base_channels * 2**level)
            self.up_levels[f"expand_{level}"] = Expand(base_channels * 2**level)
        self.mid_levels = blocks(levels - 1)
        pixels = nn.Linear(base_channels, patch_h * patch_w * self.out_channels, bias=False)
        self.detokenizer = nn.Sequential(RMSNorm(base_channels), zero_initialised(pixels))
        self.detail = None
        if detail is not None:
            ends = (self.in_channels, self.out_channels)
            self.detail = Detail(*detail, ends, base_channels, self.patch, time_channels, ring)
        if self.second_time:
            self.interval_embedding = interval_embedding(time_channels, dropout)
        self.follow_rays()

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.timestep_pe, t, s)
        h = uncast(self.tokenizer, x).permute(0, 2, 3, 1).contiguous()
        if self.spatial_pe is not None:
            h = h + self.spatial_pe(self.features).to(h.dtype)
        skips = []
        for level in range(self.levels - 1):
            h = self._run(self.down_levels[f"level_{level}"], level, h, condition)
            skips.append(h)
            h = self.down_levels[f"merge_{level}"](h)
        h = self._run(self.mid_levels, self.levels - 1, h, condition)
        for level in reversed(range(self.levels - 1)):
            h = self.up_levels[f"expand_{level}"](h, skips.pop())
            h = self._run(self.up_levels[f"level_{level}"], level, h, condition)
        v = unshuffle(uncast(self.detokenizer, h), self.patch).permute(0, 3, 1, 2)
        return v if self.detail is None else v + self.detail(x, h, condition)

    def _run(self, blocks: Any, level: int, h: Tensor, condition: Tensor) -> Tensor:
        table = self.get_buffer(f"table_{level}")
        for block in blocks:
            h = block(h, condition, table)
        return h

    def follow_rays(self) -> None:
        rays = F.avg_pool2d(self.coords, self.patch)
        features = rays
        if isinstance(self.spatial_pe, nn.Sequential):
            encoding: Any = self.spatial_pe[0]
            features = encoding.embedding(rays).permute(0, 2, 3, 1)
        self.register_buffer("features", features, persistent=False)
        for level in range(self.levels):
            # The blocks of a level have equal frequencies and share a table. Level after level in
            # float32: harmonics amplify the rounding that the published weights were trained with.
            blocks: Any = self.mid_levels
            if level < self.levels - 1:
                blocks = self.down_levels[f"level_{level}"]
            table = blocks[0].residual_attn.rope.table(rays)
            self.register_buffer(f"table_{level}", table, persistent=False)
            rays = F.avg_pool2d(rays, 2, ceil_mode=True)

    @property
    def learns_directions(self) -> bool:  # type: ignore[override]
        return isinstance(self.spatial_pe, _LearnablePosition)


def time_embedding(channels: int, dropout: float) -> nn.Sequential:
    """t (B,) to (B, channels): random Fourier features and a mapping network."""
    return nn.Sequential(
        RandomFourierFeatures(channels), mapping_network(channels, ExactLinear, dropout)
    )


def interval_embedding(channels: int, dropout: float) -> nn.Sequential:
    """`time_embedding` of s - t with a last layer that is zero at first."""
    last = zero_initialised(ExactLinear(channels, channels, bias=False))
    return time_embedding(channels, dropout).append(last)


def _position(
    position: str | None, tokens: Size, channels: int, dropout: float
) -> nn.Module | None:
    name = position_name(position, "learnable", "none")
    if name == "none":
        return None
    if name == "learnable":
        return _LearnablePosition(tokens, channels)
    return nn.Sequential(
        RayFeatures(ENCODINGS[name](tokens), channels),
        mapping_network(channels, nn.Linear, dropout),
    )


class _LearnablePosition(nn.Module):
    """A learned vector added to each token: the absolute position embedding of the paper."""

    def __init__(self, tokens: Size, channels: int) -> None:
        super().__init__()
        vectors = nn.init.trunc_normal_(torch.empty(1, *tokens, channels), std=0.02)
        self.embedding = nn.Parameter(vectors)

    def forward(self, rays: Tensor) -> Tensor:
        return self.embedding


class RayFeatures(nn.Module):
    """W f for fixed features f of rays, by `embedding`."""

    def __init__(self, embedding: RayEncoding, channels: int) -> None:
        super().__init__()
        self.embedding = embedding
        self.linear = ExactLinear(embedding.channels, channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        return self.linear(features).to(self.linear.weight.dtype)
