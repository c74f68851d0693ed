"""Sparse U-Nets on voxels of 5 cm: MinkowskiNet (Choy et al., CVPR 2019) and SPVCNN (Tang et al., ECCV 2020).

They are FSVD's and FPVD's feature networks. Layers, widths and parameter names follow the evaluation of the LiDAR
generative papers (LiDM, R2DM, R2Flow), which uses 2DPASS and torchsparse. Tests compare convolutions with dense ones,
the order of weights with manual results, and voxels and pooling with values of the published evaluation. The published
weights were not available: their names, the widths below (48 follows from 768 features of 16 sectors; sizes are read
from the weights) and the features are not verified.
"""

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.extractors.sparse import Sparse, SparseConv3d, SparseNorm, SparseReLU, VoxelGrid, offsets
from r2flow.metrics.scans import Scans

VOXEL = 0.05  # metres
SECTORS = 16
NEAR, FAR = 4.0, 56.0  # metres: evenly spaced edges of distance sectors, except the first, 0
WIDTHS = (16, 16, 32, 64, 128, 128, 64, 48, 48)  # stem, four levels down, four up
CLASSES = 20


def voxelise(points: Tensor) -> tuple[Tensor, Tensor]:
    """Occupied voxels of 5 cm, and the first point of each, of one scan's points in metres, (N, 3) float32.

    Coordinates are round(p / 0.05) minus their minimum, (M, 3) int64, in the order of points. Features, (M, 4), are x,
    y, z and -1, which replaces reflectance: the networks were trained without. Points at the origin are ignored.
    """
    points = points[points.norm(dim=1) > 0]
    if not len(points):
        return points.new_zeros(0, 3, dtype=torch.int64), points.new_zeros(0, 4)
    coords = (points / VOXEL).round().long()
    coords = coords - coords.amin(0)
    _, size_y, size_z = (coords.amax(0) + 1).tolist()
    key = (coords[:, 0] * size_y + coords[:, 1]) * size_z + coords[:, 2]  # 25 times as fast as unique(dim=0)
    voxel, of_point = key.unique(return_inverse=True)
    number = torch.arange(len(points), device=points.device)
    first = torch.full_like(voxel, len(points)).scatter_reduce_(0, of_point, number, "amin").sort().values
    return coords[first], F.pad(points[first], (0, 1), value=-1.0)


def mean_by_distance(features: Tensor, coords: Tensor) -> Tensor:
    """Means over 16 sectors of distance from the centroid of the voxels, the published "depth"; (16 C,), C fastest.

    Features are (M, C). Voxels 56 m or more from the centroid are ignored; an empty sector has the mean 0.
    """
    ends = torch.linspace(NEAR, FAR, SECTORS + 1, device=coords.device)[1:]
    position = coords.float()
    distance = (position - position.mean(0)).norm(dim=1) * VOXEL
    sector = torch.bucketize(distance, ends, right=True)  # SECTORS beyond the last end
    # float64, for sums over tens of thousands of voxels.
    total = torch.zeros(SECTORS + 1, features.shape[1], dtype=torch.float64, device=features.device)
    total.index_add_(0, sector, features.double())
    count = torch.bincount(sector, minlength=SECTORS + 1).clamp(min=1)
    return (total / count[:, None])[:-1].to(features.dtype).flatten()


def _step(channels: int, out: int, size: int, transposed: bool = False) -> list[nn.Module]:
    return [SparseConv3d(channels, out, size, transposed), SparseNorm(out), SparseReLU()]


def _resampled(channels: int, out: int, transposed: bool = False) -> nn.Module:
    """A step to the coarser or finer grid, named `net` as in the published weights."""
    return nn.Sequential(OrderedDict(net=nn.Sequential(*_step(channels, out, 2, transposed))))


class Residual(nn.Module):
    """ReLU(x + f(x)), with a linear map of x where the width changes."""

    def __init__(self, channels: int, out: int) -> None:
        super().__init__()
        self.net = nn.Sequential(*_step(channels, out, 3), SparseConv3d(out, out, 3), SparseNorm(out))
        change = [SparseConv3d(channels, out, 1), SparseNorm(out)] if channels != out else []
        self.downsample = nn.Sequential(*change)

    def forward(self, x: Sparse) -> Sparse:
        return x._replace(features=torch.relu(self.net(x).features + self.downsample(x).features))


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
                _resampled(c[level - 1], c[level - 1]), Residual(c[level - 1], c[level]), Residual(c[level], c[level])
            )
            self.add_module(f"stage{level}", down)
        for level in range(1, 5):
            width, skip = c[4 + level], c[4 - level]
            blocks = nn.Sequential(Residual(width + skip, width), Residual(width, width))
            self.add_module(f"up{level}", nn.ModuleList([_resampled(c[3 + level], width, True), blocks]))
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
        return self.get_submodule(f"up{level}.1")(x._replace(features=torch.cat([x.features, skip.features], 1)))

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
        means = torch.full((len(scans), self.dim), torch.nan, device=self.device)
        for row, points in zip(means, scans.points, strict=True):
            if len(points):
                coords, features = voxelise(points.to(self.device))
                row[:] = mean_by_distance(self(coords, features), coords)
        return means

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


class SPVCNN(MinkowskiNet):
    """FPVD's network, with a second branch of points; features are means of theirs over 16 sectors of distance.

    The published evaluation voxelises first and takes the corners of the 5 cm voxels as points. The branches meet at
    0.8 m and 0.2 m: points are averaged per voxel, and voxels are interpolated at points.
    """

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

        y = self.up(1, maps[4]._replace(features=at_16.to_voxels(points)), maps[3])
        y = self.up(2, y, maps[2])
        at_4 = Corners(coords, y.grid, 4)
        points = at_4.to_points(y.features) + self.point_transforms[1](points)

        y = self.up(3, y._replace(features=at_4.to_voxels(points)), maps[1])
        return self.up(4, y, maps[0]).features + self.point_transforms[2](points)


class Corners:
    """Points at `coords` (x, y, z; (N, 3) int64) in a grid of voxels that are `scale` times as large."""

    def __init__(self, coords: Tensor, grid: VoxelGrid, scale: int) -> None:
        self.num = len(grid)
        around, share = coords // scale, (coords % scale).float() / scale  # voxel, relative position within it
        self.voxels = grid.find(around)
        corners = coords.new_tensor(offsets(2))  # (8, 3)
        found = grid.find(around[:, None] + corners)
        weights = torch.where(corners > 0, share[:, None], 1 - share[:, None]).prod(2) * (found >= 0)
        self.corners, self.weights = found.clamp_(min=0), weights / (weights.sum(1, keepdim=True) + 1e-8)

    def to_points(self, features: Tensor) -> Tensor:
        """Interpolate voxel features (M, C) at the points over the existing ones of eight corners: (N, C)."""
        return F.embedding_bag(self.corners, features, mode="sum", per_sample_weights=self.weights.to(features))

    def to_voxels(self, features: Tensor) -> Tensor:
        """Average point features (N, C) per voxel: (M, C)."""
        total = features.new_zeros(self.num, features.shape[1]).index_add_(0, self.voxels, features)
        return total / torch.bincount(self.voxels, minlength=self.num)[:, None]
