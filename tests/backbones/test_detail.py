"""The convolutional path of hdit, and preconditioning of any backbone."""

import pytest
import torch
from tiny_backbones import PUBLISHED, image, tiny, untrained

from r2flow.backbones.base import precondition

T = torch.linspace(0, 1, 23, dtype=torch.float64)


def test_the_path_changes_nothing_at_the_start():
    plain, detailed = tiny("hdit"), untrained("hdit", detail=[2, 8]).eval()
    missing, unexpected = detailed.load_state_dict(plain.state_dict(), strict=False)
    assert not unexpected
    assert {name.split(".")[0] for name in missing} == {"detail"}
    x = image()
    assert torch.equal(detailed(0.7, x), plain(0.7, x))


def test_the_path_sees_single_pixels():
    """Without tokens and blocks it is two 3 x 3 convolutions: a pixel is seen 2 columns away, also
    across the seam.
    """
    model = untrained("hdit", detail=[1, 8]).eval()
    torch.nn.init.normal_(model.detail.answer.weight)
    torch.nn.init.zeros_(model.detail.spread.weight)
    x = image(1)
    other = x.clone()
    other[0, 0, 8, 63] += 1
    changed = (model(0.7, x) - model(0.7, other)).abs().amax((0, 1))
    assert changed[8].nonzero()[:, 0].tolist() == [0, 1, 61, 62, 63]
    assert changed[:, 30].nonzero().numel() == 0
    assert changed[:, 63].nonzero()[:, 0].tolist() == [6, 7, 8, 9, 10]


@pytest.mark.parametrize("s", [0.3, 1.0])
def test_input_and_target_of_the_network_have_unit_variance(s):
    x_0, x_1 = torch.randn(
        2, 200_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    x_1 = s * x_1
    for t in T:
        into, skip, out = (factor.flatten() for factor in precondition(t[None], s))
        x_t = t * x_1 + (1 - t) * x_0
        target = (x_1 - x_0 - skip * x_t) / out
        assert abs(float((into * x_t).var()) - 1) < 0.02
        assert abs(float(target.var()) - 1) < 0.02
        assert abs(float((target * x_t).mean())) < 0.02  # nothing linear is left


@pytest.mark.parametrize("name", PUBLISHED)
def test_an_untrained_network_gives_the_linear_estimate(name):
    model = untrained(name, data_std=0.5).eval()
    x, t = image(), torch.tensor([0.0, 0.8])
    skip = torch.tensor([-1.0, (0.8 * 0.25 - 0.2) / (0.8**2 * 0.25 + 0.2**2)])
    assert torch.allclose(model(t, x), skip[:, None, None, None] * x, atol=1e-6)


def test_a_condition_is_not_scaled():
    """The condition's channels reach the network as they are, the image's at unit variance."""
    plain, model = tiny("hdit", 3, 2), untrained("hdit", 3, 2, data_std=0.5).eval()
    model.load_state_dict(plain.state_dict())
    x, t = image(channels=3), torch.tensor([1.0, 1.0])
    inner = torch.cat([2 * x[:, :2], x[:, 2:]], dim=1)  # V = s^2 at t = 1
    assert torch.allclose(model(t, x), x[:, :2] + plain(t, inner), atol=1e-5)


def test_half_precision_keeps_the_skip_exact():
    model = untrained("hdit", data_std=0.5).eval()
    x = image()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(model(0.0, x), -x)
