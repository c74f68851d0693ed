import pytest
import torch

from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors.minkowski import MinkowskiNet
from r2flow.metrics.extractors.spvcnn import SPVCNN
from r2flow.metrics.extractors.voxels import mean_by_distance, voxelise

SMALL = SENSORS["hdl64e"].resized(8, 32)


@pytest.fixture(scope="module")
def case(shared):
    return torch.load(shared / "oracle" / "voxel_prepost.pt", weights_only=True)


def test_voxels_are_the_reference_s(case):
    coords, features = voxelise(case["points"])
    torch.testing.assert_close(coords, case["voxel_coords"], rtol=0, atol=0)
    torch.testing.assert_close(features, case["voxel_feats"], rtol=1e-4, atol=1e-4)


def test_pooling_is_the_reference_s(case):
    features, coords = case["post_features_in"], case["voxel_coords"]
    torch.testing.assert_close(mean_by_distance(features, coords)[None], case["post_depth"], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(features.mean(0)[None], case["post_global"], rtol=1e-4, atol=1e-4)


def test_voxels_by_hand():
    # In voxels of 5 cm: (20, 0, 0), a point of the same voxel, no point at all, and (-20, 10, 2).
    points = torch.tensor([[1.0, 0.0, 0.0], [1.02, 0.01, 0.0], [0.0, 0.0, 0.0], [-1.0, 0.5, 0.1]])
    coords, features = voxelise(points)
    assert coords.tolist() == [[40, 0, 0], [0, 10, 2]]
    torch.testing.assert_close(features, torch.tensor([[1.0, 0, 0, -1], [-1, 0.5, 0.1, -1]]))
    assert voxelise(points[2:3])[0].shape == (0, 3)


def test_sectors_by_hand():
    # Four voxels about their centroid: two about 1 m off, two about 10 m off, of 20 voxels a metre.
    coords = torch.tensor([[20, 3, 0], [-20, -3, 0], [-30, 200, 0], [30, -200, 0]]) + 500
    features = torch.tensor([[1.0], [3.0], [10.0], [20.0]])
    # Edges 0, 7.25, 10.5, ...: 4 + 52 i / 16 m, the first put to 0.
    assert mean_by_distance(features, coords).tolist() == [2, 15] + [0] * 14
    far = coords * 1000
    assert mean_by_distance(features, far).tolist() == [0] * 16


@pytest.mark.parametrize("cls", [MinkowskiNet, SPVCNN])
def test_sizes_are_read_off_the_weights(cls):
    saved = cls((2, 3, 4, 5, 6, 7, 8, 9, 10), num_classes=11, channels=4).state_dict()
    loaded = cls.from_tensors({**saved, "criterion.weight": torch.ones(11)}, {})  # and what the loss left there
    assert loaded.dim == 160
    assert all(torch.equal(value, saved[name]) for name, value in loaded.state_dict().items())
    assert not any(module.training for module in loaded.modules())
    del saved["up3.1.0.net.0.kernel"]
    with pytest.raises(InputError, match="up3.1.0.net.0.kernel"):
        cls.from_tensors(saved, {})
    with pytest.raises(InputError, match="not the weights of"):
        cls.from_tensors({"stem.0.kernel": torch.zeros(2)}, {})


def test_distance_sectors_do_not_see_azimuth():
    # x -> y, y -> -x carries voxels onto voxels, and each onto one as far from the centroid.
    points = torch.randint(-400, 400, (500, 3)).float() * 0.05
    coords, _ = voxelise(points)
    turned, _ = voxelise(points @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]))
    assert torch.equal(turned[:, 0], coords[:, 1].max() - coords[:, 1])
    features = torch.randn(len(coords), 2)
    found = mean_by_distance(features, turned)
    torch.testing.assert_close(found, mean_by_distance(features, coords), rtol=1e-5, atol=1e-5)
