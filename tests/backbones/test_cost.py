"""Parameters and multiply-accumulates: the paper's table II."""

import pytest
import torch
from tiny_backbones import Plain
from torch import nn

from r2flow.backbones import BACKBONES
from r2flow.backbones.hdit import HDiT
from r2flow.base.errors import InputError
from r2flow.lidar.sensors import SENSORS, build_sensor
from r2flow.reports.backbones import backbone_costs, cost, count_macs, count_parameters
from r2flow.runs.composing import compose

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
        model = BACKBONES.build(config, build_sensor("hdl64e").rays())
    assert count_parameters(model) == parameters
    assert count_macs(model) / 1e9 == pytest.approx(gmac, rel=2e-4)


def test_a_module_says_its_own_multiplications():
    class Twice(nn.Module):
        def forward(self, x):
            return x @ (2 * torch.eye(16, device=x.device))  # is not counted

        def macs(self, inputs, output):
            return output.numel()

    model = Plain(torch.zeros(2, 8, 16))
    before = count_macs(model)
    twice = Twice()  # in two places
    model.last = nn.Sequential(model.last, nn.Sequential(twice), twice)
    assert count_macs(model) - before == 2 * 2 * 8 * 16
    assert not any(parameter.is_meta for parameter in model.parameters())
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in model.modules())


class Other(nn.Module):
    def __init__(self):
        super().__init__()
        self.transposed = nn.ConvTranspose2d(3, 3, 2, stride=2)
        self.convolution, self.recurrent = (
            nn.Conv1d(3, 3, 5, padding=2),
            nn.GRU(3, 3, batch_first=True),
        )

    def forward(self, x):  # (B, 3, 8, 16)
        tokens = self.recurrent(self.convolution(self.transposed(x)[..., :8, :16].flatten(2)).mT)[0]
        return (torch.einsum("bqc,bkc->bqk", tokens, tokens).softmax(-1) @ tokens).mT.unflatten(
            2, (8, 16)
        )


def test_other_layers_by_hand():
    """128 values or tokens of 3 channels.

    Each value meets 2 x 2 taps of 3 channels in the transposed convolution; a token meets 5 taps,
    two products for each of three gates, and two products of all pairs.
    """
    model = Plain(torch.zeros(2, 8, 16), in_channels=2, out_channels=3)
    before = count_macs(model)
    model.last = nn.Sequential(model.last, Other())
    transposed, convolution, recurrent = 128 * 3 * 2 * 2 * 3, 128 * 5 * 3 * 3, 128 * 3 * 2 * 3 * 3
    assert count_macs(model) - before == transposed + convolution + recurrent + 2 * 128 * 128 * 3


def test_a_size_that_one_cannot_take_is_said_in_its_row():
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(64, 1000), ["hdit"], repeats=0)
    assert "1000" in row["error"]
    (row,) = backbone_costs(SENSORS["hdl64e"].resized(16, 64), ["hdit_tiny"], repeats=2)
    assert row["latency_ms"] > 0
    with pytest.raises(InputError, match="Did you mean 'hdit_tiny'"):
        list(backbone_costs(SENSORS["hdl64e"], ["hdit_tny"]))


def test_a_network_that_cannot_run_on_the_meta_device_has_no_gmac(monkeypatch):
    assert cost(compose(["encoding.reflectance=true", "backbone.attention=flex"]))["gmac"] is None
    monkeypatch.setattr(HDiT, "velocity", lambda self, t, x: x * torch.ones(1))
    assert cost(compose(["encoding.reflectance=true"]))["gmac"] is None


def test_the_verb_measures_what_it_is_asked_for(r2flow):
    options = ("--only", "hdit_tiny,local", "--size", "16x64", "--repeats", 1, "--device", "cpu")
    said = r2flow("report", "backbones", *options).said
    assert [line.split()[0] for line in said.splitlines()[2:4]] == ["hdit_tiny", "local"]
