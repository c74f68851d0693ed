"""The velocity of networks that predict the data or the noise."""

import pytest
import torch
from tiny_backbones import NAMES, image, tiny

from r2flow.base.errors import InputError
from r2flow.flow.path import interpolate
from r2flow.generators import build_generator
from tests.conftest import tiny_options


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("prediction", ["data", "noise"])
def test_a_network_that_is_right_gives_the_velocity_of_the_line(name, prediction, monkeypatch):
    x_0 = image(3)
    x_1 = image(3)
    t = torch.tensor([0.1, 0.5, 0.9])
    x_t, v = interpolate(x_0, x_1, t)
    model = tiny(name, prediction=prediction)
    truth = {"data": x_1, "noise": x_0}[prediction]
    monkeypatch.setattr(model, "velocity", lambda t, x, s=None: truth)
    torch.testing.assert_close(model(t, x_t), v, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("prediction", "t"), [("data", 0.99), ("noise", 0.0)])
def test_the_division_ends_at_a_twentieth(prediction, t):
    x = image()
    sign = {"data": 1, "noise": -1}[prediction]
    plain = tiny("hdit")
    model = tiny("hdit", prediction=prediction)
    model.load_state_dict(plain.state_dict())
    torch.testing.assert_close(model(t, x), sign * (plain(t, x) - x) / 0.05)


def test_two_predictions_at_once_are_refused():
    with pytest.raises(InputError, match=r"leave it or backbone\.prediction out"):
        tiny("hdit", data_std=0.5, prediction="data")


@pytest.mark.parametrize(("kind", "backbone"), [("diffusion", "hdit"), ("transfer_flow", "local")])
@pytest.mark.parametrize("option", [{"prediction": "data"}, {"data_std": 0.5}])
def test_a_model_of_another_output_refuses_them(kind, backbone, option):
    with pytest.raises(InputError, match="predicts no velocity"):
        build_generator(config(backbone, kind, **option))


@pytest.mark.parametrize("kind", ["rectified_flow", "flow_map"])
def test_a_network_goes_on_only_with_its_own_prediction(kind):
    parent = build_generator(config("hdit", prediction="data"))
    child = build_generator(config("hdit", kind, prediction="data"))
    child.start_from(parent)
    x = image()
    assert torch.equal(child.velocity(torch.tensor(0.3), x), parent.velocity(torch.tensor(0.3), x))
    with pytest.raises(InputError, match="trained with backbone.prediction=data"):
        build_generator(config("hdit", kind)).start_from(parent)


def config(backbone: str, kind: str = "rectified_flow", **options: object) -> dict[str, object]:
    return {
        "sensor": {"name": "hdl64e", "rows": 16, "columns": 64},
        "encoding": {"format": "logscale"},
        "backbone": {**tiny_options(backbone), **options},
        "generator": {"name": kind},
    }
