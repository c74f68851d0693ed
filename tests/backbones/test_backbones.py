"""What every backbone in the table must do, and every config of one."""

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from r2flow.backbones import BACKBONES, build_backbone
from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS, build_sensor

CONFIGS = sorted((Path(__file__).parents[2] / "conf" / "backbone").glob("*.yaml"))
TINY = {
    "hdit": {"base_channels": 16, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
}


def tiny(name: str, rows: int = 8, columns: int = 32, channels: int = 2) -> torch.nn.Module:
    torch.manual_seed(0)
    model = build_backbone({"name": name, **TINY[name]}, build_sensor("hdl64e", rows, columns).rays(), channels)
    for parameter in model.parameters():
        if not parameter.any():  # zero-initialised: nothing would be seen behind it
            torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def test_every_backbone_has_a_tiny_form_here():
    assert set(TINY) == set(BACKBONES)


@pytest.mark.parametrize("name", list(BACKBONES))
@pytest.mark.parametrize("channels", [1, 2, 4])
def test_velocity_has_the_shape_of_the_image(name, channels):
    model = tiny(name, channels=channels)
    x = torch.randn(2, channels, 8, 32)
    assert model(torch.rand(2), x).shape == x.shape


@pytest.mark.parametrize("name", list(BACKBONES))
def test_scalar_and_batched_times_agree(name):
    model, x = tiny(name), torch.randn(3, 2, 8, 32)
    with torch.no_grad():
        batched = model(torch.full((3,), 0.3), x)
        for t in (0.3, torch.tensor(0.3), torch.tensor([0.3])):
            torch.testing.assert_close(model(t, x), batched, rtol=0, atol=1e-5)
        torch.testing.assert_close(model(torch.full((3,), 0.3), x)[1:], model(0.3, x[1:]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_times_of_another_number_are_refused(name):
    with pytest.raises(ValueError, match=r"t must be a scalar or of shape \(3,\), found \(2,\)"):
        tiny(name)(torch.rand(2), torch.randn(3, 2, 8, 32))


@pytest.mark.parametrize("name", list(BACKBONES))
def test_the_time_matters(name):
    model, x = tiny(name), torch.randn(1, 2, 8, 32)
    with torch.no_grad():
        assert (model(0.1, x) - model(0.9, x)).abs().max() > 1e-4


@pytest.mark.parametrize("name", list(BACKBONES))
def test_it_goes_into_torchdiffeq(name):
    from torchdiffeq import odeint

    model, x_0 = tiny(name), torch.randn(2, 2, 8, 32)
    with torch.no_grad():
        states = odeint(model, x_0, torch.linspace(0, 1, 3), method="euler")
        expected = x_0 + 0.5 * model(0.0, x_0)
    torch.testing.assert_close(states[1], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_every_config_builds_for_every_sensor(config):
    options = OmegaConf.to_container(OmegaConf.load(config), resolve=True)
    with torch.device("meta"):
        for sensor in SENSORS:
            build_backbone(options, build_sensor(sensor).rays().to("meta"), 2)


def test_unknown_names_and_options_are_explained():
    with pytest.raises(InputError, match=r"no backbone named 'hditt'.*Did you mean 'hdit'"):
        build_backbone({"name": "hditt"}, torch.zeros(2, 8, 32), 2)
    with pytest.raises(InputError, match=r"backbone 'hdit' has no option 'depth'.*Did you mean 'depths'"):
        build_backbone({"name": "hdit", "depth": 3}, torch.zeros(2, 8, 32), 2)
