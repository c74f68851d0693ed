"""Sparse convolution in plain PyTorch, for inference: gather, multiply, scatter on occupied voxels.

    out(q) = sum_k W_k^T x(s q + o_k)

over the existing voxels s q + o_k, with stride s of 1 or 2 and offsets o_k. Offsets and their order are those of
torchsparse (1.4 and 2.0), so that its weights, (K, C_in, C_out), fit: see `offsets`.
"""

import math
from functools import cached_property
from itertools import product
from typing import NamedTuple, Self, cast

import torch
from torch import Tensor, nn

# Indices of input and output voxels per offset.
KernelMap = list[tuple[Tensor, Tensor]]


def offsets(size: int) -> list[tuple[int, int, int]]:
    """(x, y, z) of each weight of a kernel of size^3, in torchsparse's order.

    Odd kernels are centred, with x fastest; even kernels start at the voxel, with z fastest.
    """
    cells = product(range(-((size - 1) // 2), size // 2 + 1), repeat=3)
    return [(c, b, a) if size % 2 else (a, b, c) for a, b, c in cells]


class VoxelGrid:
    """Voxels of one size, at distinct x, y, z of at least 0, (N, 3) int64, and their neighbours within a kernel.

    `finer` is the grid of half the voxel size that `coarser` was called on; None for the finest.
    """

    def __init__(self, coords: Tensor, finer: Self | None = None) -> None:
        self.coords, self.finer = coords, finer
        self.sizes = (coords.amax(0) + 2).tolist()  # a free cell between rows, before the first and after the last
        assert math.prod(self.sizes) < 2**63, self.sizes
        self.keys, self.order = self._keys(coords).sort()
        assert (self.keys.diff() > 0).all(), "voxels are distinct"

    def __len__(self) -> int:
        return len(self.coords)

    def _keys(self, coords: Tensor) -> Tensor:
        """Indices of cells in the bounding box and its free cells, with the last axis fastest."""
        x, y, z = (coords + 1).unbind(-1)
        return (x * self.sizes[1] + y) * self.sizes[2] + z

    def find(self, coords: Tensor) -> Tensor:
        """Indices of the voxels at coordinates (N, 3), at most one cell outside the bounding box; -1: no voxel."""
        key = self._keys(coords)
        position = torch.searchsorted(self.keys, key).clamp_(max=len(self) - 1)
        return torch.where(self.keys[position] == key, self.order[position], -1)

    def coarser(self) -> "VoxelGrid":
        """The grid of twice the voxel size that covers this grid."""
        return VoxelGrid((self.coords // 2).unique(dim=0), finer=self)

    @cached_property
    def around(self) -> KernelMap:
        """Kernel map of a kernel of 3^3 with stride 1."""
        return kernel_map(self, self, 3)

    @cached_property
    def inside(self) -> KernelMap:
        """Kernel map from the finer grid: a kernel of 2^3 with stride 2."""
        assert self.finer is not None
        return kernel_map(self.finer, self, 2)


def kernel_map(inputs: VoxelGrid, outputs: VoxelGrid, size: int) -> KernelMap:
    """Neighbours of output voxels among input voxels, which are equal, or half as large for stride 2."""
    corner = outputs.coords * (1 if inputs is outputs else 2)
    entries = []
    for offset in offsets(size):
        neighbours = inputs.find(corner + torch.tensor(offset, device=corner.device))
        present = (neighbours >= 0).nonzero()[:, 0]
        entries.append((neighbours[present], present))
    return entries


class Sparse(NamedTuple):
    """Features (N, C) of the voxels of a grid."""

    features: Tensor
    grid: VoxelGrid


class SparseConv3d(nn.Module):
    """A sparse convolution without bias, with a kernel of `size` voxels along each axis.

    A kernel of 1 is a linear map, and one of 3 keeps the voxels, too. A kernel of 2 has stride 2, which doubles their
    size; transposed, it returns to the finer voxels by the inverse map.
    """

    def __init__(self, channels: int, out: int, size: int, transposed: bool = False) -> None:
        super().__init__()
        assert size in ((2,) if transposed else (1, 2, 3))
        self.size, self.transposed = size, transposed
        shape = (channels, out) if size == 1 else (size**3, channels, out)
        bound = ((out if transposed else channels) * size**3) ** -0.5
        self.kernel = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))

    def forward(self, x: Sparse) -> Sparse:
        if self.size == 1:
            return x._replace(features=x.features @ self.kernel)
        if self.size == 3:
            return x._replace(features=convolve(x.features, self.kernel, x.grid.around, len(x.grid)))
        if self.transposed:
            reverse = [(outputs, inputs) for inputs, outputs in x.grid.inside]
            finer = cast(VoxelGrid, x.grid.finer)
            return Sparse(convolve(x.features, self.kernel, reverse, len(finer)), finer)
        coarser = x.grid.coarser()
        return Sparse(convolve(x.features, self.kernel, coarser.inside, len(coarser)), coarser)


def convolve(features: Tensor, kernel: Tensor, where: KernelMap, num: int) -> Tensor:
    """Convolve features (N, C_in) with weights (K, C_in, C_out) onto `num` voxels, (num, C_out)."""
    out = features.new_zeros(num, kernel.shape[2])
    for weight, (inputs, outputs) in zip(kernel, where, strict=True):
        # An output occurs at most once per offset, so that copies add correctly and, unlike index_add_ on a GPU,
        # deterministically.
        part = torch.addmm(out.index_select(0, outputs), features.index_select(0, inputs), weight)
        out.index_copy_(0, outputs, part)
    return out


class SparseNorm(nn.BatchNorm1d):
    def forward(self, x: Sparse) -> Sparse:  # type: ignore[override]
        return x._replace(features=super().forward(x.features))


class SparseReLU(nn.Module):
    def forward(self, x: Sparse) -> Sparse:
        return x._replace(features=torch.relu(x.features))
