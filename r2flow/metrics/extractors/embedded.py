"""The feature network that comes with the package: a small segmentation network for range images of any sensor.

It is trained on simulated scans only (benchmarks/train_extractor.py), so that a Frechet distance needs no download.
It is not the field's RangeNet-53, and its distance is no FRD. docs/metrics.md has what it is worth and its limits.
"""

import hashlib
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.metrics.extractors.base import Extractor, nan_where_empty
from r2flow.metrics.extractors.weights import read_safetensors
from r2flow.metrics.scans import Scans

SHIPPED = Path(__file__).with_name("embedded.safetensors")

# SemanticKITTI's classes; moving objects count with the others of their class, lane markings with the road.
CLASSES = (
    "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "road", "parking", "sidewalk",
    "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole", "traffic-sign",
)  # fmt: skip

INPUTS, REFLECTANCE = 9, slice(2, 4)  # channels of `inputs`, and those of them that are 0 without reflectance
CHANNELS = 16  # of the map that features are taken from
BANDS, SECTORS = 2, 8  # that the map is averaged over
STRIDE = 16  # columns that a scan must be rolled by for the map to be rolled exactly


def inputs(scans: Scans, reflectance: bool) -> Tensor:
    """The network's input, (B, 9, H, W), which does not depend on where azimuth begins.

    Log-range, return, reflectance, whether reflectance is known, height above the sensor, elevation; the second
    difference of range along the row, squashed; sine and cosine of the slope that rises from a pixel to the one below.
    The last three are 0 where a neighbour is missing.
    """
    r, returned = scans.images[:, :1], scans.returned
    e = scans.sensor.rays()[0].to(r)
    known = torch.full_like(r, float(reflectance))
    height, away = r * e.sin(), r * e.cos()
    left, right = r.roll(1, -1), r.roll(-1, -1)
    bend = torch.where(returned & (left > 0) & (right > 0), left - 2 * r + right, 0)
    rise, run = (F.pad(q[:, :, :-1] - q[:, :, 1:], (0, 0, 0, 1)) for q in (height, away))
    both = F.pad(returned[:, :, :-1] & returned[:, :, 1:], (0, 0, 0, 1))
    length = torch.where(both, torch.hypot(rise, run).clamp(min=1e-6), torch.inf)
    shown = scans.reflectance if reflectance else torch.zeros_like(r)
    distance, bent = torch.log2(r + 1) / 6, torch.asinh(bend * 20) / 4
    elevation = (e * 4).expand_as(r)
    channels = [distance, returned.to(r), shown, known, height / 4, elevation, bent, rise / length, run / length]
    return torch.cat(channels, dim=1)


class Convolution(nn.Module):
    """3 x 3 convolution on a ring, batch norm, and ReLU unless another sum comes first."""

    def __init__(self, channels: int, out_channels: int, stride: tuple[int, int] = (1, 1), relu: bool = True) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out_channels, 3, stride, padding=(1, 0), bias=False)
        self.norm = nn.BatchNorm2d(out_channels)
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.conv(F.pad(x, (1, 1, 0, 0), mode="circular")))
        return F.relu(x, inplace=True) if self.relu else x


class Residual(nn.Module):
    """relu(x + f(x)) with f of two convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = Convolution(channels, channels)
        self.second = Convolution(channels, channels, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


class Rise(nn.Module):
    """Back to a finer map: 1 x 1 to its channels, each value repeated, the finer map added, one convolution."""

    def __init__(self, channels: int, out_channels: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(channels, out_channels, 1)
        self.merge = Convolution(out_channels, out_channels)

    def forward(self, x: Tensor, finer: Tensor) -> Tensor:
        return self.merge(finer + F.interpolate(self.narrow(x), size=finer.shape[2:], mode="nearest"))


class SegmentationNetwork(nn.Module):
    """A U-Net of residual blocks: classes of every pixel of a range image, of any size, its columns a ring."""

    def __init__(self, widths: tuple[int, int, int, int] = (CHANNELS, 32, 64, 96)) -> None:
        super().__init__()
        self.stem = Convolution(INPUTS, widths[0], stride=(1, 2))
        self.down = nn.ModuleList(
            nn.Sequential(Convolution(a, b, stride=(2, 2)), Residual(b)) for a, b in pairwise(widths)
        )
        self.up = nn.ModuleList(Rise(b, a) for b, a in pairwise(widths[::-1]))
        self.head = nn.Conv2d(widths[0], 2 * len(CLASSES), 1)  # each value of the map sees two columns

    def map(self, x: Tensor) -> Tensor:
        """The map before the last layer, (B, 16, H, ceil(W / 2))."""
        maps = [self.stem(x)]
        for down in self.down:
            maps.append(down(maps[-1]))
        x = maps.pop()
        for up in self.up:
            x = up(x, maps.pop())
        return x

    def forward(self, x: Tensor) -> Tensor:
        """Scores of the classes, (B, K, H, W)."""
        pairs = self.head(self.map(x)).unflatten(1, (len(CLASSES), 2))
        return pairs.movedim(2, -1).flatten(-2)[..., : x.shape[-1]]


class Embedded(Extractor):
    """Features of range and reflectance: means of the network's last map over sectors of azimuth.

    The map before the last layer is summed over the returns of a cell and divided by its number of rays, in 2 bands of
    rows and 8 sectors of columns, so that the features also depend on lost returns and on the turn of a scan.

    Attributes:
        notes: How the weights were trained: settings, versions, accuracy on held-out scans.
    """

    name = "embedded"
    layer = f"last map, means over {BANDS} bands x {SECTORS} sectors x {CHANNELS} channels"
    dim = BANDS * SECTORS * CHANNELS
    needs_reflectance: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self.network = SegmentationNetwork()
        self.notes: dict[str, Any] = {}

    @classmethod
    def trained(cls, path: str | Path = SHIPPED) -> Self:
        """With the shipped weights, or others that benchmarks/train_extractor.py wrote.

        Raises:
            InputError: not such a file.
        """
        tensors, notes = read_safetensors(Path(path), "r2flow-extractor")
        extractor = cls().filled({f"network.{name}": tensor for name, tensor in tensors.items()})
        extractor.weights, extractor.notes = hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12], notes
        return extractor

    @torch.no_grad()
    def features(self, scans: Scans) -> Tensor:
        """(B, 256), float32: bands x sectors x channels; a row of NaN for a scan without a single return."""
        features = pooled(self.network.map(inputs(scans, self.needs_reflectance)), scans.returned)
        return nan_where_empty(features, scans)


class EmbeddedRange(Embedded):
    """The same network on range only, for scans without reflectance: another distance."""

    name = "embedded_range"
    needs_reflectance = False


def pooled(x: Tensor, returned: Tensor) -> Tensor:
    """Sum over the returns of each cell divided by its rays, (B, BANDS * SECTORS * C).

    Args:
        x: The network's map, (B, C, H, ceil(W / 2)).
        returned: (B, 1, H, W), bool.
    """
    share = F.adaptive_avg_pool2d(returned.to(x), (x.shape[2], x.shape[3]))
    return F.adaptive_avg_pool2d(x * share, (BANDS, SECTORS)).movedim(1, -1).flatten(1)
