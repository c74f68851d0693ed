"""Voxelisation for sparse networks, and pooling of their features."""

import torch
from torch import Tensor

VOXEL = 0.05  # metres
SECTORS = 16
NEAR, FAR = 4.0, 56.0  # metres: evenly spaced edges of distance sectors, except the first, 0


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
    key = (coords[:, 0] * size_y + coords[:, 1]) * size_z + coords[:, 2]
    voxel, of_point = key.unique(return_inverse=True)
    number = torch.arange(len(points), device=points.device)
    first = torch.full_like(voxel, len(points)).scatter_reduce_(0, of_point, number, "amin").sort().values
    return coords[first], torch.nn.functional.pad(points[first], (0, 1), value=-1.0)


def mean_by_distance(features: Tensor, coords: Tensor) -> Tensor:
    """Means over 16 sectors of distance from the centroid of the voxels, the published "depth"; (16 C,), C fastest.

    Features are (M, C). Voxels 56 m or more from the centroid are ignored; an empty sector has the mean 0.
    """
    edges = torch.linspace(NEAR, FAR, SECTORS + 1, device=coords.device)
    edges[0] = 0
    position = coords.float()
    distance = (position - position.mean(0)).norm(dim=1) * VOXEL
    sector = torch.bucketize(distance, edges, right=True) - 1
    inside = sector < SECTORS
    sector = sector[inside]
    # float64, for sums over tens of thousands of voxels.
    total = torch.zeros(SECTORS, features.shape[1], dtype=torch.float64, device=features.device)
    total.index_add_(0, sector, features[inside].double())
    count = torch.bincount(sector, minlength=SECTORS).clamp(min=1)
    return (total / count[:, None]).to(features.dtype).flatten()
