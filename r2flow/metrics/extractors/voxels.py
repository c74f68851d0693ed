"""Sparse U-Nets on voxels of 5 cm: MinkowskiNet (Choy et al. 2019), SPVCNN (Tang et al. 2020).

They are FSVD's and FPVD's feature networks. Layers, widths and parameter names follow the
evaluation of the LiDAR generative papers (LiDM, R2DM, R2Flow), which uses 2DPASS and torchsparse.
Tests compare convolutions with dense ones, the order of weights with manual results, and voxels and
pooling with values of the published evaluation. The published weights were not available: their
names, the widths below (48 follows from 768 features of 16 sectors; sizes are read from the
weights) and the features are not verified.
"""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.base.errors import InputError
from r2flow.metrics.extractors.base import Extractor, Tensors
from r2flow.metrics.extractors.sparse import (
    Sparse,
    SparseConv3d,
    SparseNorm,
    SparseReLU,
    VoxelGrid,
    offsets,
    voxel_keys,
)
from r2flow.metrics.scans import Scans

_VOXEL = 0.05  # metres
_SECTORS = 16
_ENDS = 4.0, 56.0  # metres: evenly spaced edges of distance sectors, except the first, 0
_WIDTHS = (16, 16, 32, 64, 128, 128, 64, 48, 48)  # stem, four levels down, four up


def _voxelise(points: Tensor) -> tuple[Tensor, Tensor]:
    """Occupied voxels of 5 cm of one scan's points in metres, (N, 3) float32, and their features.

    Coordinates are round(p / 0.05) minus their minimum, (M, 3) int64, in the order of the first
    point of each. Features, (M, 4), are x, y, z of that point and -1, which replaces reflectance:
    the networks were trained without. Points at the origin are ignored.
    """
    points = points[points.any(1)]
    coords = (points / _VOXEL).round().long()
    if len(points):
        coords -= coords.amin(0)
    _, first = np.unique(voxel_keys(coords).cpu().numpy(), return_index=True)
    first.sort()
    return coords[first], F.pad(points[first], (0, 1), value=-1.0)


def _mean_by_distance(features: Tensor, coords: Tensor) -> Tensor:
    """Means over 16 sectors of distance from the voxels' centroid, the published "depth".

    Features are (M, C), means (16 C,), C fastest. Voxels 56 m or more from the centroid are
    ignored; an empty sector has the mean 0.
    """
    ends = torch.linspace(*_ENDS, _SECTORS + 1, device=coords.device)[1:]
    position = coords.float()
    distance = (position - position.mean(0)).norm(dim=1) * _VOXEL
    sector = torch.bucketize(distance, ends, right=True)  # _SECTORS beyond the last end
    # float64, for sums over tens of thousands of voxels.
    x = features.double()
    total = x.new_zeros(_SECTORS + 1, x.shape[1]).index_add_(0, sector, x)
    count = torch.bincount(sector, minlength=_SECTORS + 1).clamp(min=1)
    return (total / count[:, None])[:-1].to(features.dtype).flatten()


def _step(channels: int, out: int, size: int, transposed: bool = False) -> list[nn.Module]:
    return [SparseConv3d(channels, out, size, transposed), SparseNorm(out), SparseReLU()]


def _resampled(channels: int, out: int, transposed: bool = False) -> nn.Module:
    """A step to the coarser or finer grid, named `net` as in the published weights."""
    return nn.Sequential(OrderedDict(net=nn.Sequential(*_step(channels, out, 2, transposed))))


class _Residual(nn.Module):
    """ReLU(x + f(x)), with a linear map of x where the width changes."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        convolution = SparseConv3d(out, out, 3)
        self.net = nn.Sequential(*_step(channels, out, 3), convolution, SparseNorm(out))
        self.downsample = nn.Sequential()
        if channels != out:
            self.downsample.extend([SparseConv3d(channels, out, 1), SparseNorm(out)])

    def forward(self, x: Sparse) -> Sparse:
        change = self.net(x).features
        return x._replace(features=torch.relu(change + self.downsample(x).features))


class MinkowskiNet(Extractor):
    """FSVD's network; features are means of the last map before the classifier over 16 sectors."""

    name = "minkowskinet"
    layer = "last map of voxels, mean over 16 sectors of distance"
    has_points = False  #: whether there is a second branch, of points

    def __init__(self, widths: Sequence[int] = _WIDTHS, num_classes: int = 20) -> None:
        super().__init__()
        c = widths
        self.dim = _SECTORS * c[8]
        self.stem = nn.Sequential(*_step(4, c[0], 3), *_step(c[0], c[0], 3))
        for level in range(1, 5):
            above = c[level - 1]
            width = c[level]
            blocks = [_resampled(above, above), _Residual(above, width), _Residual(width, width)]
            self.add_module(f"stage{level}", nn.Sequential(*blocks))
        for level in range(1, 5):
            width = c[4 + level]
            finer = _resampled(c[3 + level], width, True)
            residuals = [_Residual(width + c[4 - level], width), _Residual(width, width)]
            self.add_module(f"up{level}", nn.ModuleList([finer, nn.Sequential(*residuals)]))
        self.classifier = nn.Sequential(nn.Linear(c[8], num_classes))
        if self.has_points:
            self.point_transforms = nn.ModuleList()
            for before, after in ((c[0], c[4]), (c[4], c[6]), (c[6], c[8])):
                layers = (nn.Linear(before, after), nn.BatchNorm1d(after), nn.ReLU())
                self.point_transforms.append(nn.Sequential(*layers))

    def forward(self, coords: Tensor, features: Tensor) -> Tensor:
        """Last map, or last features of points, (N, 48).

        `coords` (N, 3) int64 as in `VoxelGrid`, `features` (N, 4): x, y, z in metres and -1.
        """
        maps = [self.stem(Sparse(features, VoxelGrid(coords)))]
        for level in range(1, 5):
            maps.append(self.get_submodule(f"stage{level}")(maps[-1]))
        points = maps[0].features
        y = maps[4]
        for level in range(1, 5):
            if self.has_points and level in (1, 3):
                transformed = self.point_transforms[level // 2](points)
                points, y = _exchange(transformed, coords, y, 2 ** (5 - level))
            y = self.get_submodule(f"up{level}.0")(y)
            both = torch.cat([y.features, maps[4 - level].features], 1)
            y = self.get_submodule(f"up{level}.1")(y._replace(features=both))
        if self.has_points:
            return y.features + self.point_transforms[2](points)
        return y.features

    @torch.inference_mode()
    def features(self, scans: Scans) -> Tensor:
        # One scan at a time, since a batch is no faster and needs more memory.
        means = torch.full((len(scans), self.dim), torch.nan, device=self.device)
        for row, points in zip(means, scans.points, strict=True):
            if len(points):
                coords, features = _voxelise(points.to(self.device))
                row[:] = _mean_by_distance(self(coords, features), coords)
        return means

    @classmethod
    def from_tensors(cls, tensors: Tensors) -> Self:
        levels = ["stem.0"]
        levels += [f"stage{level}.1.net.0" for level in range(1, 5)]
        levels += [f"up{level}.0.net.0" for level in range(1, 5)]
        try:
            widths = [tensors[f"{level}.kernel"].shape[2] for level in levels]
            extractor = cls(widths, len(tensors["classifier.0.bias"]))
        except (KeyError, IndexError):
            raise InputError(f"not the weights of {cls.name}: other parameters.") from None
        # Files saved in training may also hold parameters of the loss.
        modules = dict(extractor.named_children())
        known = {name: tensor for name, tensor in tensors.items() if name.split(".")[0] in modules}
        return extractor.filled(known)


class SPVCNN(MinkowskiNet):
    """FPVD's network, with a second branch of points, whose means over 16 sectors are the features.

    The published evaluation voxelises first and takes the corners of the 5 cm voxels as points. The
    branches meet at 0.8 m and 0.2 m: points are averaged per voxel, and voxels are interpolated at
    points.
    """

    name = "spvcnn"
    layer = "last features of points, mean over 16 sectors of distance"
    has_points = True


def _exchange(points: Tensor, coords: Tensor, voxels: Sparse, scale: int) -> tuple[Tensor, Sparse]:
    """Add voxel features at the points to those of points, and average the sums per voxel.

    Points at `coords` (N, 3) int64 have features (N, C); voxels are `scale` times as large. Voxel
    features are interpolated over the existing ones of eight corners.
    """
    grid = voxels.grid
    home = coords // scale
    share = (coords % scale)[:, None] / scale  # relative position within the voxel
    steps = coords.new_tensor(offsets(2))  # (8, 3)
    corners = grid.find(home[:, None] + steps)
    weights = torch.where(steps > 0, share, 1 - share).prod(2) * (corners >= 0)
    weights = (weights / (weights.sum(1, keepdim=True) + 1e-8)).to(points)
    points = points + F.embedding_bag(
        corners.clamp(min=0), voxels.features, mode="sum", per_sample_weights=weights
    )
    index = grid.find(home)
    total = points.new_zeros(len(grid), points.shape[1]).index_add_(0, index, points)
    return points, Sparse(total / torch.bincount(index, minlength=len(grid))[:, None], grid)
