"""A convolutional path at full resolution, beside a network of tokens."""

import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.convolutions import RingConv2d
from r2flow.backbones.layers import ExactLinear, RMSNorm, uncast, unshuffle, zero_initialised


class Detail(nn.Module):
    """Residual 3 x 3 convolutions on single pixels, told by the tokens what is there.

    Near t = 1 a velocity is the noise that is left, pixel by pixel. A token of p x q pixels learns to pass it on
    slowly; a convolution finds it in a few hundred steps, as what differs from the neighbours. The path starts at zero.
    Its `ends` are the channels of the image and of the answer.
    """

    def __init__(
        self,
        blocks: int,
        channels: int,
        ends: tuple[int, int],
        token_channels: int,
        patch: tuple[int, int],
        condition_channels: int,
        ring: bool,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.norm = RMSNorm(token_channels)
        self.spread = nn.Linear(token_channels, patch[0] * patch[1] * channels, bias=False)
        self.image = RingConv2d(ends[0], channels, ring)
        self.gain = zero_initialised(ExactLinear(condition_channels, channels, bias=False))
        self.blocks = nn.ModuleList([DetailBlock(channels, condition_channels, ring) for _ in range(blocks)])
        self.answer = zero_initialised(RingConv2d(channels, ends[1], ring))

    def forward(self, x: Tensor, tokens: Tensor, condition: Tensor) -> Tensor:
        """x (B, C, H, W), tokens (B, H/p, W/q, K), condition (B or 1, L) to (B, C', H, W)."""
        h = unshuffle(self.spread(self.norm(tokens)), self.patch).permute(0, 3, 1, 2)
        seen = uncast(self.image, x)
        h = h + seen * (1 + self.gain(condition)[:, :, None, None]).to(seen.dtype)
        for block in self.blocks:
            h = block(h, condition)
        return uncast(self.answer, F.silu(h))


class DetailBlock(nn.Module):
    """x + conv(silu(conv(silu(x)) (1 + a) + b)), with a and b by the condition."""

    def __init__(self, channels: int, condition_channels: int, ring: bool) -> None:
        super().__init__()
        self.first = RingConv2d(channels, channels, ring)
        self.modulation = zero_initialised(ExactLinear(condition_channels, 2 * channels, bias=False))
        self.second = zero_initialised(RingConv2d(channels, channels, ring))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        h = self.first(F.silu(x))
        scale, shift = self.modulation(condition)[:, :, None, None].to(h.dtype).chunk(2, dim=1)
        return x + self.second(F.silu(h * (1 + scale) + shift))
