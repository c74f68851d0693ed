"""Returns of planes, whose ranges are known, with noise and without."""

import math

import pytest
import torch
from torch import Tensor

from r2flow.lidar.planes import TIMES, flattened
from r2flow.lidar.sensors import SENSORS

SENSOR = SENSORS["hdl64e"].resized(32, 256)
RAYS = SENSOR.rays()
SIGMA = 0.02


def on_ground(height: float = 1.73) -> Tensor:
    """Range of a flat ground; 0 above the horizon, (H, W)."""
    e = RAYS[0].double()
    return torch.where(e < 0, height / torch.sin(-e).clamp(min=1e-9), 0).clamp(max=1e3).float()


def on_wall(ahead: float) -> Tensor:
    """Range of a wall x = `ahead`, within 60 degrees of straight ahead; 0 elsewhere."""
    e, a = RAYS.double()
    x = torch.cos(e) * torch.cos(a)
    return torch.where(a.abs() < math.pi / 3, ahead / x, 0).float()


def rough(r: Tensor, sigma: float, seed: int = 0) -> Tensor:
    return r * torch.exp(sigma * torch.randn(r.shape, generator=torch.Generator().manual_seed(seed)))


def images_of(r: Tensor) -> Tensor:
    return torch.stack([r, torch.linspace(0, 1, r.numel()).view(r.shape)])[None]


@pytest.mark.parametrize("r", [on_wall(12.0), on_ground()], ids=["wall", "ground"])
def test_a_plane_stays_where_it_is(r: Tensor):
    """But for the azimuth, of which 1 / r is a cosine: d^2 / 2 for a column of width d, each time."""
    found = flattened(images_of(r), RAYS, SIGMA)[0, 0]
    inside = r > 0
    column = 2 * math.pi / SENSOR.columns
    assert ((found - r).abs()[inside] / r[inside]).quantile(0.99) < TIMES * column**2 / 2


def test_noise_about_a_wall_becomes_a_quarter_of_it():
    """A plane through n = 15 * 3 returns has 3 / n of their variance where the weights are equal."""
    r = on_wall(12.0)
    found = flattened(images_of(rough(r, 0.01)), RAYS, SIGMA)[0, 0]
    inside = r > 0
    assert torch.log(found[inside] / r[inside]).std() < 0.01 / 4


def test_an_edge_stays_an_edge():
    r = on_wall(12.0)
    r[:, 128:] = on_wall(20.0)[:, 128:]
    found = flattened(images_of(rough(r, 0.005)), RAYS, SIGMA)[0, 0]
    inside = r > 0
    assert torch.log(found[inside] / r[inside]).abs().max() < 0.02


def test_rays_reflectance_and_scenes_are_each_their_own():
    r = torch.stack([on_wall(12.0), on_ground()])
    drops = torch.rand(r.shape, generator=torch.Generator().manual_seed(1)) < 0.2
    images = torch.cat(
        [images_of(torch.where(drop, 0.0, rough(one, 0.01))) for one, drop in zip(r, drops, strict=True)]
    )
    given = images.clone()
    found = flattened(images, RAYS, SIGMA)
    assert torch.equal(images, given)
    assert torch.equal(found[:, 0] > 0, given[:, 0] > 0)
    assert torch.equal(found[:, 1:], given[:, 1:])
    for place in range(2):
        torch.testing.assert_close(flattened(images[place : place + 1], RAYS, SIGMA)[0], found[place])
    torch.testing.assert_close(flattened(images.roll(7, -1), RAYS, SIGMA), found.roll(7, -1))
    assert torch.equal(flattened(images[:, :1], RAYS, SIGMA), found[:, :1])


@pytest.mark.parametrize("shape", [(2, 8), (3, 2), (64, 4)])
@pytest.mark.parametrize("r", [0.0, 1e-3, 1e4])
def test_small_and_empty_images_have_numbers(shape: tuple[int, int], r: float):
    image = torch.full((1, 2, *shape), r)
    image[0, 0, 0, ::3] = 0
    found = flattened(image, SENSOR.resized(*shape).rays(), SIGMA)
    assert torch.isfinite(found).all()
    torch.testing.assert_close(found[0, 0] > 0, image[0, 0] > 0)
