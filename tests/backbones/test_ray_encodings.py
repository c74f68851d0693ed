"""Ray encodings: the reference's numbers, and what must hold for any ring."""

import math

import numpy as np
import pytest
import torch

from r2flow.backbones.encodings import Rotary, SphericalHarmonics, rotate
from tests.reference import load_case


@pytest.fixture
def units(shared):
    return load_case(shared, "units_encodings.pt")


def test_spherical_harmonics_are_the_references(units):
    torch.testing.assert_close(
        SphericalHarmonics((16, 64))(units["hdl_16x64"]), units["sh5_16x64"], rtol=0, atol=1e-5
    )


def test_rotary_frequencies_are_the_references(units):
    for case in units["ropes"]:
        rotary = Rotary(case["num_heads"], case["dim"], case["max_harmonics"])
        assert torch.equal(rotary.freqs_h, case["freqs_h"])
        assert torch.equal(rotary.freqs_w, case["freqs_w"])


def test_spherical_harmonics_are_orthonormal():
    """Integrated over the sphere, by Gauss-Legendre in sin e and equal steps in a, Y_i Y_j is
    delta_ij.
    """
    z, w = np.polynomial.legendre.leggauss(16)
    nodes, weights = torch.from_numpy(np.arcsin(z)), torch.from_numpy(w)
    azimuth = torch.arange(32, dtype=torch.float64) * (2 * math.pi / 32)
    y = SphericalHarmonics((16, 32))(
        torch.stack(torch.meshgrid(nodes, azimuth, indexing="ij"))[None]
    )[0].flatten(1)
    area = (weights[:, None] * (2 * math.pi / 32)).expand(16, 32).flatten()
    torch.testing.assert_close(
        (y * area) @ y.T, torch.eye(25, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_rotation_keeps_lengths_and_depends_on_angle_differences_only():
    rotary = Rotary(2, 8, (4, 8))
    q, k = torch.randn(2, 2, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    e, a = [0.1, 0.3, 0.1 + 0.4, 0.3 + 0.4], [1.0, 2.0, 1.0 - 0.7, 2.0 - 0.7]
    table = rotary.table(torch.tensor([[[e], [a]]], dtype=torch.float64))[:, 0, :, 0]
    turned = [rotate(x, table[:, place]) for x, place in ((q, 0), (k, 1), (q, 2), (k, 3))]
    torch.testing.assert_close(turned[0].norm(dim=-1), q.norm(dim=-1))
    here, there = (turned[0] * turned[1]).sum(-1), (turned[2] * turned[3]).sum(-1)
    torch.testing.assert_close(here, there, rtol=0, atol=1e-12)
