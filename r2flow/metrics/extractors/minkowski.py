"""MinkowskiNet (Choy et al., CVPR 2019), a sparse U-Net on voxels of 5 cm: FSVD's feature network.

Layers, widths and parameter names follow the evaluation of the LiDAR generative papers (LiDM, R2DM, R2Flow), which uses
2DPASS and torchsparse. Tests compare convolutions with dense ones, the order of weights with manual results, and voxels
and pooling with values of the published evaluation. The published weights were not available: their names, the widths
below (48 follows from 768 features of 16 sectors; sizes are read from the weights) and the features are not verified.
"""

from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.extractors.sparse import Sparse, SparseConv3d, SparseNorm, SparseReLU, VoxelGrid
from r2flow.metrics.extractors.voxels import SECTORS, mean_by_distance, voxelise
from r2flow.metrics.scans import Scans

WIDTHS = (16, 16, 32, 64, 128, 128, 64, 48, 48)  # stem, four levels down, four up
CLASSES = 20


def _step(channels: int, out: int, size: int, transposed: bool = False) -> list[nn.Module]:
    return [SparseConv3d(channels, out, size, transposed), SparseNorm(out), SparseReLU()]


class Block(nn.Module):
    """Convolution, normalisation, ReLU."""

    def __init__(self, channels: int, out: int, transposed: bool = False) -> None:
        super().__init__()
        self.net = nn.Sequential(*_step(channels, out, 2, transposed))

    def forward(self, x: Sparse) -> Sparse:
        return self.net(x)


class Residual(nn.Module):
    """ReLU(x + f(x)), with a linear map of x where the width changes."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.net = nn.Sequential(*_step(channels, out, 3), SparseConv3d(out, out, 3), SparseNorm(out))
        change = [SparseConv3d(channels, out, 1), SparseNorm(out)] if channels != out else []
        self.downsample = nn.Sequential(*change)

    def forward(self, x: Sparse) -> Sparse:
        return x.with_features(torch.relu(self.net(x).features + self.downsample(x).features))


class MinkowskiNet(Extractor):
    """FSVD's network; features are means of the last map before the classifier over 16 sectors of distance."""

    name = "minkowskinet"
    layer = "last map of voxels, mean over 16 sectors of distance"

    def __init__(self, widths: tuple[int, ...] = WIDTHS, num_classes: int = CLASSES, channels: int = 4) -> None:
        super().__init__()
        c = widths
        self.dim = SECTORS * c[8]
        self.stem = nn.Sequential(*_step(channels, c[0], 3), *_step(c[0], c[0], 3))
        for level in range(1, 5):
            down = nn.Sequential(
                Block(c[level - 1], c[level - 1]), Residual(c[level - 1], c[level]), Residual(c[level], c[level])
            )
            self.add_module(f"stage{level}", down)
        for level in range(1, 5):
            width, skip = c[4 + level], c[4 - level]
            blocks = nn.Sequential(Residual(width + skip, width), Residual(width, width))
            self.add_module(f"up{level}", nn.ModuleList([Block(c[3 + level], width, transposed=True), blocks]))
        self.classifier = nn.Sequential(nn.Linear(c[8], num_classes))

    def down(self, x: Sparse) -> list[Sparse]:
        """The stem's map x and the maps of the four levels below."""
        maps = [x]
        for level in range(1, 5):
            maps.append(self.get_submodule(f"stage{level}")(maps[-1]))
        return maps

    def up(self, level: int, x: Sparse, skip: Sparse) -> Sparse:
        """One level up, concatenated with the skip map of that level."""
        x = self.get_submodule(f"up{level}.0")(x)
        return self.get_submodule(f"up{level}.1")(x.with_features(torch.cat([x.features, skip.features], 1)))

    def forward(self, coords: Tensor, features: Tensor) -> Tensor:
        """Last map, (N, 48); `coords` (N, 3) int64 as in `VoxelGrid`, `features` (N, 4): x, y, z in metres and -1."""
        maps = self.down(self.stem(Sparse(features, VoxelGrid(coords))))
        y = maps[4]
        for level in range(1, 5):
            y = self.up(level, y, maps[4 - level])
        return y.features

    @torch.inference_mode()
    def features(self, scans: Scans) -> Tensor:
        # One scan at a time, since a batch is no faster and needs more memory.
        return torch.stack([self._scan(points.to(self.device)) for points in scans.points])

    def _scan(self, points: Tensor) -> Tensor:
        if not len(points):
            return torch.full((self.dim,), torch.nan, device=self.device)
        coords, features = voxelise(points)
        return mean_by_distance(self(coords, features), coords)

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Self:
        try:
            stem = tensors["stem.0.kernel"]
            down = [tensors[f"stage{level}.1.net.0.kernel"].shape[2] for level in range(1, 5)]
            up = [tensors[f"up{level}.0.net.0.kernel"].shape[2] for level in range(1, 5)]
            extractor = cls((stem.shape[2], *down, *up), len(tensors["classifier.0.bias"]), stem.shape[1])
        except (KeyError, IndexError):
            raise InputError(f"not the weights of {cls.name}: other parameters.") from None
        # Files saved in training may also hold parameters of the loss.
        modules = {name for name, _ in extractor.named_children()}
        return extractor.filled({name: tensor for name, tensor in tensors.items() if name.split(".")[0] in modules})
