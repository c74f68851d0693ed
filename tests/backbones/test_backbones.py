"""What every backbone in the table must do, and every config of one."""

import copy
import json
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from reference_cases import relative

from r2flow.backbones import BACKBONES, Backbone, build_backbone
from r2flow.errors import InputError
from r2flow.lidar.sensors import SENSORS, build_sensor

CONF = Path(__file__).parents[2] / "conf"
CONFIGS = sorted(path.stem for path in (CONF / "backbone").glob("*.yaml"))
TINY = {
    "hdit": {"base_channels": 16, "depths": [1, 1], "num_heads": [1, 2], "time_channels": 16},
    "adm_unet": {"base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": [1, 2], "num_heads": 2},
    "efficient_unet": {"base_channels": 8, "channel_multiplier": [1, 2], "num_residual_blocks": 1, "num_heads": 2},
}
# parameters, and the names under which the published state_dicts are listed
PUBLISHED = {
    "hdit": (80_908_420, "hdit"),
    "adm_unet": (87_365_058, "adm_base"),
    "adm_unet_large": (125_246_466, "adm_large"),
    "efficient_unet": (31_099_650, "eff_base"),
    "efficient_unet_large": (284_624_642, "eff_large"),
}


def read_config(name: str) -> dict:
    with initialize_config_dir(str(CONF), version_base=None):
        return OmegaConf.to_container(compose(f"backbone/{name}").backbone, resolve=True)


def untrained(name: str, rows: int = 8, columns: int = 32, channels: int = 2, **options) -> Backbone:
    rays = build_sensor("hdl64e", rows, columns).rays()
    return build_backbone({"name": name, **TINY[name], **options}, rays, channels)


def tiny(name: str, **options) -> Backbone:
    model = untrained(name, **options)
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


@pytest.mark.parametrize("position", ["fourier_features", "polar", "spherical_harmonics", "none", None])
@pytest.mark.parametrize("ring", [True, False])
@pytest.mark.parametrize("name", list(BACKBONES))
def test_every_option_runs_forward_and_backward(name, ring, position):
    model = tiny(name, position=position, ring=ring, dropout=0.1).train()
    x = torch.randn(2, 2, 8, 32)
    model(torch.rand(2), x).square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("name", list(BACKBONES))
def test_a_rolled_ring_gives_a_rolled_velocity_without_position(name):
    """By whole units of the coarsest resolution; an image with ends does not."""
    x, t = torch.randn(2, 2, 8, 64, dtype=torch.float64), torch.tensor([0.2, 0.7], dtype=torch.float64)
    for ring in (True, False):
        model = tiny(name, columns=64, position="none", ring=ring).double()
        with torch.no_grad():
            difference = (model(t, x.roll(24, 3)) - model(t, x).roll(24, 3)).abs().max().item()
        assert (difference < 1e-4) == ring  # angles are float32


@pytest.mark.parametrize("name", list(BACKBONES))
def test_an_untrained_model_is_the_zero_field(name):
    assert not untrained(name)(0.5, torch.randn(1, 2, 8, 32)).any()


@pytest.mark.parametrize("name", list(BACKBONES))
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_is_near_float32_and_returns_it(name, dtype):
    model, x, t = tiny(name), torch.randn(2, 2, 8, 32), torch.tensor([0.1, 0.9985])
    with torch.no_grad():
        expected = model(t, x)
        with torch.autocast("cpu", dtype=dtype):
            found = model(t, x)
    assert found.dtype == torch.float32
    assert relative(found, expected) < (0.05 if dtype == torch.bfloat16 else 0.01)


@pytest.mark.parametrize("name", list(BACKBONES))
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_weights_are_near_float32(name, dtype):
    model, x = tiny(name), torch.randn(2, 2, 8, 32)
    with torch.no_grad():
        expected = model(0.9985, x)
        found = model.to(dtype)(0.9985, x)
    assert found.dtype == torch.float32
    assert relative(found, expected) < (0.1 if dtype == torch.bfloat16 else 0.02)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_nearby_times_are_told_apart_under_autocast(name):
    """bfloat16 would round 0.9985 to 1."""
    model, x = tiny(name), torch.randn(1, 2, 8, 32)
    with torch.no_grad():
        expected = model(1.0, x) - model(0.9985, x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            velocities = [model(t, x) for t in (1.0, 0.9985)]
    assert expected.any()
    assert not torch.equal(*velocities)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_derived_buffers_follow_loaded_rays(name):
    source = tiny(name)
    shifted = build_backbone({"name": name, **TINY[name]}, torch.zeros(2, 8, 32), 2).eval()
    shifted.load_state_dict(source.state_dict())
    x = torch.randn(1, 2, 8, 32)
    with torch.no_grad():
        assert torch.equal(source(0.3, x), shifted(0.3, x))


@pytest.mark.parametrize("name", list(BACKBONES))
def test_a_copy_is_whole_and_independent(name):
    """An averaging callback deep-copies the module and exchanges parameters and buffers one by one."""
    model, x = tiny(name), torch.randn(1, 2, 8, 32)
    twin, other = copy.deepcopy(model), tiny(name)
    tensors = [*twin.parameters(), *twin.buffers()], [*other.parameters(), *other.buffers()]
    with torch.no_grad():
        before = model(0.4, x)
        for mine, its in zip(*tensors, strict=True):
            mine.copy_(its)
        assert torch.equal(twin(0.4, x), other(0.4, x))
        assert torch.equal(model(0.4, x), before)
        twin.load_state_dict(model.state_dict())
        assert torch.equal(twin(0.4, x), before)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_forward_leaves_no_trace_in_the_module(name):
    model = tiny(name)
    before = {name: dict(vars(module)) for name, module in model.named_modules()}
    with torch.no_grad():
        model(0.5, torch.randn(1, 2, 8, 32))
    for path, module in model.named_modules():
        assert vars(module).keys() == before[path].keys()
        assert all(vars(module)[key] is value for key, value in before[path].items()), path


@pytest.mark.parametrize("name", list(BACKBONES))
@pytest.mark.parametrize("shape", [(8, 31), (7, 32), (1, 32)])
def test_a_shape_that_cannot_work_names_the_nearest_that_do(name, shape):
    with pytest.raises(InputError, match=r"(height|width) \d+ cannot be used by .* with 2 levels") as error:
        build_backbone({"name": name, **TINY[name]}, torch.zeros(2, *shape), 2)
    dimension = 1 if "width" in str(error.value) else 0
    for nearest in str(error.value).split("nearest: ")[1].rstrip(".").split(", "):
        working = list(shape)
        working[dimension] = int(nearest)
        build_backbone({"name": name, **TINY[name]}, torch.zeros(2, *working), 2)


@pytest.mark.parametrize("name", list(BACKBONES))
def test_an_image_of_another_shape_is_refused(name):
    with pytest.raises(InputError, match=r"built for images of \(2, 8, 32\), found \(2, 8, 64\)"):
        tiny(name)(0.5, torch.randn(1, 2, 8, 64))


@pytest.mark.parametrize("config", CONFIGS)
def test_every_config_builds_for_every_sensor(config):
    with torch.device("meta"):
        for sensor in SENSORS:
            build_backbone(read_config(config), build_sensor(sensor).rays(), 2)


@pytest.mark.parametrize("config", PUBLISHED)
def test_parameters_and_names_are_the_published_models(config, shared):
    parameters, listed = PUBLISHED[config]
    expected = json.loads((shared / "oracle" / "state_dict_keys.json").read_text())[listed]
    with torch.device("meta"):
        model = build_backbone(read_config(config), build_sensor("hdl64e").rays(), 2)
    assert sum(p.numel() for p in model.parameters()) == parameters
    kinds = dict.fromkeys(dict(model.named_parameters()), "param")
    found = {key: (list(value.shape), kinds.get(key, "buffer")) for key, value in model.state_dict().items()}
    assert found == {key: (shape, kind) for key, shape, kind in expected}


def test_unknown_names_and_options_are_explained():
    with pytest.raises(InputError, match=r"no backbone named 'hditt'.*Did you mean 'hdit'"):
        build_backbone({"name": "hditt"}, torch.zeros(2, 8, 32), 2)
    with pytest.raises(InputError, match=r"backbone 'hdit' has no option 'depth'.*Did you mean 'depths'"):
        build_backbone({"name": "hdit", "depth": 3}, torch.zeros(2, 8, 32), 2)
