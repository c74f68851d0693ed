"""SPVCNN (Tang et al., ECCV 2020), FPVD's feature network: MinkowskiNet's sparse U-Net with a second branch of points.

The published evaluation voxelises first and takes the corners of the voxels as points, so that points and voxels of
5 cm are the same. At 0.8 m and at 0.2 m, where the branches meet, points are averaged in a voxel and voxels
interpolated to a point. What is checked and what is not: see minkowski.py.
"""

import torch
from torch import Tensor, nn

from r2flow.metrics.extractors.minkowski import CLASSES, WIDTHS, MinkowskiNet
from r2flow.metrics.extractors.sparse import Sparse, VoxelGrid, offsets


class SPVCNN(MinkowskiNet):
    """FPVD's network; its features are the means of the points' over 16 sectors of distance."""

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
        """The points' last features: as MinkowskiNet's `forward`."""
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
    """Points at scan, x, y, z, (N, 4) int64, among voxels `scale` times as large, with one around each point."""

    def __init__(self, coords: Tensor, grid: VoxelGrid, scale: int) -> None:
        self.num = len(grid)
        around = coords.clone()
        around[:, 1:] = coords[:, 1:].div(scale, rounding_mode="floor")
        share = (coords[:, 1:] - around[:, 1:] * scale).float() / scale  # of the way to the next voxel
        self.own = grid.find(around)
        self.corners = []
        total = torch.zeros(len(coords), device=coords.device)
        for offset in offsets(2):
            voxel = grid.find(around + torch.tensor([0, *offset], device=coords.device))
            ahead = torch.tensor(offset, dtype=torch.bool, device=coords.device)
            weight = torch.where(ahead, share, 1 - share).prod(1) * (voxel >= 0)
            total += weight
            self.corners.append((voxel.clamp_(min=0), weight))
        self.total = total + 1e-8

    def to_points(self, features: Tensor) -> Tensor:
        """Features (M, C) of the voxels, interpolated between the eight around each point that exist: (N, C)."""
        out = features.new_zeros(len(self.own), features.shape[1])
        for voxel, weight in self.corners:
            out.addcmul_(features.index_select(0, voxel), (weight / self.total)[:, None])
        return out

    def to_voxels(self, features: Tensor) -> Tensor:
        """Features (N, C) of the points, their mean in each voxel: (M, C)."""
        total = features.new_zeros(self.num, features.shape[1]).index_add_(0, self.own, features)
        return total / torch.bincount(self.own, minlength=self.num)[:, None]
