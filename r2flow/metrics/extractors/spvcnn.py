"""SPVCNN (Tang et al., ECCV 2020), FPVD's feature network: MinkowskiNet's sparse U-Net with a second branch of points.

The published evaluation voxelises first and takes the corners of the 5 cm voxels as points. The branches meet at 0.8 m
and 0.2 m: points are averaged per voxel, and voxels are interpolated at points. Verification: see minkowski.py.
"""

import torch
from torch import Tensor, nn

from r2flow.metrics.extractors.minkowski import CLASSES, WIDTHS, MinkowskiNet
from r2flow.metrics.extractors.sparse import Sparse, VoxelGrid, offsets


class SPVCNN(MinkowskiNet):
    """FPVD's network; features are means of the point features over 16 sectors of distance."""

    name = "spvcnn"
    layer = "last features of points, mean over 16 sectors of distance"

    def __init__(self, widths: tuple[int, ...] = WIDTHS, num_classes: int = CLASSES, channels: int = 4) -> None:
        super().__init__(widths, num_classes, channels)
        c = widths
        self.point_transforms = nn.ModuleList(
            nn.Sequential(nn.Linear(before, after), nn.BatchNorm1d(after), nn.ReLU())
            for before, after in ((c[0], c[4]), (c[4], c[6]), (c[6], c[8]))
        )

    def forward(self, coords: Tensor, features: Tensor) -> Tensor:
        """Last features of points; arguments as in `MinkowskiNet.forward`."""
        x = self.stem(Sparse(features, VoxelGrid(coords)))
        points = x.features
        maps = self.down(x)
        at_16 = Corners(coords, maps[4].grid, 16)
        points = at_16.to_points(maps[4].features) + self.point_transforms[0](points)

        y = self.up(1, maps[4].with_features(at_16.to_voxels(points)), maps[3])
        y = self.up(2, y, maps[2])
        at_4 = Corners(coords, y.grid, 4)
        points = at_4.to_points(y.features) + self.point_transforms[1](points)

        y = self.up(3, y.with_features(at_4.to_voxels(points)), maps[1])
        y = self.up(4, y, maps[0])
        return y.features + self.point_transforms[2](points)


class Corners:
    """Points at `coords` (x, y, z; (N, 3) int64) in a grid of voxels that are `scale` times as large."""

    def __init__(self, coords: Tensor, grid: VoxelGrid, scale: int) -> None:
        self.num = len(grid)
        around, share = coords // scale, (coords % scale).float() / scale  # voxel, relative position within it
        self.voxels = grid.find(around)
        self.corners = []
        total = torch.zeros(len(coords), device=coords.device)
        for offset in offsets(2):
            voxel = grid.find(around + torch.tensor(offset, device=coords.device))
            ahead = torch.tensor(offset, dtype=torch.bool, device=coords.device)
            weight = torch.where(ahead, share, 1 - share).prod(1) * (voxel >= 0)
            total += weight
            self.corners.append((voxel.clamp_(min=0), weight))
        self.total = total + 1e-8

    def to_points(self, features: Tensor) -> Tensor:
        """Interpolate voxel features (M, C) at the points over the existing ones of eight corners: (N, C)."""
        out = features.new_zeros(len(self.voxels), features.shape[1])
        for voxel, weight in self.corners:
            out.addcmul_(features.index_select(0, voxel), (weight / self.total)[:, None])
        return out

    def to_voxels(self, features: Tensor) -> Tensor:
        """Average point features (N, C) per voxel: (M, C)."""
        total = features.new_zeros(self.num, features.shape[1]).index_add_(0, self.voxels, features)
        return total / torch.bincount(self.voxels, minlength=self.num)[:, None]
