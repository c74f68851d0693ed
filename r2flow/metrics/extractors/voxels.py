"""The voxels that the sparse networks take, and the pooling of the features that they give."""

import torch
from torch import Tensor

VOXEL = 0.05  # metres
SECTORS = 16
NEAR, FAR = 4.0, 56.0  # metres, between which the edges of the distance sectors are spread evenly; the first is 0


def voxelise(points: Tensor) -> tuple[Tensor, Tensor]:
    """Voxels of 5 cm that hold a point, and the first point of each.

    Args:
        points: Points of one scan in metres, (N, 3), float32; the origin stands for no point.

    Returns:
        Coordinates round(p / 0.05) less their minimum, (M, 3), int64, in the order of the points; and features
        (x, y, z, -1), (M, 4), where -1 stands for the reflectance that the networks were trained without.
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

    A voxel 56 m or farther from the centroid counts in none; a sector without voxels has the mean 0.

    Args:
        features: Of each voxel, (M, C).
        coords: Their integer coordinates, (M, 3).
    """
    edges = torch.linspace(NEAR, FAR, SECTORS + 1, device=coords.device)
    edges[0] = 0
    position = coords.float()
    distance = (position - position.mean(0)).norm(dim=1) * VOXEL
    sector = torch.bucketize(distance, edges, right=True) - 1
    inside = sector < SECTORS
    sector = sector[inside]
    # float64: tens of thousands of voxels in one sum.
    total = torch.zeros(SECTORS, features.shape[1], dtype=torch.float64, device=features.device)
    total.index_add_(0, sector, features[inside].double())
    count = torch.bincount(sector, minlength=SECTORS).clamp(min=1)
    return (total / count[:, None]).to(features.dtype).flatten()
