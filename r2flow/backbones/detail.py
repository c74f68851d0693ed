"""A convolutional path at full resolution, parallel to a network of tokens."""

import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.convolutions import RingConv2d
from r2flow.backbones.layers import ExactLinear, RMSNorm, uncast, unshuffle, zero_initialised
from r2flow.base.registry import Size


class Detail(nn.Module):
    """Residual 3 x 3 convolutions at full resolution, conditioned on the tokens.

    Near t = 1 the velocity is mostly the remaining noise of each pixel. Tokens of p x q pixels are
    slow to learn it; a convolution learns it in a few hundred steps, as the difference from the
    neighbours. The output is initially zero. `ends` are the channels of the image and of the
    output.
    """

    def __init__(
        self,
        blocks: int,
        channels: int,
        ends: tuple[int, int],
        token_channels: int,
        patch: Size,
        condition_channels: int,
        ring: bool,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.norm = RMSNorm(token_channels)
        self.spread = nn.Linear(token_channels, patch[0] * patch[1] * channels, bias=False)
        self.image = RingConv2d(ends[0], channels, ring)
        self.gain = zero_initialised(ExactLinear(condition_channels, channels, bias=False))

        self.blocks = nn.ModuleList(
            _DetailBlock(channels, condition_channels, ring) for _ in range(blocks)
        )
        self.answer = zero_initialised(RingConv2d(channels, ends[1], ring))

    def forward(self, x: Tensor, tokens: Tensor, condition: Tensor) -> Tensor:
        """x (B, C, H, W), tokens (B, H/p, W/q, K), condition (B or 1, L) to (B, C', H, W)."""
        h = unshuffle(self.spread(self.norm(tokens)), self.patch).permute(0, 3, 1, 2)
        pixels = uncast(self.image, x)
        h = h + pixels * (1 + self.gain(condition)[:, :, None, None]).to(pixels.dtype)
        for block in self.blocks:
            h = block(h, condition)
        return uncast(self.answer, F.silu(h))


class _DetailBlock(nn.Module):
    """x + conv(silu(conv(silu(x)) (1 + a) + b)), with a and b from the condition."""

    def __init__(self, channels: int, condition_channels: int, ring: bool) -> None:
        super().__init__()
        self.first = RingConv2d(channels, channels, ring)
        self.modulation = zero_initialised(
            ExactLinear(condition_channels, 2 * channels, bias=False)
        )
        self.second = zero_initialised(RingConv2d(channels, channels, ring))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        h = self.first(F.silu(x))
        scale, shift = self.modulation(condition)[:, :, None, None].to(h.dtype).chunk(2, dim=1)
        return x + self.second(F.silu(h * (1 + scale) + shift))
