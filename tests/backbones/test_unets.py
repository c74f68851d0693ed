"""The two U-Nets against the published implementation, and options that backbones refuse."""

import pytest
import torch

from r2flow.backbones import BACKBONES
from r2flow.backbones.convolutions import Resample
from r2flow.base.errors import InputError
from tests.reference import load_case


def test_resampling_is_the_references(shared):
    units = load_case(shared, "units_encodings.pt")
    # of one axis: unused
    cases = [(case["kw"], case) for case in units["resample"] if "direction" not in case["kw"]]
    for options, case in cases:
        resample = Resample(
            options.get("window", (1, 3, 3, 1)), "up" in options, options.get("ring", True)
        )
        torch.testing.assert_close(resample.kernel, case["kernel"], rtol=0, atol=0)
        torch.testing.assert_close(resample(units["h"]), case["out"], rtol=0, atol=1e-5)
    assert len(cases) == 6


@pytest.mark.parametrize("window", [(1, 1), (1, 3, 3, 1)])
def test_resampling_keeps_a_constant_ring_constant(window):
    x = torch.full((1, 3, 8, 16), 2.5)
    for up in (True, False):
        # the filter sees zeros above and below
        inner = Resample(window, up=up, ring=True)(x)[:, :, 1:-1]
        torch.testing.assert_close(inner, torch.full_like(inner, 2.5))


@pytest.mark.parametrize("name", ["adm_unet", "efficient_unet"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"base_channels": 2}, "base_channels: must be even and at least 4, found 2"),
        (
            {"num_residual_blocks": [1, 2]},
            r"num_residual_blocks must be of 4 levels, as channel_multiplier, found \[1, 2\]",
        ),
        ({"channel_multiplier": []}, "channel_multiplier: value should have at least 1 item"),
        ({"position": "learnable"}, "no position named 'learnable'; known: fourier_features, none"),
        ({"name": "local", "channels": 5}, "channels: must be even and at least 4, found 5"),
        (
            {"name": "hdit", "depths": (1, 0, 1, 1)},
            "depths.1: input should be greater than or equal",
        ),
        (
            {"name": "hdit", "base_channels": 16, "num_heads": (3, 2, 2, 2)},
            "16 channels cannot be shared by 3 heads",
        ),
        *(
            ({"name": "hdit", "detail": detail}, words)
            for detail, words in (
                ([2], "needs the option 'detail.1'"),
                ([0, 8], "detail.0: input should be greater than or equal to 1"),
                ([2, 8, 8], "detail: tuple should have at most 2 items"),
            )
        ),
        (
            {"name": "hdit", "attention": "tile"},
            "no attention backend named 'tile'.*Did you mean 'tiles'",
        ),
    ],
)
def test_options_that_cannot_work_say_why(name, options, message):
    with pytest.raises(InputError, match=message), torch.device("meta"):
        BACKBONES.build({"name": name, **options}, torch.zeros(2, 16, 64))


@pytest.mark.parametrize(("name", "width"), [("adm_unet", 16), ("efficient_unet", 8)])
def test_the_first_convolution_has_its_published_width(name, width):
    options = {
        "name": name,
        "base_channels": 8,
        "channel_multiplier": [2, 2],
        "num_residual_blocks": 1,
    }
    assert len(BACKBONES.build(options, torch.zeros(2, 16, 64)).in_conv.weight) == width
