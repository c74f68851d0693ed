"""Plain vision transformer: global attention between large patches, without levels."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.encodings import FourierFeatures
from r2flow.backbones.hdit import RayFeatures, interval_embedding, time_embedding
from r2flow.backbones.layers import RMSNorm, uncast, unshuffle, zero_initialised
from r2flow.backbones.transformer import Block, BlockOptions
from r2flow.base.registry import Count, Natural, Portion, Size


class ViT(Backbone):
    """Blocks of HDiT on one grid of patches, each with attention between all tokens.

    Tokens are patches and `registers`, learned vectors without a place that are dropped at the end
    (Darcet et al. 2024, "Vision transformers need registers"). Queries and keys of patches are
    rotated by the ray angles, periodic in azimuth (`Rotary`), and Fourier features of the ray are
    added to each patch. Patches with more values than `channels` need `prediction="data"`: their
    noise, and with it the velocity, does not fit into a token (Li and He 2025).

    Args:
        channels: Width of the tokens.
        depth: Number of blocks.
        heads: Heads of attention.
        time_channels: Width of the time embedding.
        registers: Number of registers.
        patch: Rows and columns of a patch.
        dropout: Dropout rate of attention outputs and feed-forward activations in training.
    """

    takes_second_time = True
    features: Tensor  # of the patches' rays
    table: Tensor  # rotations of the tokens

    def __init__(
        self,
        rays: Tensor,
        channels: Count = 384,
        depth: Count = 12,
        heads: Count = 6,
        time_channels: Count = 256,
        registers: Natural = 4,
        patch: Size = (4, 16),
        dropout: Portion = 0.0,
        **common: Any,
    ) -> None:
        patch_h, patch_w = patch
        super().__init__(rays, (patch_h, patch_w), **common)
        self.patch = (patch_h, patch_w)
        rows = rays.shape[1] // patch_h
        columns = rays.shape[2] // patch_w
        highest = (max(rows // 2, 1), max(columns // 2, 1))
        options = BlockOptions(channels, heads, time_channels, highest, None, dropout)
        self.time = time_embedding(time_channels, dropout)
        self.tokenizer = nn.Conv2d(self.in_channels, channels, self.patch, self.patch, bias=False)
        self.position = RayFeatures(FourierFeatures((rows, columns)), channels)
        self.registers = nn.Parameter(torch.randn(1, registers, channels) * 0.02)
        self.blocks = nn.ModuleList(Block(options) for _ in range(depth))
        pixels = nn.Linear(channels, patch_h * patch_w * self.out_channels, bias=False)
        self.detokenizer = nn.Sequential(RMSNorm(channels), zero_initialised(pixels))
        if self.second_time:
            self.interval_embedding = interval_embedding(time_channels, dropout)
        self.follow_rays()

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.time, t, s)
        grid = uncast(self.tokenizer, x).permute(0, 2, 3, 1)
        grid = grid + self.position(self.features).to(grid.dtype)
        # not len(grid), which torch.export would take for a constant
        registers = self.registers.to(grid.dtype).expand(grid.shape[0], -1, -1)
        # A map of one row, as blocks take it.
        h = torch.cat([registers, grid.flatten(1, 2)], 1)[:, None]
        for block in self.blocks:
            h = block(h, condition, self.table)
        patches = h[:, 0, self.registers.shape[1] :].unflatten(1, grid.shape[1:3])
        return unshuffle(uncast(self.detokenizer, patches), self.patch).permute(0, 3, 1, 2)

    def follow_rays(self) -> None:
        rays = F.avg_pool2d(self.coords, self.patch)
        features = self.position.embedding(rays).permute(0, 2, 3, 1)
        self.register_buffer("features", features, persistent=False)
        # Registers are not rotated.
        still = rays.new_zeros(1, 2, 1, self.registers.shape[1])
        first: Any = self.blocks[0]
        angles = torch.cat([still, rays.flatten(2)[:, :, None]], 3)
        self.register_buffer("table", first.residual_attn.rope.table(angles), persistent=False)
