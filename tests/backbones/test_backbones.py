"""What every backbone in the table must do, what the published ones do beyond it, and every
configuration.
"""

import copy
import itertools
import json
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from tiny_backbones import COLUMNS, NAMES, PUBLISHED, ROWS, image, tiny, untrained
from torch import nn

from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.registry import presets
from r2flow.lidar.sensors import SENSORS, build_sensor
from r2flow.reports.backbones import count_macs
from tests.conftest import tiny_options
from tests.reference import assert_norms, backbone_of, load_case, relative

CONF = Path(__file__).parents[2] / "conf"
LISTED = {  # under these names in the oracle
    "hdit": "hdit", "adm_unet": "adm_base", "adm_unet_large": "adm_large",
    "efficient_unet": "eff_base", "efficient_unet_large": "eff_large",
}  # fmt: skip

CASES = {
    "eff_16x64_polar": "efficient_unet", "adm_16x64_fourier": "adm_unet",
    **dict.fromkeys(("hdit_16x192", "hdit_16x192_fourier_features", "hdit_16x64_dup"), "hdit"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_output_and_gradients_are_the_references_at_times_of_their_own_and_at_one_time(
    shared, name
):
    case = load_case(shared, f"{name}.pt")
    model, x = backbone_of(CASES[name], case), case["x"].clone().requires_grad_()
    output, at_one = model(case["t"], x), model(case["t_scalar"], case["x"][:1])
    for found, expected in ((output, case["output"]), (at_one, case["output_t_scalar"])):
        # relative to the norm: logit scales of 100 amplify rounding, and the reference itself,
        # computed again in float64, differs from its float32 output by up to 1.2e-4 in single
        # pixels
        assert relative(found, expected) < 5e-5
        assert CASES[name] == "hdit" or (found - expected).abs().max() < 5e-5
    (output * case["grad_w"]).sum().backward()
    assert relative(x.grad, case["grad_x"]) < 1e-3
    assert_norms(model, case["grad_param_norms"])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("in_channels", "out_channels"), [(1, None), (2, None), (2, 2), (5, 2), (1, 3)]
)
def test_the_answer_has_the_shape_of_the_image_and_channels_of_its_own(
    name, in_channels, out_channels
):
    model = tiny(name, in_channels, out_channels)
    expected = in_channels if out_channels is None else out_channels
    assert model(torch.rand(2), image(2, in_channels)).shape == (2, expected, ROWS, COLUMNS)
    assert (model.in_channels, model.out_channels) == (in_channels, expected)


@pytest.mark.parametrize("name", NAMES)
def test_every_input_channel_is_seen(name):
    model, x = tiny(name, 3, 1), image(1, 3).requires_grad_()
    model(0.5, x).square().sum().backward()
    assert (x.grad.abs().amax((0, 2, 3)) > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_scalar_and_batched_times_agree(name):
    model, x = tiny(name), image(3)
    with torch.no_grad():
        batched = model(torch.full((3,), 0.3), x)
        for t in (0.3, torch.tensor(0.3), torch.tensor([0.3])):
            torch.testing.assert_close(model(t, x), batched, rtol=0, atol=1e-5)
        for part in (slice(1, None), slice(0)):
            torch.testing.assert_close(batched[part], model(0.3, x[part]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_is_near_float32_and_returns_it(name, dtype):
    model, x, t = tiny(name), image(), torch.tensor([0.1, 0.9985])
    with torch.no_grad():
        expected = model(t, x)
        with torch.autocast("cpu", dtype=dtype):
            found = model(t, x)
    assert found.dtype == torch.float32
    assert relative(found, expected) < (0.05 if dtype == torch.bfloat16 else 0.01)


@pytest.mark.parametrize("name", NAMES)
def test_nearby_times_are_told_apart_under_autocast(name):
    """bfloat16 rounds 0.9985 to 1: the layers that see t must be `ExactLinear`."""
    model, x = tiny(name), image(1)
    with torch.no_grad():
        expected = model(1.0, x) - model(0.9985, x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            velocities = [model(t, x) for t in (1.0, 0.9985)]
    assert expected.any()
    assert not torch.equal(*velocities)


@pytest.mark.parametrize("name", NAMES)
def test_derived_buffers_follow_loaded_rays(name):
    source, x = tiny(name), image(1)
    loaded = BACKBONES.build(tiny_options(name), torch.zeros(2, ROWS, COLUMNS)).eval()
    loaded.load_state_dict(source.state_dict())
    with torch.no_grad():
        assert torch.equal(source(0.3, x), loaded(0.3, x))


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_is_whole_and_independent(name):
    """An averaging callback deep-copies the module and exchanges parameters and buffers one by one."""
    model, x = tiny(name), image(1)
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


@pytest.mark.parametrize("name", NAMES)
def test_forward_leaves_no_trace_in_the_module(name):
    model = tiny(name)
    before = {name: dict(vars(module)) for name, module in model.named_modules()}
    with torch.no_grad():
        model(0.5, image(1))
    for path, module in model.named_modules():
        assert vars(module).keys() == before[path].keys()
        assert all(vars(module)[key] is value for key, value in before[path].items()), path


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dimension", [0, 1])
def test_a_shape_that_is_not_whole_units_names_one_that_is(name, dimension):
    unit, options = untrained(name).unit, tiny_options(name)
    if unit[dimension] == 1:
        pytest.skip("takes any size")
    shape = [3 * unit[0], 3 * unit[1]]
    shape[dimension] -= 1
    what, multiple = ("height", "width")[dimension], unit[dimension]
    message = rf"{what} {3 * multiple - 1} cannot be used by .* a multiple of {multiple}, such as {3 * multiple}\."
    with pytest.raises(InputError, match=message):
        BACKBONES.build(options, torch.zeros(2, *shape))
    shape[dimension] = 2 * multiple
    BACKBONES.build(options, torch.zeros(2, *shape))


POSITIONS = ["fourier_features", "polar", "spherical_harmonics", "none", None]
OPTIONS = [
    {"position": position, "ring": ring, "dropout": 0.1}
    for position in POSITIONS
    for ring in (True, False)
]


@pytest.mark.parametrize(
    ("name", "options"), [*((name, {}) for name in NAMES), *itertools.product(PUBLISHED, OPTIONS)]
)
def test_every_parameter_has_a_gradient_under_every_option(name, options):
    model = tiny(name, **options).train()
    model(torch.rand(2), image()).square().mean().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_rolled_ring_gives_a_rolled_velocity_without_position(name):
    """By whole units of the coarsest resolution; an image with ends does not."""
    x, t = image().double(), torch.tensor([0.2, 0.7], dtype=torch.float64)
    for ring in (True, False):
        model = tiny(name, position="none", ring=ring).double()
        with torch.no_grad():
            difference = (model(t, x.roll(24, 3)) - model(t, x).roll(24, 3)).abs().max().item()
        assert (difference < 1e-4) == ring  # angles are float32
        assert not model.learns_directions


@pytest.mark.parametrize("turns", [1, 2, 16])
def test_a_narrow_ring_computes_what_a_ring_of_many_turns_does(turns):
    model, x = tiny("local").double(), image()[..., :4].double()
    many = model.velocity(torch.tensor([0.4]), x.repeat(1, 1, 1, 32))
    torch.testing.assert_close(
        model.velocity(torch.tensor([0.4]), x.repeat(1, 1, 1, turns)), many[..., : 4 * turns]
    )


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_weights_are_near_float32(name, dtype):
    model, x = tiny(name), image()
    with torch.no_grad():
        expected = model(0.9985, x)
        found = model.to(dtype)(0.9985, x)
    assert found.dtype == torch.float32
    assert relative(found, expected) < (0.1 if dtype == torch.bfloat16 else 0.02)


@pytest.mark.parametrize("config", [path.stem for path in (CONF / "backbone").glob("*.yaml")])
def test_configurations_are_what_hydra_composes(config):
    with initialize_config_dir(str(CONF), version_base=None):
        composed = OmegaConf.to_container(compose(f"backbone/{config}").backbone, resolve=True)
    assert presets("backbone")[config] == composed


def test_a_backbone_without_a_file_is_configured_by_its_defaults():
    assert BACKBONES.options("plain") == {"name": "plain"}


@pytest.mark.parametrize("config", [path.stem for path in (CONF / "backbone").glob("*.yaml")])
def test_every_configuration_builds_for_every_sensor(config):
    with torch.device("meta"):
        for sensor in SENSORS:
            BACKBONES.build(config, build_sensor(sensor).rays())


@pytest.mark.parametrize(
    ("names", "count", "size"),
    [
        (
            ("hdit_18m", "adm_unet_18m", "efficient_unet_18m"),
            lambda model: sum(p.numel() for p in model.parameters()),
            (64, 1024),
        ),
        (("hdit_18m", "adm_unet_15g", "efficient_unet_15g"), count_macs, (64, 1024)),
        (
            ("hdit_tiny", "adm_unet_tiny", "efficient_unet_tiny", "vit_tiny"),
            count_macs,
            (32, 256),
        ),
    ],
)
def test_backbones_of_an_ablation_are_of_one_size_or_one_cost(names, count, size):
    with torch.device("meta"):
        counts = [
            count(BACKBONES.build(name, build_sensor("hdl64e", *size).rays())) for name in names
        ]
    assert max(counts) <= 1.1 * min(counts)


@pytest.mark.parametrize("config", LISTED)
def test_names_and_shapes_are_the_published_models(config, shared):
    expected = json.loads((shared / "oracle" / "state_dict_keys.json").read_text())[LISTED[config]]
    with torch.device("meta"):
        model = BACKBONES.build(config, build_sensor("hdl64e").rays())
    kinds = dict.fromkeys(dict(model.named_parameters()), "param")
    found = {
        key: (list(value.shape), kinds.get(key, "buffer"))
        for key, value in model.state_dict().items()
    }
    assert found == {key: (shape, kind) for key, shape, kind in expected}


class Scaled(nn.Module):
    """factor t x, of the first channels."""

    def __init__(self, factor: float, out_channels: int, rays=None) -> None:
        super().__init__()
        self.factor, self.out_channels, self.rays = factor, out_channels, rays

    def forward(self, t, x):
        return self.factor * t[:, None, None, None] * x[:, : self.out_channels]


@pytest.fixture
def scaled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BACKBONES, "_entries", dict(BACKBONES._entries))
    BACKBONES.add("scaled", Scaled)


def test_any_class_of_modules_becomes_a_backbone_and_gets_what_it_names(scaled):
    x = torch.randn(3, 5, 4, 8)
    t = torch.tensor([0.0, 0.5, 1.0])
    rays = torch.rand(2, 4, 8)
    model = BACKBONES.build({"name": "scaled", "factor": 3}, rays, in_channels=5, out_channels=2)
    torch.testing.assert_close(model(t, x), 3 * t[:, None, None, None] * x[:, :2])
    assert model.network.rays is rays
    with pytest.raises(InputError, match="backbone 'scaled': needs the option 'factor'"):
        BACKBONES.build("scaled", rays)
    with pytest.raises(InputError, match="no option 'widht'; it has factor, out_channels, in_ch"):
        BACKBONES.build({"name": "scaled", "factor": 3, "widht": 3}, rays)
    with pytest.raises(InputError, match="Scaled takes no second time"):
        BACKBONES.build({"name": "scaled", "factor": 3}, rays, second_time=True)


def test_a_module_that_takes_the_time_last_is_refused():
    class Late(nn.Module):
        def forward(self, sample, timestep):
            return sample

    with pytest.raises(InputError, match="Late.forward takes timestep last, not first"):
        BACKBONES.add("late", Late)
