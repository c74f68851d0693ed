"""Features of the networks of the table: what holds for all of them, then network by network."""

import pytest
import torch

from r2flow.base.errors import InputError
from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors import EXTRACTORS, pointnet
from r2flow.metrics.extractors.pointnet import PointNet
from r2flow.metrics.extractors.rangenet import RangeNet21, RangeNet53, _translate
from r2flow.metrics.extractors.voxels import SPVCNN, MinkowskiNet, _mean_by_distance, _voxelise
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import untrained
from tests.reference import load_case

SMALL = SENSORS["hdl64e"].resized(16, 32)


@pytest.mark.parametrize("name", EXTRACTORS)
def test_features_are_of_each_scan_alone(name):
    network = untrained(EXTRACTORS[name])
    draw = torch.Generator().manual_seed(0)
    r, q = torch.rand(2, 4, 1, *SMALL.shape, generator=draw)
    images = torch.cat([r * 50 + 1, q], 1) * (torch.rand(r.shape, generator=draw) > 0.2)
    images[1] = 0
    images[3, 0] = 0
    images[3, 0, 8, 7] = 10
    features = network.features(Scans(images, SMALL))
    assert features.shape == (4, network.dim)
    # also of a single return
    assert features.isfinite().all(1).tolist() == [True, False, True, True]
    assert features[1].isnan().all()
    torch.testing.assert_close(
        features[2:], network.features(Scans(images[2:], SMALL)), rtol=1e-5, atol=1e-5
    )
    assert not features.requires_grad
    darker = images * torch.tensor([1.0, 0.5]).view(1, 2, 1, 1)
    if network.needs_reflectance:
        assert (network.features(Scans(darker, SMALL))[0] != features[0]).any()
    else:
        torch.testing.assert_close(
            network.features(Scans(images[:, :1], SMALL)), features, equal_nan=True
        )


@torch.inference_mode()
def test_pointnet_is_the_reference(shared, monkeypatch):
    case = load_case(shared, "feat_pointnet.pt")
    network = PointNet(case["cfg"]["k"]).eval()
    network.load_state_dict(case["state_dict"], strict=True)
    torch.testing.assert_close(network(case["x"]), case["output"], rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(pointnet, "CHUNK", 2 * 300)  # points in parts: 300 of each scan, and a rest
    torch.testing.assert_close(network(case["x"]), case["output"], rtol=1e-4, atol=1e-4)


def test_a_dropped_ray_is_the_origin_in_units_of_80_m():
    network = untrained(PointNet)
    images = torch.rand(1, 1, *SMALL.shape) * 50 + 1
    images[0, 0, :, ::3] = 0
    batch = Scans(images, SMALL)
    points = torch.cat([batch.points[0], torch.zeros(1, 3)]).T[None] / 80
    order = torch.randperm(points.shape[2])
    torch.testing.assert_close(
        network.features(batch), network(points[:, :, order]), rtol=1e-5, atol=1e-5
    )


@pytest.fixture(scope="module")
def network():
    return untrained(RangeNet21)


@torch.inference_mode()
def test_rangenet21_is_the_reference(shared):
    case = load_case(shared, "feat_rangenet21.pt")
    network = RangeNet21(case["cfg"]["num_classes"]).eval()
    network.load_state_dict(case["state_dict"], strict=True)

    def close(found, expected):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)

    x = network._normalise(case["img"])
    close(x, case["pre"])
    maps = network(x)
    close(maps[:1], case["penultimate_b0"])
    close(maps.mean((2, 3)), case["penultimate_mean"])
    close(network.head(maps[:1]), case["logits_b0"])
    close(network.pool(maps), case["depth"])
    with torch.device("meta"):
        network = RangeNet53()
    close(network.pool(maps), case["subsample"])


def test_the_published_depth_is_bands_of_rows(network):
    maps = torch.arange(64.0).view(1, 1, 64, 1).expand(1, 2, 64, 32) * torch.tensor(
        [1.0, -1.0]
    ).view(1, 2, 1, 1)
    rows = torch.arange(16.0) * 4 + 1.5  # mean of rows 4 i .. 4 i + 3
    torch.testing.assert_close(network.pool(maps), torch.cat([rows, -rows])[None])


@pytest.mark.parametrize(
    ("cls", "blocks"), [(RangeNet21, (1, 1, 2, 2, 1)), (RangeNet53, (1, 2, 8, 8, 4))]
)
def test_names_of_the_original_release_are_ours(cls, blocks):
    with torch.device("meta"):
        network = cls(num_classes=20)
    assert (
        tuple(len(network.get_submodule(f"enc{level}.residual_blocks")) for level in range(1, 6))
        == blocks
    )
    ours = set(network.state_dict())
    assert {_translate(name) for name in ours} == ours
    for theirs, name in {
        "conv1.weight": "stem.0.weight",
        "bn1.running_mean": "stem.1.running_mean",
        "enc4.residual_1.bn2.bias": "enc4.residual_blocks.1.residual.1.1.bias",
        "enc2.conv.weight": "enc2.conv.0.weight",
        "enc5.bn.running_var": "enc5.conv.1.running_var",
        "dec3.upconv.bias": "dec3.conv.0.bias",
        "dec1.bn.weight": "dec1.conv.1.weight",
        "decoder.dec3.residual.conv1.weight": "dec3.residual_blocks.0.residual.0.0.weight",
        "1.bias": "head.1.bias",
    }.items():
        assert _translate(theirs) == name
        assert name in ours


def test_weights_bring_their_classes(network):
    tensors = {
        name: tensor for name, tensor in network.state_dict().items() if not name.startswith("head")
    }
    assert RangeNet21.from_tensors(tensors).head is None
    with pytest.raises(InputError, match="not the weights of rangenet21.*stem.0.weight"):
        RangeNet21.from_tensors({name: t for name, t in tensors.items() if name != "stem.0.weight"})


def test_ranges_are_normalised_where_there_is_a_return(network):
    image = torch.tensor([12.12, 10.88 + 11.47, 0.23, 0.0]).view(1, 4, 1, 1)
    torch.testing.assert_close(
        network._normalise(image).flatten(), torch.tensor([0, 1, 0, 1.04 / 0.86])
    )
    assert not network._normalise(image * 0).any()


@pytest.mark.parametrize("size", [(16, 40), (12, 32)])
def test_sizes_that_the_network_cannot_take_name_the_option(network, size):
    with pytest.raises(InputError, match="--size"):
        network.features(Scans(torch.ones(1, 1, *size), SENSORS["hdl64e"].resized(*size)))


def test_voxels_and_their_pooling_are_the_reference_s(shared):
    case = torch.load(shared / "oracle" / "voxel_prepost.pt", weights_only=True)
    coords, features = _voxelise(case["points"])
    torch.testing.assert_close(coords, case["voxel_coords"], rtol=0, atol=0)
    torch.testing.assert_close(features, case["voxel_feats"], rtol=1e-4, atol=1e-4)
    features = case["post_features_in"]
    torch.testing.assert_close(
        _mean_by_distance(features, coords)[None], case["post_depth"], rtol=1e-4, atol=1e-4
    )


def test_voxels_by_hand():
    # In voxels of 5 cm: (20, 0, 0), a point of the same voxel, no point at all, and (-20, 10, 2).
    points = torch.tensor([[1.0, 0.0, 0.0], [1.02, 0.01, 0.0], [0.0, 0.0, 0.0], [-1.0, 0.5, 0.1]])
    coords, features = _voxelise(points)
    assert coords.tolist() == [[40, 0, 0], [0, 10, 2]]
    torch.testing.assert_close(features, torch.tensor([[1.0, 0, 0, -1], [-1, 0.5, 0.1, -1]]))
    assert _voxelise(points[2:3])[0].shape == (0, 3)


def test_sectors_by_hand():
    # Four voxels about their centroid: two about 1 m off, two about 10 m off, of 20 voxels a metre.
    coords = torch.tensor([[20, 3, 0], [-20, -3, 0], [-30, 200, 0], [30, -200, 0]]) + 500
    features = torch.tensor([[1.0], [3.0], [10.0], [20.0]])
    # Edges 0, 7.25, 10.5, ...: 4 + 52 i / 16 m, the first put to 0.
    assert _mean_by_distance(features, coords).tolist() == [2, 15] + [0] * 14
    assert _mean_by_distance(features, coords * 1000).tolist() == [0] * 16


@pytest.mark.parametrize("cls", [MinkowskiNet, SPVCNN])
def test_sizes_are_read_off_the_weights(cls):
    saved = cls((2, 3, 4, 5, 6, 7, 8, 9, 10), num_classes=11).state_dict()
    # and what the loss left there
    loaded = cls.from_tensors({**saved, "criterion.weight": torch.ones(11)})
    assert loaded.dim == 160
    assert all(torch.equal(value, saved[name]) for name, value in loaded.state_dict().items())
    assert not any(module.training for module in loaded.modules())
    del saved["up3.1.0.net.0.kernel"]
    with pytest.raises(InputError, match="up3.1.0.net.0.kernel"):
        cls.from_tensors(saved)
    with pytest.raises(InputError, match="not the weights of"):
        cls.from_tensors({"stem.0.kernel": torch.zeros(2)})
