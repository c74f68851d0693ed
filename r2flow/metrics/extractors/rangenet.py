"""RangeNet++ (Milioto et al., IROS 2019): FRD's RangeNet-53 and FRID's RangeNet-21.

Darknet on range images: a U-Net with additive skips that halves the width five times and keeps the
height. Parameters are named as in the evaluation of the generative papers, `stem.0.weight` ...
`head.1.bias`; names of the original release (`conv1.weight`, `enc1.residual_0.bn2.bias` ...) are
translated.
"""

import random
import re
from abc import abstractmethod
from typing import Self

import torch
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.metrics.extractors.base import Extractor, Tensors
from r2flow.metrics.scans import Scans

_WIDTHS = (32, 64, 128, 256, 512, 1024)

# Statistics of SemanticKITTI, the training set of the published networks: range, x, y, z in metres,
# reflectance.
_MEAN = (12.12, 10.88, 0.23, -1.04, 0.21)
_STD = (12.32, 11.47, 6.91, 0.86, 0.16)


def _convolution(convolution: nn.Module, channels: int) -> nn.Sequential:
    return nn.Sequential(convolution, nn.BatchNorm2d(channels), nn.LeakyReLU(0.1))


class _Residual(nn.Module):
    """x + f(x) with a bottleneck f."""

    def __init__(self, channels: int, inner: int) -> None:
        super().__init__()
        self.residual = nn.Sequential(
            _convolution(nn.Conv2d(channels, inner, 1, bias=False), inner),
            _convolution(nn.Conv2d(inner, channels, 3, padding=1, bias=False), channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x + self.residual(x)


class _Level(nn.Module):
    """A convolution that halves or doubles the number of columns, then residual blocks."""

    def __init__(self, channels: int, out: int, blocks: int) -> None:
        super().__init__()
        change: nn.Module
        if out > channels:
            change = nn.Conv2d(channels, out, 3, stride=(1, 2), padding=1, bias=False)
        else:
            change = nn.ConvTranspose2d(channels, out, (1, 4), stride=(1, 2), padding=(0, 1))
        self.conv = _convolution(change, out)
        self.residual_blocks = nn.Sequential(*(_Residual(out, channels) for _ in range(blocks)))

    def forward(self, x: Tensor) -> Tensor:
        return self.residual_blocks(self.conv(x))


class _RangeNet(Extractor):
    """RangeNet of 21 or 53 layers on range, x, y, z and optionally reflectance.

    Features precede the segmentation head of `num_classes` (0: no head).
    """

    blocks: tuple[int, ...]  #: residual blocks per level
    bands = 1  #: the height must be a multiple of it
    mean: Tensor
    std: Tensor

    def __init__(self, num_classes: int = 20) -> None:
        super().__init__()
        channels = 4 + self.needs_reflectance
        stem = nn.Conv2d(channels, _WIDTHS[0], 3, padding=1, bias=False)
        self.stem = _convolution(stem, _WIDTHS[0])
        for level in range(1, 6):
            down = _Level(_WIDTHS[level - 1], _WIDTHS[level], self.blocks[level - 1])
            self.add_module(f"enc{level}", down)
        for level in range(5, 0, -1):
            self.add_module(f"dec{level}", _Level(_WIDTHS[level], _WIDTHS[level - 1], 1))
        self.head = None
        if num_classes:
            classifier = nn.Conv2d(_WIDTHS[0], num_classes, 3, padding=1)
            self.head = nn.Sequential(nn.Identity(), classifier)
        # Not persistent, since the published files hold only parameters.
        statistics = torch.tensor([_MEAN, _STD])[:, :channels, None, None]
        self.register_buffer("mean", statistics[0], persistent=False)
        self.register_buffer("std", statistics[1], persistent=False)

    def _normalise(self, image: Tensor) -> Tensor:
        """(image - mean) / std at pixels with a return, else 0; (B, 4 or 5, H, W), range first."""
        return (image - self.mean) / self.std * (image[:, :1] > 0)

    def forward(self, x: Tensor) -> Tensor:
        """Last decoder map, (B, 32, H, W), of a normalised image; W must be a multiple of 32."""
        skips = [self.stem(x)]
        for level in range(1, 6):
            skips.append(self.get_submodule(f"enc{level}")(skips[-1]))
        x = skips.pop()
        for level in range(5, 0, -1):
            x = self.get_submodule(f"dec{level}")(x) + skips.pop()
        return x

    @torch.inference_mode()
    def features(self, scans: Scans) -> Tensor:
        h, w = scans.sensor.shape
        if w % 32 or h % self.bands:
            raise InputError(
                f"{self.name} needs images of multiples of {self.bands} x 32, found {h} x {w}; "
                "choose a --size."
            )
        reflectance = scans.images[:, 1 : 1 + self.needs_reflectance]
        image = torch.cat([scans.images[:, :1], scans.xyz, reflectance], 1).to(self.device)
        return scans.nan_where_empty(self.pool(self(self._normalise(image))))

    @abstractmethod
    def pool(self, maps: Tensor) -> Tensor:
        """Map decoder maps (B, C, H, W) to features (B, D)."""

    @classmethod
    def from_tensors(cls, tensors: Tensors) -> Self:
        tensors = {_translate(name): tensor for name, tensor in tensors.items()}
        return cls(len(tensors.get("head.1.bias", ()))).filled(tensors)


class RangeNet53(_RangeNet):
    """FRD's network on range and reflectance; features are a fixed random choice of 4096 values."""

    name = "rangenet53"
    layer = "decoder map, 4096 of its values by a fixed draw"
    dim = 4096
    needs_reflectance = True
    blocks = (1, 2, 8, 8, 4)

    def pool(self, maps: Tensor) -> Tensor:
        flat = maps.flatten(1)
        # The published choice, made by Python's random generator, is part of the metric.
        indices = random.Random(0).sample(range(flat.shape[1]), self.dim)
        return flat[:, torch.tensor(indices, device=maps.device)]


class RangeNet21(_RangeNet):
    """FRID's network on range; features are means of the decoder map over 16 bands of rows.

    They were published as "depth".
    """

    name = "rangenet21"
    layer = "decoder map, mean over 16 bands of rows"
    dim = 512
    blocks = (1, 1, 2, 2, 1)
    bands = 16

    def pool(self, maps: Tensor) -> Tensor:
        return maps.unflatten(2, (self.bands, -1)).mean((3, 4)).flatten(1)


# Substitutions from names of the original release, applied in order. The head's file uses the bare
# name "1.weight".
_NAMES = (
    (r"^(backbone|decoder)\.", ""),
    (r"^1\.", "head.1."),
    (r"^conv1\.", "stem.0."),
    (r"^bn1\.", "stem.1."),
    (r"^((?:enc|dec)\d)\.(?:up)?conv\.(?!\d)", r"\1.conv.0."),
    (r"^((?:enc|dec)\d)\.bn\.", r"\1.conv.1."),
    (r"^(dec\d)\.residual\.", r"\1.residual_0."),
    (r"\.residual_(\d+)\.", r".residual_blocks.\1."),
    (r"(\.residual_blocks\.\d+)\.conv1\.", r"\1.residual.0.0."),
    (r"(\.residual_blocks\.\d+)\.bn1\.", r"\1.residual.0.1."),
    (r"(\.residual_blocks\.\d+)\.conv2\.", r"\1.residual.1.0."),
    (r"(\.residual_blocks\.\d+)\.bn2\.", r"\1.residual.1.1."),
)


def _translate(name: str) -> str:
    """Translate a parameter name of the original release; keep names of r2flow."""
    for pattern, replacement in _NAMES:
        name = re.sub(pattern, replacement, name)
    return name
