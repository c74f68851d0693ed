"""What holds for the features of every network of the table."""

import pytest
import torch

from r2flow.lidar.sensors import SENSORS
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import untrained

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
    assert features.isfinite().all(1).tolist() == [True, False, True, True]  # also of a single return
    assert features[1].isnan().all()
    torch.testing.assert_close(features[2:], network.features(Scans(images[2:], SMALL)), rtol=1e-5, atol=1e-5)
    assert not features.requires_grad
    darker = images * torch.tensor([1.0, 0.5]).view(1, 2, 1, 1)
    if network.needs_reflectance:
        assert (network.features(Scans(darker, SMALL))[0] != features[0]).any()
    else:
        torch.testing.assert_close(network.features(Scans(images[:, :1], SMALL)), features, equal_nan=True)
