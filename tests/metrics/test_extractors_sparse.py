import torch
from torch import nn
from torch.nn import functional as F

from r2flow.metrics.extractors.sparse import SparseConv3d
from r2flow.metrics.extractors.voxels import SPVCNN, MinkowskiNet


def occupied(size: int, share: float) -> tuple[torch.Tensor, ...]:
    """Voxels of a random cube in a random order, (N, 3), and whether each place is one, (1, 1,
    size^3).
    """
    mask = torch.rand(size, size, size) < share
    coords = mask.nonzero()
    return coords[torch.randperm(len(coords))], mask[None, None].double()


def to_dense(features: torch.Tensor, coords: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    dense = features.new_zeros(1, features.shape[1], *shape[2:])
    x, y, z = coords.T
    dense[0, :, x, y, z] = features.T
    return dense


def at(dense: torch.Tensor, coords: torch.Tensor) -> torch.Tensor:
    x, y, z = coords.T
    return dense[0, :, x, y, z].T


class Dense:
    """The sparse U-Nets once more, on dense cubes: everything outside the voxels is put to 0 after
    each layer.
    """

    def __init__(self, network: MinkowskiNet, coords: torch.Tensor, mask: torch.Tensor) -> None:
        self.network, self.coords = network, coords
        self.masks = [F.max_pool3d(mask, 2**level) if level else mask for level in range(5)]

    def steps(self, modules: nn.Sequential, x: torch.Tensor, level: int) -> torch.Tensor:
        for module in modules:
            if isinstance(module, SparseConv3d) and module.size == 1:
                x = torch.einsum("bcxyz,co->boxyz", x, module.kernel)
            elif isinstance(module, SparseConv3d):
                # (C_out, C_in, x, y, z) of (K, C_in, C_out): torchsparse counts x fastest in odd
                # kernels, z in even
                cube = module.kernel.view(*[module.size] * 3, *module.kernel.shape[1:])
                weight = cube.permute((4, 3, 2, 1, 0) if module.size % 2 else (4, 3, 0, 1, 2))
                if module.transposed:
                    x = F.conv_transpose3d(x, weight.transpose(0, 1), stride=2)
                else:
                    x = F.conv3d(
                        x,
                        weight,
                        stride=2 if module.size == 2 else 1,
                        padding=1 if module.size == 3 else 0,
                    )
            elif isinstance(module, nn.BatchNorm1d):
                parameters = (module.running_mean, module.running_var, module.weight, module.bias)
                x = F.batch_norm(x, *parameters, eps=module.eps)
            else:
                x = x.relu()
            x = x * self.masks[level]
        return x

    def residuals(self, blocks: list[nn.Module], x: torch.Tensor, level: int) -> torch.Tensor:
        for block in blocks:
            x = (self.steps(block.net, x, level) + self.steps(block.downsample, x, level)).relu()
        return x

    def down(self, x: torch.Tensor) -> list[torch.Tensor]:
        maps = [self.steps(self.network.stem, x, 0)]
        for level in range(1, 5):
            change, *blocks = self.network.get_submodule(f"stage{level}")
            maps.append(self.residuals(blocks, self.steps(change.net, maps[-1], level), level))
        return maps

    def up(self, number: int, x: torch.Tensor, kept: torch.Tensor) -> torch.Tensor:
        change, blocks = self.network.get_submodule(f"up{number}")
        x = self.steps(change.net, x, 4 - number)
        return self.residuals(list(blocks), torch.cat([x, kept], 1), 4 - number)

    def _to_points(self, x: torch.Tensor, level: int) -> torch.Tensor:
        """The eight voxels from a point's own on, by the share of the way to each, as far as they
        exist.
        """
        mask = self.masks[level]
        grid = 2 * self.coords.flip(1) / 2**level / (mask.shape[2] - 1) - 1  # -1 to 1, z first
        held = torch.cat([x, mask], 1)
        there = F.grid_sample(held, grid[None, None, None].double(), align_corners=True)[
            0, :, 0, 0
        ].T
        return there[:, :-1] / there[:, -1:]

    def _to_voxels(self, points: torch.Tensor, level: int) -> torch.Tensor:
        held = to_dense(points, self.coords, self.masks[0].shape)
        size = 2**level
        return F.avg_pool3d(held, size) / F.avg_pool3d(self.masks[0], size).clamp(min=1e-9)


def randomised(network: MinkowskiNet) -> MinkowskiNet:
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    return network.double().eval().requires_grad_(False)


def test_minkowskinet_is_its_dense_self():
    coords, mask = occupied(16, 0.02)
    x = torch.randn(len(coords), 4, dtype=torch.float64)
    network = randomised(MinkowskiNet((3, 3, 4, 5, 6, 6, 5, 4, 3)))
    dense = Dense(network, coords, mask)
    maps = dense.down(to_dense(x, coords, mask.shape))
    y = maps[4]
    for number in range(1, 5):
        y = dense.up(number, y, maps[4 - number])
    torch.testing.assert_close(network(coords, x), at(y, coords), rtol=0, atol=1e-11)


def test_spvcnn_is_its_dense_self():
    coords, mask = occupied(32, 0.003)
    x = torch.randn(len(coords), 4, dtype=torch.float64)
    network = randomised(SPVCNN((3, 3, 4, 5, 6, 6, 5, 4, 3)))
    dense = Dense(network, coords, mask)
    maps = dense.down(to_dense(x, coords, mask.shape))
    points = dense._to_points(maps[4], 4) + network.point_transforms[0](at(maps[0], coords))
    y = dense.up(1, dense._to_voxels(points, 4), maps[3])
    y = dense.up(2, y, maps[2])
    points = dense._to_points(y, 2) + network.point_transforms[1](points)
    y = dense.up(3, dense._to_voxels(points, 2), maps[1])
    y = dense.up(4, y, maps[0])
    expected = at(y, coords) + network.point_transforms[2](points)
    # 1e-8 is added to the sum of the eight weights, as torchsparse does, and weights are float32
    # there.
    torch.testing.assert_close(network(coords, x), expected, rtol=0, atol=1e-6)


def test_parameters_have_torchsparse_s_names_and_shapes():
    # As 2DPASS's MinkowskiNet and SPVCNN name them, with torchsparse's kernels.
    shapes = {name: tuple(value.shape) for name, value in SPVCNN().state_dict().items()}
    for name, shape in {
        "stem.0.kernel": (27, 4, 16),
        "stem.3.kernel": (27, 16, 16),
        "stage1.0.net.0.kernel": (8, 16, 16),
        "stage2.1.net.0.kernel": (27, 16, 32),
        "stage2.1.downsample.0.kernel": (16, 32),
        "stage4.2.net.4.running_var": (128,),
        "up1.0.net.0.kernel": (8, 128, 128),
        "up1.1.0.net.0.kernel": (27, 128 + 64, 128),
        "up4.1.0.downsample.0.kernel": (48 + 16, 48),
        "up4.1.1.net.3.kernel": (27, 48, 48),
        "point_transforms.2.0.weight": (48, 64),
        "point_transforms.0.1.running_mean": (128,),
        "classifier.0.weight": (20, 48),
    }.items():
        assert shapes[name] == shape
    assert "stage1.1.downsample.0.kernel" not in shapes  # 16 to 16: nothing to change
    assert {name for name in shapes if not name.startswith("point_transforms.")} == set(
        MinkowskiNet().state_dict()
    )
