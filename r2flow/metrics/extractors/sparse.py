"""Sparse convolution in plain PyTorch, for inference: gather, multiply, scatter on occupied voxels.

    out(q) = sum_k W_k^T x(s q + o_k)

over the existing voxels s q + o_k, with stride s of 1 or 2 and offsets o_k. Offsets and their order
are those of torchsparse (1.4 and 2.0), so that its weights, (K, C_in, C_out), fit: see `offsets`.
"""

from functools import cached_property
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor, nn

# Indices of input and output voxels per offset.
_KernelMap = list[tuple[Tensor, Tensor]]


def offsets(size: int) -> list[tuple[int, int, int]]:
    """(x, y, z) of each weight of a kernel of size^3, in torchsparse's order.

    Odd kernels are centred, with x fastest; even kernels start at the voxel, with z fastest.
    """
    cells = product(range(-((size - 1) // 2), size // 2 + 1), repeat=3)
    return [(c, b, a) if size % 2 else (a, b, c) for a, b, c in cells]


def voxel_keys(coords: Tensor) -> Tensor:
    """A number for each voxel, ordered by x, y, z; coordinates (..., 3) int64 of -1 to 2^20 - 2."""
    return ((coords + 1) * coords.new_tensor([2**40, 2**20, 1])).sum(-1)


class VoxelGrid:
    """Voxels of one size, at distinct x, y, z of at least 0, (N, 3) int64.

    `finer` is the grid of half the voxel size that `coarser` was called on; None for the finest.
    """

    def __init__(self, coords: Tensor, finer: "VoxelGrid | None" = None) -> None:
        self.coords = coords
        self.finer = finer
        self._keys, self._order = voxel_keys(coords).sort()

    def __len__(self) -> int:
        return len(self.coords)

    def find(self, coords: Tensor) -> Tensor:
        """Indices of the voxels at coordinates (..., 3); -1: no voxel."""
        key = voxel_keys(coords)
        position = torch.searchsorted(self._keys, key).clamp_(max=len(self) - 1)
        return torch.where(self._keys[position] == key, self._order[position], -1)

    def coarser(self) -> "VoxelGrid":
        """The grid of twice the voxel size that covers this grid."""
        return VoxelGrid((self.coords // 2).unique(dim=0), finer=self)

    @cached_property
    def around(self) -> _KernelMap:
        """Kernel map of a kernel of 3^3 with stride 1."""
        return self._pairs(self, self.coords, 3)

    @cached_property
    def inside(self) -> _KernelMap:
        """Kernel map from the finer grid: a kernel of 2^3 with stride 2."""
        assert self.finer is not None
        return self._pairs(self.finer, self.coords * 2, 2)

    @staticmethod
    def _pairs(inputs: "VoxelGrid", places: Tensor, size: int) -> _KernelMap:
        """Voxels of `inputs` at each offset from the output voxels' places, which both exist."""
        pairs = []
        for offset in offsets(size):
            found = inputs.find(places + places.new_tensor(offset))
            present = (found >= 0).nonzero()[:, 0]
            pairs.append((found[present], present))
        return pairs


class Sparse(NamedTuple):
    """Features (N, C) of the voxels of a grid."""

    features: Tensor
    grid: VoxelGrid


class SparseConv3d(nn.Module):
    """A sparse convolution without bias, with a kernel of `size` voxels along each axis.

    A kernel of 1 is a linear map, and one of 3 keeps the voxels, too. A kernel of 2 has stride 2,
    which doubles their size; transposed, it returns to the finer voxels by the inverse map.
    """

    def __init__(self, channels: int, out: int, size: int, transposed: bool = False) -> None:
        super().__init__()
        self.size = size
        self.transposed = transposed
        shape = (channels, out) if size == 1 else (size**3, channels, out)
        bound = (channels * size**3) ** -0.5
        self.kernel = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))

    def forward(self, x: Sparse) -> Sparse:
        if self.size == 1:
            return x._replace(features=x.features @ self.kernel)
        grid = x.grid
        if self.size == 3:
            pairs = grid.around
        elif self.transposed and grid.finer is not None:
            pairs = [(outputs, inputs) for inputs, outputs in grid.inside]
            grid = grid.finer
        else:
            grid = grid.coarser()
            pairs = grid.inside
        out = x.features.new_zeros(len(grid), self.kernel.shape[2])
        for weight, (inputs, outputs) in zip(self.kernel, pairs, strict=True):
            # An output occurs at most once per offset, so that copies add correctly and, unlike
            # index_add_ on a GPU, deterministically.
            out[outputs] = torch.addmm(out[outputs], x.features[inputs], weight)
        return Sparse(out, grid)


class SparseNorm(nn.BatchNorm1d):
    """Batch normalisation of features."""

    def forward(self, x: Sparse) -> Sparse:  # type: ignore[override]
        return x._replace(features=super().forward(x.features))


class SparseReLU(nn.Module):
    """ReLU of features."""

    def forward(self, x: Sparse) -> Sparse:
        return x._replace(features=torch.relu(x.features))
