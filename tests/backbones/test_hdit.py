"""HDiT against the published implementation, and the properties it must have anywhere."""

import pytest
import torch
from tiny_backbones import image, tiny

from r2flow.backbones.transformer import Attention, BlockOptions, Neighbourhood
from tests.reference import backbone_of, load_case


@pytest.mark.parametrize("index", range(4))
def test_circular_attention_blocks_are_the_references(shared, index):
    case = load_case(shared, "units_circular_na.pt")["cases"][index]
    layer = Attention(BlockOptions(
        case["dim"], case["num_heads"], case["embed_dim"], case["max_harmonics"],
        Neighbourhood(tuple(case["kernel_size"]), True, "auto"), dropout=0.0,
    ))  # fmt: skip
    layer.load_state_dict(case["state_dict"])
    with torch.no_grad():
        # attention is by cosines: the lengths of queries and keys do not matter
        for factor in (1, 2**-9):
            layer.qkv_proj.weight[: 2 * case["dim"]] *= factor
            residual = layer(case["x"], case["emb"], layer.rope.table(case["coords"]))
            torch.testing.assert_close(residual, case["residual"], rtol=0, atol=1e-5)


# logits of up to 100 amplify what is left
def test_times_and_rays_are_rounded_as_the_references(shared, monkeypatch):
    # its norm rounds as published in torch 2.6 too
    case, F = load_case(shared, "hdit_16x192.pt"), torch.nn.functional
    model, rays = backbone_of("hdit", case), F.avg_pool2d(case["state_dict"]["coords"], (1, 4))
    monkeypatch.setattr(
        "r2flow.backbones.layers.rms_norm", lambda x, scale: F.rms_norm(x, scale.shape, scale, 1e-6)
    )
    torch.testing.assert_close(
        model.timestep_pe(case["t"]), case["acts"]["timestep_pe"], rtol=0, atol=5e-7
    )
    for level in range(3):
        block = (model.down_levels[f"level_{level}"] if level < 2 else model.mid_levels)[0]
        assert torch.equal(model.get_buffer(f"table_{level}"), block.residual_attn.rope.table(rays))
        rays = F.avg_pool2d(rays, 2)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_angles_stay_exact_whatever_the_weights_become(dtype):
    model = tiny("hdit")
    before = {name: buffer.clone() for name, buffer in model.named_buffers()}
    model.to(dtype)
    assert {p.dtype for p in model.parameters()} == {dtype}
    for name, buffer in model.named_buffers():
        assert torch.equal(buffer, before[name]), name
        assert buffer.dtype == torch.float32


def test_autocast_does_not_round_the_image_at_the_ends():
    """Where blocks add nothing and inner levels are left out, the network is linear layers between
    two images.
    """
    model, x, t = tiny("hdit", detail=[1, 8]), image(), torch.tensor([0.1, 0.9985])
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if name.endswith(
                (
                    "out_proj.weight",
                    "linear.weight",
                    "spread.weight",
                    "second.weight",
                    "second.bias",
                )
            ):
                weight.zero_()
            elif name.endswith("alpha"):  # the share of the inner level is its sigmoid
                weight.fill_(-1e4)
        expected = model(t, x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = model(t, x)
    assert expected.std() > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
