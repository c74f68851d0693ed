"""Scan i of every system is a function of its number, whatever the batch, and its evaluations are counted."""

from typing import Any

import pytest
import torch

from r2flow.generators import build_generator
from r2flow.noise import Draws
from r2flow.samplers import build_sampler

SENSOR = {"name": "hdl64e", "rows": 8, "columns": 32}
GAN = {"latent": 8, "base_channels": 4, "doublings": 2}
SYSTEMS: dict[str, tuple[dict[str, Any], str, int]] = {
    "vanilla_gan": (GAN, "direct", 1),
    "dusty1": (GAN, "direct", 1),
    "dusty2": (GAN, "direct", 1),
    "diffusion": ({}, "ddpm:steps=5", 5),
    "score": ({"width": 4, "levels": 3}, "langevin:steps=5", 3 * 5 + 1),
    "latent_diffusion": (
        {
            "autoencoder": {"width": 32, "multipliers": [1, 1], "strides": [[2, 2]], "blocks": 1, "codes": 16},
            "unet": {"width": 32, "multipliers": [1, 2], "blocks": 1, "attention": [2]},
        },
        "latent_ddim:steps=7",
        8,  # 1000 // 7 = 142 goes 8 times into 1000
    ),
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_scan_is_a_function_of_its_number_alone(name: str):
    torch.manual_seed(0)
    options, text, evaluations = SYSTEMS[name]
    backbone = {"name": "efficient_unet", "base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": 1}
    config = {
        "sensor": SENSOR, "encoding": {"format": "logscale", "reflectance": False}, "backbone": backbone,
        "generator": {"name": name, **options},
    }  # fmt: skip
    generator, sampler = build_generator(config).eval(), build_sampler(text)
    three, one = Draws(0, [4, 5, 6]), Draws(0, [5])
    many, alone = (generator(d.start(generator.noise_shape), draws=d, sampler=sampler) for d in (three, one))
    torch.testing.assert_close(many.x[1:2], alone.x, rtol=0, atol=1e-4)
    assert not torch.allclose(many.x[0], many.x[1])
    assert many.x.shape == (3, 1, 8, 32)
    assert many.x.abs().max() <= 1 or name == "latent_diffusion"  # whose decoder has no bound
    assert many.evaluations.tolist() == [evaluations] * 3
    assert sampler.evaluations(generator) == evaluations
