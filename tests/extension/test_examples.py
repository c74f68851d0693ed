"""The examples do what they say: answers by formula."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from r2flow.errors import InputError
from r2flow.generators import GENERATORS
from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.lidar.sensors import SENSORS
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.sampling import sample
from r2flow.noise import Draws
from tests.extension.conftest import BACKBONE, COMPLETION, DDPM, loaded

M, S = 0.1, 0.2  # x_1 ~ N(M, S^2) in every pixel


def space() -> ModelSpace:
    sensor = SENSORS["hdl64e"].resized(16, 64)
    return ModelSpace(sensor, Encoding(sensor), sensor.rays())


@pytest.fixture
def gaussian_ddpm():
    """A DDPM whose network is exact: E[x_0 | x_t] for independent x_0 ~ N(0, 1) and x_1 ~ N(M, S^2)."""
    with loaded(DDPM, BACKBONE):
        ddpm = GENERATORS["toy_ddpm"](space(), {"name": "toy_backbone"})

    def expected_noise(t, x):
        a = torch.sin(torch.as_tensor(t) * torch.pi / 2).square().clamp(min=1e-4)
        return (1 - a).sqrt() * (x - a.sqrt() * M) / (a * S**2 + 1 - a)

    ddpm.backbone = None
    ddpm.__dict__["backbone"] = expected_noise
    return ddpm


def test_ddim_follows_the_path_that_carries_noise_to_data(gaussian_ddpm):
    x_0 = Draws(0, range(2)).start(gaussian_ddpm.noise_shape)
    found = gaussian_ddpm(x_0, sampler=replace(gaussian_ddpm.sampler, steps=400, ancestral=False))
    torch.testing.assert_close(found.x, M + S * x_0, rtol=0, atol=0.01)
    assert found.evaluations.tolist() == [400, 400]


def test_ddpm_draws_from_the_data(gaussian_ddpm):
    draws = Draws(0, range(8))
    x_0 = draws.start(gaussian_ddpm.noise_shape)
    x = gaussian_ddpm(x_0, sampler=replace(gaussian_ddpm.sampler, steps=400), draws=draws).x
    assert x.mean().item() == pytest.approx(M, abs=0.01)  # of 16,384 draws: 6 standard errors
    assert x.std().item() == pytest.approx(S, rel=0.05)
    assert torch.corrcoef(torch.stack([x.flatten(), x_0.flatten()]))[0, 1].abs() < 0.1  # the start is forgotten


def test_known_rays_are_given_back_and_the_others_depend_on_them(completion: Path):
    with loaded(COMPLETION):
        checkpoint = load_checkpoint(completion)
    space = checkpoint.generator.space
    mask = torch.zeros(2, 1, 16, 64)
    mask[:, :, ::2] = 1
    for image in (torch.full((2, *space.shape), 0.5), torch.full((2, *space.shape), -0.5)):
        known = {"image": image, "mask": mask}
        alone = torch.cat([one.images for one in sample(checkpoint, 2, batch_size=1, condition=known)])
        together = next(sample(checkpoint, 2, batch_size=2, condition=known)).images
        torch.testing.assert_close(alone, together, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(alone[:, :, ::2], space.decode(image)[:, :, ::2], rtol=1e-5, atol=1e-5)
    free = next(sample(checkpoint, 2, batch_size=2)).images
    assert not torch.allclose(free[:, :, 1::2], alone[:, :, 1::2])


def test_an_unknown_condition_is_refused(completion: Path):
    with loaded(COMPLETION):
        checkpoint = load_checkpoint(completion)
    with pytest.raises(InputError, match="a completion knows of 'image' and 'mask', found labels"):
        next(sample(checkpoint, 1, condition={"labels": torch.zeros(1)}))
