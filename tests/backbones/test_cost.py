"""Parameters and multiply-accumulates: the paper's table II."""

import pytest
import torch
from test_backbones import read_config
from torch import nn

from r2flow.backbones import build_backbone
from r2flow.backbones.cost import count_macs, count_parameters
from r2flow.backbones.efficient_unet import EfficientUNet
from r2flow.lidar.sensors import build_sensor

TABLE_2 = {
    "hdit": (80_908_420, 77.79),
    "efficient_unet": (31_099_650, 116.25),
    "efficient_unet_large": (284_624_642, 688.31),
    "adm_unet": (87_365_058, 265.58),
    "adm_unet_large": (125_246_466, 692.69),
}


@pytest.mark.parametrize("config", TABLE_2)
def test_the_papers_table(config):
    parameters, gmac = TABLE_2[config]
    with torch.device("meta"):
        model = build_backbone(read_config(config), build_sensor("hdl64e").rays(), 2)
    assert count_parameters(model) == parameters
    assert count_macs(model) / 1e9 == pytest.approx(gmac, rel=5e-3)


def test_local_attention_is_the_part_that_the_paper_adds():
    """77.79 = 76.54 of layers + 1.253 of neighbourhood attention: without a window there is none."""
    rays = build_sensor("hdl64e").rays()
    options = {"name": "hdit"}
    with torch.device("meta"):
        whole = count_macs(build_backbone(options, rays, 2)) / 1e9
        tokens = [64 * 264 * 128, 32 * 136 * 256, 16 * 72 * 512]  # padded rows of each level x channels
    attention = sum(6 * 2 * 27 * count for count in tokens) / 1e9
    assert attention == pytest.approx(1.253, rel=5e-3)
    assert whole - attention == pytest.approx(76.54, rel=5e-3)


def test_counting_leaves_the_model_as_it_was():
    model = EfficientUNet(torch.zeros(2, 8, 16), base_channels=8, channel_multiplier=(1, 2), num_residual_blocks=1)
    before = [parameter.clone() for parameter in model.parameters()]
    assert count_macs(model) == count_macs(model) > 0
    assert all(torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))
    assert not any(module._forward_hooks for module in model.modules())
    assert {parameter.device.type for parameter in model.parameters()} == {"cpu"}


def test_a_convolution_by_hand():
    """The head of this model: 3 x 3 taps on 8 channels for each of 2 x 8 x 16 values."""
    options = {"base_channels": 8, "channel_multiplier": (1, 2), "num_residual_blocks": 1, "num_heads": 1}
    model = EfficientUNet(torch.zeros(2, 8, 16), **options)
    whole = count_macs(model)
    model.out_conv = nn.Identity()
    assert whole - count_macs(model) == 9 * 8 * 2 * 8 * 16
