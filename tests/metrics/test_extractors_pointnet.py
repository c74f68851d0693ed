import pytest
import torch

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors import pointnet
from r2flow.metrics.extractors.pointnet import PointNet
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import untrained
from tests.reference import load_case

SMALL = SENSORS["hdl64e"].resized(8, 32)


@pytest.fixture(scope="module")
def network():
    return untrained(PointNet)


@torch.inference_mode()
def test_pointnet_is_the_reference(shared, monkeypatch):
    case = load_case(shared, "feat_pointnet.pt")
    network = PointNet(case["cfg"]["k"]).eval()
    network.load_state_dict(case["state_dict"], strict=True)
    torch.testing.assert_close(network(case["x"]), case["output"], rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(pointnet, "CHUNK", 2 * 300)  # points in parts: 300 of each scan, and a rest
    torch.testing.assert_close(network(case["x"]), case["output"], rtol=1e-4, atol=1e-4)


def test_a_dropped_ray_is_the_origin_in_units_of_80_m(network):
    images = torch.rand(1, 1, *SMALL.shape) * 50 + 1
    images[0, 0, :, ::3] = 0
    batch = Scans(images, SMALL)
    points = torch.cat([batch.points[0], torch.zeros(1, 3)]).T[None] / 80
    order = torch.randperm(points.shape[2])
    torch.testing.assert_close(network.features(batch), network(points[:, :, order]), rtol=1e-5, atol=1e-5)
