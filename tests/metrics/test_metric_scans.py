"""What a batch of scans refuses, and where its points lie."""

import pytest
import torch

from r2flow.errors import InputError
from r2flow.metrics import METRICS
from r2flow.metrics.scans import Scans
from tests.metrics.conftest import SMALL


def images(n=3):
    r = torch.linspace(2, 60, n * 8 * 32).view(n, 1, 8, 32)
    return torch.cat([r, torch.full_like(r, 0.5)], 1)


def broken(change):
    made = images()
    change(made)
    return made


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda x: x[1, 1].fill_(255.0), "reflectance goes up to 255"),
        (lambda x: x[1, 1, 0, 0].fill_(float("nan")), "reflectance is NaN"),
        (lambda x: x[1, 0, 2].fill_(float("inf")), "range is NaN or infinite"),
        (lambda x: x[1, 0, 0].fill_(-1.0), "range goes down to -1; 0 stands for no return"),
        (lambda x: x[1].mul_(0).sub_(0.3), r"model space \(\[-1, 1\]\)\? Decode it"),
        (lambda x: x[1, 0].mul_(1000), "are these millimetres"),
        (lambda x: x[1, 1, 0, 0].fill_(-0.2), "reflectance goes down to -0.2"),
    ],
)
def test_values_that_no_scan_has_are_refused_with_the_first_such_scan(change, said):
    made = broken(change)
    with pytest.raises(InputError, match=f"^scan 1: .*{said}"):
        Scans(made, SMALL)
    with pytest.raises(InputError, match=f"^scan b.npy: .*{said}"):
        Scans(made, SMALL, names=["a.npy", "b.npy", "c.npy"])
    metric = METRICS["jsd"](sensor=SMALL)
    metric.update(images(), real=True)
    with pytest.raises(InputError, match=f"^scan 4: .*{said}"):
        metric.update(made, real=True)
    assert metric.given("real") == 3


def test_single_far_returns_and_rounding_are_let_pass():
    Scans(broken(lambda x: x[:, 0, 0, 0].fill_(1e5)), SMALL)
    Scans(broken(lambda x: x[:, 1, 0, 0].fill_(1.0005)), SMALL)
    Scans(torch.zeros(2, 2, 8, 32), SMALL)
    assert len(Scans(torch.zeros(0, 2, 8, 32), SMALL)) == 0


def test_points_lie_on_the_rays_that_are_named_or_where_they_were_measured():
    r = images()[:, :1]
    for rays, shift in (("centre", 0.5), ("reference", 0.0)):
        x, y, _ = Scans(images(), SMALL, rays).xyz[0]
        azimuth = torch.atan2(y, x)[3]
        expected = torch.pi - 2 * torch.pi * (torch.arange(32) + shift) / 32
        assert torch.allclose(torch.cos(azimuth), torch.cos(expected), atol=1e-5)
        assert torch.allclose(torch.sin(azimuth), torch.sin(expected), atol=1e-5)
    measured = torch.randn(3, 3, 8, 32)
    far = torch.cat([torch.where(r > 30, 70, r), images()[:, 1:]], 1)  # beyond the mask
    scans = Scans(far, SMALL, xyz=measured)
    assert torch.equal(scans.xyz, measured * (r <= 30))
