"""Sparse convolution in plain PyTorch, for inference: gather, multiply, scatter on occupied voxels.

    out(q) = sum_k W_k^T x(s q + o_k)

over the existing voxels s q + o_k, with stride s of 1 or 2 and offsets o_k. Offsets and their order are those of
torchsparse (1.4 and 2.0), so that its weights, (K, C_in, C_out), fit: see `offsets`.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Self, cast

import torch
from torch import Tensor, nn

# Indices of input and output voxels per offset; the same tensor twice for the kernel's centre.
KernelMap = list[tuple[Tensor, Tensor]]


def offsets(size: int) -> list[tuple[int, int, int]]:
    """(x, y, z) of each weight of a kernel of size^3, in torchsparse's order.

    Odd kernels are centred, with x fastest; even kernels start at the voxel, with z fastest.
    """
    if size % 2:
        along = range(-(size // 2), size // 2 + 1)
        return [(x, y, z) for z, y, x in product(along, repeat=3)]
    along = range(1 - size // 2, size // 2 + 1)
    return [(x, y, z) for x, y, z in product(along, repeat=3)]


class VoxelGrid:
    """Voxels of one size, at distinct scan, x, y, z, (N, 4) int64, and their neighbours within a kernel.

    `finer` is the grid of half the voxel size that `coarser` was called on; None for the finest.
    """

    def __init__(self, coords: Tensor, finer: Self | None = None) -> None:
        self.coords = coords
        self.finer = finer
        self.low, self.high = coords.amin(0), coords.amax(0)
        self.sizes = (self.high - self.low + 1).tolist()
        assert math.prod(self.sizes) < 2**63, self.sizes
        self.keys, self.order = self._keys(coords).sort()
        assert (self.keys.diff() > 0).all(), "voxels are distinct"

    def __len__(self) -> int:
        return len(self.coords)

    def _keys(self, coords: Tensor) -> Tensor:
        """Indices of cells in the bounding box, with the last axis fastest."""
        scan, x, y, z = (coords - self.low).unbind(-1)
        return ((scan * self.sizes[1] + x) * self.sizes[2] + y) * self.sizes[3] + z

    def find(self, coords: Tensor) -> Tensor:
        """Indices of the voxels at coordinates (..., 4); -1: no voxel."""
        key = self._keys(coords)
        position = torch.searchsorted(self.keys, key).clamp_(max=len(self) - 1)
        inside = ((coords >= self.low) & (coords <= self.high)).all(-1)
        return torch.where(inside & (self.keys[position] == key), self.order[position], -1)

    def coarser(self) -> "VoxelGrid":
        """The grid of twice the voxel size that covers this grid."""
        coords = self.coords.clone()
        coords[:, 1:] = coords[:, 1:].div(2, rounding_mode="floor")
        return VoxelGrid(coords.unique(dim=0), finer=self)

    @cached_property
    def around(self) -> KernelMap:
        """Kernel map of a kernel of 3^3 with stride 1."""
        return self._map(self, 3, 1)

    @cached_property
    def inside(self) -> KernelMap:
        """Kernel map from the finer grid: a kernel of 2^3 with stride 2."""
        assert self.finer is not None
        return self._map(self.finer, 2, 2)

    def _map(self, inputs: "VoxelGrid", size: int, stride: int) -> KernelMap:
        scaled = self.coords * torch.tensor([1, stride, stride, stride], device=self.coords.device)
        entries = []
        for offset in offsets(size):
            if inputs is self and not any(offset):
                indices = torch.arange(len(self), device=scaled.device)
                entries.append((indices, indices))
                continue
            neighbours = inputs.find(scaled + torch.tensor([0, *offset], device=scaled.device))
            outputs = (neighbours >= 0).nonzero()[:, 0]
            entries.append((neighbours[outputs], outputs))
        return entries


@dataclass(frozen=True)
class Sparse:
    """Features (N, C) of the voxels of a grid."""

    features: Tensor
    grid: VoxelGrid

    def with_features(self, features: Tensor) -> "Sparse":
        return Sparse(features, self.grid)


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
            return x.with_features(x.features @ self.kernel)
        if self.size == 3:
            return x.with_features(convolve(x.features, self.kernel, x.grid.around, len(x.grid)))
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
        if inputs is outputs:  # the kernel's centre needs no gather or scatter
            out.addmm_(features, weight)
            continue
        # An output occurs at most once per offset, so that copies add correctly and, unlike index_add_ on a GPU,
        # deterministically.
        part = torch.addmm(out.index_select(0, outputs), features.index_select(0, inputs), weight)
        out.index_copy_(0, outputs, part)
    return out


class SparseNorm(nn.BatchNorm1d):
    def forward(self, x: Sparse) -> Sparse:  # type: ignore[override]
        return x.with_features(super().forward(x.features))


class SparseReLU(nn.Module):
    def forward(self, x: Sparse) -> Sparse:
        return x.with_features(torch.relu(x.features))
